"""Step 6 of Algorithm 1 and Definition 1 (4.5): what is measured in every iteration, and what is proved once.

A run is strictly on-policy when the static claims hold for the traced update and the measured ones in every iteration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ppo_dap.config import Config, ProposalConfig
from ppo_dap.dap.dataflow import UNKNOWN, Flow
from ppo_dap.dap.objective import Batch, GatedProposals, Weights, added_terms, admit, admit_proposals
from ppo_dap.dap.proposals import Proposals, conditions, gaussian_proxy
from ppo_dap.nets.actor import Actor, gaussian_kl, log_prob, tree_norm
from ppo_dap.nets.adapters import Adapters
from ppo_dap.ppo.surrogate import weighted_mean
from ppo_dap.ppo.update import Normaliser, Rows, ppo_loss
from ppo_dap.priors.network import Network
from ppo_dap.priors.samplers import Solver

DELTA = 1e-8
PROXY_STATES = 16
"""States on which the prior is sampled again for prior-KL and the KL to the frozen prior."""
PROXY_SOLVER = Solver("dpmpp_2m", 10)
"""Samples as good as the 20 stochastic steps' (4.7) at half the cost, and with one noise alone: what differs before and
after PET is the prior."""
RATIO_TOLERANCE = 1e-3
"""Largest |ratio - 1| at the first minibatch: rollout (numpy) and update (XLA) round differently, no more."""


class Probe(eqx.Module):
    """A minibatch of D_off for the leakage audit alone; actions are scaled."""

    raw_observations: Float[Array, "n obs"]
    actions: Float[Array, "n act"]


def policy_metrics(actor: Actor, old_log_std: Float[Array, " act"], rows: Rows) -> dict[str, Float[Array, ""]]:
    """policy-KL, E[KL(pi_{k+1} || pi_k)] on D_on (A.1), and the surrogate E[ratio * A] of Eq. 14.

    Without the mean of A, which is 0 for the true advantages and is V's error for GAE's.
    """
    means = actor(rows.observations)
    kl = gaussian_kl(means, actor.log_std[None], rows.old_means, old_log_std[None])
    ratio = jnp.exp(log_prob(rows.actions, means, actor.log_std) - rows.old_log_probs)
    advantages = rows.advantages - weighted_mean(rows.advantages, rows.weights)
    return {
        "policy_kl": weighted_mean(kl, rows.weights),
        "surrogate": weighted_mean(ratio * advantages, rows.weights),
    }


def leakage(
    actor: Actor,
    probe: Probe,
    normaliser: Normaliser,
    rows: Rows,
    batch: Batch,
    weights: Weights,
    actor_gradient_norm: Float[Array, ""],
    *,
    config: Config,
) -> dict[str, Float[Array, ""]]:
    """OGLR (Eq. 11): a minibatch of logs pushed through the actor gradient of the real update, over the real norm.

    `oglr` passes the gate of the real update, which must stop all of it; `oglr_ungated` shows what a leak would be.
    """
    n = probe.actions.shape[0]
    observations = normaliser(probe.raw_observations, config.ppo.observation_clip)
    means = actor(observations)
    offline = Rows(
        state_ids=-1 - jnp.arange(n, dtype=jnp.int32),
        raw_observations=probe.raw_observations,
        observations=observations,
        actions=probe.actions,
        old_log_probs=log_prob(probe.actions, means, actor.log_std),
        old_means=means,
        advantages=jnp.resize(rows.advantages, (n,)),
        returns=jnp.zeros(n),
        q_targets=jnp.zeros(n),
        weights=jnp.ones(n),
    )
    proposals = Proposals(
        offline.state_ids,
        probe.raw_observations,
        observations,
        probe.actions[:, None, :],
        probe.actions,
        jnp.ones_like(probe.actions),
    )

    old_log_std = actor.log_std

    def norm(rows: Rows, gated: GatedProposals):
        def loss(actor: Actor):
            added, _ = added_terms(actor, rows, gated, weights, config=config.objective)
            return ppo_loss(actor, rows, old_log_std, ppo=config.ppo)[0] + added

        return tree_norm(jax.grad(loss)(actor)) / (actor_gradient_norm + DELTA)

    return {
        "oglr": norm(admit(offline, batch), admit_proposals(proposals, batch)),
        "oglr_ungated": norm(offline, GatedProposals(proposals, jnp.ones(n))),
    }


def prior_metrics(
    actor: Actor,
    prior: Network,
    condition: Float[Array, " c"],
    before: Adapters | None,
    after: Adapters | None,
    proposals: Proposals,
    noise: Float[Array, ...],
    *,
    config: ProposalConfig,
) -> dict[str, Float[Array, ""]]:
    """prior-KL, E[KL(p_{k+1} || p_k)] by the Gaussian proxy (A.1), and the KLs of the policy to the prior.

    The prior is sampled with the same noise before and after PET and frozen, so that "small prior-KL" is not noise and
    "nothing moved" shows.
    """
    # Spread over the whole rollout: the proposals come in the order of its parts.
    count, few_states = proposals.actions.shape[0], min(PROXY_STATES, proposals.actions.shape[0])
    few = jax.tree.map(lambda x: x[:: count // few_states][:few_states], proposals)

    def proxy(adapters: Adapters | None):
        asked = conditions(condition, few_states)
        actions, _ = prior.sample(few.raw_observations, asked, noise, PROXY_SOLVER, adapters)
        mean, std = gaussian_proxy(actions, config.proxy_std_floor)
        return mean, jnp.log(std)

    log_std, frozen = actor.log_std[None], proxy(None)
    metrics = {
        "kl_to_frozen_prior": jnp.mean(gaussian_kl(actor(few.observations), log_std, *frozen)),
        "kl_to_prior": jnp.mean(
            gaussian_kl(actor(proposals.observations), log_std, proposals.proxy_mean, jnp.log(proposals.proxy_std))
        ),
    }
    if before is None:
        return metrics | {"prior_kl": jnp.zeros(()), "prior_drift": jnp.zeros(())}  # a prior that nothing moves
    old, new = proxy(before), proxy(after)
    return metrics | {
        "prior_kl": jnp.mean(gaussian_kl(*new, *old)),
        "prior_drift": jnp.mean(gaussian_kl(*new, *frozen)),
    }


@dataclass(frozen=True)
class Claim:
    """One checked statement of Definition 1."""

    clause: str
    statement: str
    holds: bool
    evidence: str

    def __str__(self) -> str:
        return f"{'holds   ' if self.holds else 'VIOLATED'} {self.clause:6} {self.statement}: {self.evidence}"


_GUIDES = frozenset({"proposals", "offline", "backbone", "adapters", "q"})
FORBIDDEN: tuple[tuple[str, str, str, str, frozenset[str]], ...] = (
    # clause, statement, in the flow without what this tag carries, output or tag, labels that must not reach it
    ("(i)", "the importance ratio is made of theta and D_on", "theta", "tag:ratio", _GUIDES | {"previous"}),
    ("(i)", "the advantages are made of V and D_on", "", "tag:advantages", _GUIDES | {"previous"}),
    (
        "(i)",
        "the new policy less what Eq. 9 adds is made of theta, V and D_on",
        "added",
        "out:actor",
        _GUIDES | {"previous"},
    ),
    (
        "(i)",
        "V and its trunk learn from D_on alone, not from Q or proposals",
        "",
        "out:critic",
        _GUIDES | {"previous", "actor"},
    ),
    (
        "(ii)",
        "prior and Q reach the policy as proposals alone",
        "proposals",
        "out:actor",
        frozenset({"backbone", "adapters", "q"}),
    ),
    (
        "(iii)",
        "PET's gradient is made of D_on and the prior, not of actor, critic, Q, proposals or logs",
        "",
        "out:adapters",
        frozenset({"proposals", "offline", "actor", "critic", "q", "previous"}),
    ),
    ("(iv)", "no array of D_off reaches the new policy", "", "out:actor", frozenset({"offline"})),
    ("(iv)", "no array of D_off reaches the optimizers, Q or the prior", "", "out:rest", frozenset({"offline"})),
)


def static_claims(flow: Callable[[str], Flow]) -> list[Claim]:
    """The data-flow proof: `flow(tag)` is that of the traced update with what carries the tag taken as given, all of it
    where the tag is "".

    Proposals do reach theta, through Eq. 9, and theta reaches the next minibatch's ratio: hence the cuts. Nothing may
    be reached by what has no owner.
    """
    claims, flows = [], {cut: flow(cut) for cut in sorted({row[2] for row in FORBIDDEN})}
    for clause, statement, cut, where, forbidden in FORBIDDEN:
        kind, name = where.split(":")
        found = flows[cut].tags if kind == "tag" else flows[cut].outputs
        if name not in found:
            if name == "adapters":
                continue
            claims.append(Claim(clause, statement, False, f"{name} was not found in the traced program"))
            continue
        reached = found[name] & (forbidden | UNKNOWN)
        evidence = f"reached by {', '.join(sorted(reached))}" if reached else "proved on the traced program"
        claims.append(Claim(clause, statement, not reached, evidence))
    return claims


def both(first: Sequence[Claim], then: Sequence[Claim]) -> list[Claim]:
    """Claims on two traced programs, of which a run has one after the other: the one that fails, if one does."""
    later = {claim.statement: claim for claim in then}
    worse = [later.pop(claim.statement, claim) if claim.holds else claim for claim in first]
    known = {claim.statement for claim in worse}
    return worse + [claim for claim in later.values() if claim.statement not in known]


def require_proofs(static: Sequence[Claim]) -> list[Claim]:
    """`static` claims as they were kept, and one that does not hold for each clause whose proof is not among them."""
    proved = {claim.clause for claim in static}
    missing = [clause for clause in ("(i)", "(iv)") if clause not in proved]
    return [*static, *(Claim(clause, "a proof on the traced update", False, "was not kept") for clause in missing)]


def every_iteration(rows: Sequence[Mapping[str, Any]], env_steps: int) -> list[Mapping[str, Any]]:
    """`rows` with an empty one for each iteration that is missing: between them, or after the last if that ends before
    `env_steps`, which the run is known to have made.
    """
    whole: list[Mapping[str, Any]] = []
    last = 0
    for row in rows:
        whole += [{}] * (row["iteration"] - last - 1) + [row]
        last = row["iteration"]
    return whole + [{}] * ((rows[-1]["env_steps"] if rows else 0) < env_steps)


def _worst(rows: Iterable[Mapping[str, Any]], name: str, largest: bool) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    if any(math.isnan(value) for value in values):
        return math.nan
    return (max(values) if largest else min(values)) if values else None


def _is_one(value: float) -> bool:
    return value == 1


def _is_rounding(value: float) -> bool:
    return value < RATIO_TOLERANCE


MEASURED: tuple[tuple[str, str, str, bool, Callable[[float], bool], str], ...] = (
    # clause, statement, metric, whether its largest value is the worst, what is right, whose runs have it
    (
        "(i)",
        "every row of the actor update is of the current batch (share)",
        "batch_fresh",
        False,
        lambda v: v == 1,
        "",
    ),
    (
        "(i)",
        "ratio is 1 at the first minibatch (largest error)",
        "ratio_error",
        True,
        lambda v: v < RATIO_TOLERANCE,
        "",
    ),
    ("(ii)", "SPR, smallest", "spr", False, _is_one, "guided"),
    ("(iii)", "share of PET rows from the current batch, smallest", "pet_spr", False, _is_one, "adapted"),
    ("(iv)", "OGLR, largest", "oglr", True, lambda v: v == 0, "guided"),
)


def measured_claims(
    metrics: Sequence[Mapping[str, Any]], guided: bool = True, adapted: bool | None = None, in_use: int | None = None
) -> list[Claim]:
    """Definition 1 on what was logged: the worst value over all iterations counts; what is missing does not hold.

    `guided` runs have a prior, `adapted` ones (all guided ones, unless it says no) tune it; the prior was in use in the
    first `in_use` iterations (all, unless it is given), until its weights had decayed.
    """
    has = {"": True, "guided": guided, "adapted": guided if adapted is None else adapted}
    claims = []
    for clause, statement, name, largest, right, whose in MEASURED:
        if has[whose]:
            worst, logged = _worst(metrics, name, largest), [row.get(name) is not None for row in metrics]
            absent = (logged[:in_use] if whose else logged).count(False)
            evidence = "was not logged" if worst is None else f"{worst:.3g} over {sum(logged)} iterations"
            evidence += f", not logged in {absent}" if worst is not None and absent else ""
            claims.append(Claim(clause, statement, worst is not None and not absent and bool(right(worst)), evidence))
    return claims
