"""Algorithm 1: one iteration of PPO-DAP after its rollout, step by step. Plain PPO is the same without a guide."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ppo_dap.config import Config, PPOConfig
from ppo_dap.dap import audit
from ppo_dap.dap.guide import (
    GuideState,
    Proposed,
    Visited,
    adapt_prior,
    create_guide,
    gate_proposals,
    learn_q,
    make_proposals,
    on_policy,
)
from ppo_dap.dap.objective import Batch, added_gradient, admit, provenance
from ppo_dap.dap.proposals import ProposalDraws, Proposer
from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.reuse import Candidate, contest, no_batch, previous_rows, remember
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.surrogate import share
from ppo_dap.ppo.update import (
    Normaliser,
    PPOState,
    PreviousRows,
    Rows,
    Settings,
    estimate_advantages,
    improve_actor,
    improve_critic,
)
from ppo_dap.priors.network import Network
from ppo_dap.training.draws import Draws

NETWORK_STREAM = 5

Metrics = dict[str, Float[Array, ""]]


class Learner(eqx.Module):
    """Everything that an iteration updates on the device."""

    ppo: PPOState
    guide: GuideState | None
    previous: Rollout | None = None
    """The batch before, for PPO-ARC alone."""

    def alone(self) -> Learner:
        """Without a guide."""
        return Learner(self.ppo, None, self.previous)


class Frozen(NamedTuple):
    """The prior as Stage I left it, what it is asked for, and the offline minibatch of the leakage audit."""

    prior: Network
    condition: Float[Array, " c"]
    probe: audit.Probe


class Schedule(NamedTuple):
    """What changes with the run's progress, as arrays, so that nothing recompiles."""

    first_id: Int[Array, ""]
    settings: Settings
    beta: Float[Array, ""]
    pet_steps: Int[Array, ""]


def create_learner(
    sizes: tuple[int, int],
    config: Config,
    prior: Network | None,
    prior_spread: Float[np.ndarray, " act"] | None = None,
) -> Learner:
    """Fresh networks by the config's seed; the guide's come after PPO's, whose weights do not depend on them.

    `prior_spread` is what the policy's standard deviation starts at where `initial_std` is None; it may be left out
    where a checkpoint takes the policy's place.
    """
    rng = np.random.default_rng([config.run.seed, NETWORK_STREAM])
    std = config.ppo.initial_std
    if std is None:
        std = 1.0 if prior_spread is None else np.clip(prior_spread, config.warm.warm_start_std_floor, 1.0)
    ppo = PPOState.create(rng, *sizes, config.ppo.hidden_size)
    ppo = eqx.tree_at(lambda p: p.actor.log_std, ppo, on_device(np.log(np.broadcast_to(std, sizes[1]))))
    previous = no_batch(config.ppo, *sizes) if config.ppo.reuse_batches else None
    if prior is None:
        return Learner(ppo, None, previous)
    return Learner(ppo, create_guide(rng, ppo.critic, sizes, config, prior), previous)


class Stages:
    """The stages of an iteration as jitted functions of arrays, for one configuration, with a guide or without."""

    def __init__(self, config: Config, guided: bool):
        self._ppo = config.ppo
        self.adds = guided or config.objective.lambda_awr > 0
        """Whether something is added to PPO's objective."""
        self.advantages = jax.jit(partial(_advantages, config=config))
        added = partial(added_gradient, config=config.objective) if self.adds else None
        self.actor = jax.jit(partial(improve_actor, ppo=config.ppo, added_gradient=added))
        self.critic = jax.jit(partial(improve_critic, ppo=config.ppo))
        self.policy_metrics = jax.jit(audit.policy_metrics)
        self.seeks_mode = config.proposals.mode_seeking > 0
        if config.ppo.reuse_batches:
            self.remember = jax.jit(remember)
            self.previous_rows = jax.jit(partial(previous_rows, ppo=config.ppo))
            self.reuse = jax.jit(partial(improve_actor, ppo=config.ppo, added_gradient=added))
            self.contest = jax.jit(partial(_contest, ppo=config.ppo))
        if guided:
            self.propose = jax.jit(partial(_propose, config=config))
            self.gate = jax.jit(gate_proposals)
            self.learn_q = jax.jit(partial(learn_q, config=config))
            self.adapt = jax.jit(partial(adapt_prior, config=config))
            self.leakage = jax.jit(partial(audit.leakage, config=config))
            self.prior_metrics = jax.jit(partial(audit.prior_metrics, config=config.proposals))

    def alone(self) -> Stages:
        """PPO's, with nothing added; what both have are the same functions, so that nothing is compiled twice."""
        alone = copy.copy(self)
        alone.adds, alone.actor = False, jax.jit(partial(improve_actor, ppo=self._ppo, added_gradient=None))
        return alone


def _advantages(
    critic: Critic,
    parts: Sequence[Rollout],
    normaliser: Normaliser,
    reward_std: Float[Array, ""],
    first_id: Int[Array, ""],
    *,
    config: Config,
) -> tuple[Rows, Batch, Metrics]:
    rows = estimate_advantages(critic, parts, normaliser, reward_std, config.ppo)
    batch = Batch(first_id, rows.raw_observations, rows.weights, rows.observations)
    admitted = admit(rows, batch)
    return admitted, batch, {"batch_fresh": share(jnp.sum(admitted.weights), jnp.sum(rows.weights))}


def _contest(
    old_log_std: Float[Array, " act"], own: Candidate, reused: Candidate, rows: Rows, previous: PreviousRows,
    batch: Batch, *, ppo: PPOConfig,
) -> Candidate:  # fmt: skip
    """The winner, and in its metrics the share of the rows it was made of that are of the current batch."""
    winner, won, metrics = contest(old_log_std, own, reused, rows, previous, ppo=ppo)
    # The old rows go around the gate, which has no place for them; here it says what it thinks of them.
    gate = provenance(previous.state_ids, previous.raw_observations, batch)
    fresh = jnp.sum(rows.weights) + won * jnp.sum(previous.weights * gate)
    seen = jnp.sum(batch.weights) + won * jnp.sum(previous.weights)
    return winner._replace(metrics=winner.metrics | metrics | {"batch_fresh": share(fresh, seen)})


def _propose(
    proposer: Proposer,
    state_ids: Int[Array, "time envs"],
    observations: Float[Array, "time envs obs"],
    valid: Bool[Array, "time envs"],
    normaliser: Normaliser,
    beta: Float[Array, ""],
    draws: ProposalDraws,
    *,
    config: Config,
) -> Proposed:
    raw = observations.reshape(-1, observations.shape[-1])
    normalised = normaliser(raw, config.ppo.observation_clip)
    visited = Visited(state_ids.reshape(-1), raw, normalised, valid.reshape(-1).astype(jnp.float32))
    return make_proposals(proposer, visited, beta, draws, config=config)


def call(name: str, stage: Callable[..., Any], *arguments: Any) -> Any:
    """Run a stage; the trainer's replacement also takes the time under `name`."""
    return stage(*arguments)


def iterate(
    learner: Learner,
    frozen: Frozen | None,
    rollout: Iterable[Rollout],
    normaliser: Normaliser,
    reward_std: Callable[[], Any],
    schedule: Schedule,
    draws: Draws,
    stages: Stages,
    run: Callable[..., Any] = call,
) -> tuple[Learner, Metrics]:
    """Algorithm 1, one iteration. Without a guide it is PPO.

    `rollout` yields D_on in parts; `reward_std` is asked for when it is over. Stages are only dispatched here: the next
    rollout can begin when the actor is there, and what comes after the actor is computed meanwhile.
    """
    old, guide = learner.ppo, learner.guide
    settings, weights = schedule.settings, schedule.settings.added_weights

    # 1) Rollout with the current policy; 3) value-guided proposals on the states of each part that has been visited.
    parts, proposed = _collect_and_propose(learner, frozen, rollout, normaliser, schedule, draws, stages, run)

    # 2) Advantages with GAE; rows and proposals that are not of the current batch lose their weight.
    scale = reward_std()
    rows, batch, metrics = run("gae", stages.advantages, old.critic, parts, normaliser, scale, schedule.first_id)
    gated: Any = ()
    if guide is not None:
        gated, q_spread, of_proposals = run("proposals", stages.gate, guide, proposed, batch)
        metrics |= of_proposals

    # 4) The actor (Eq. 9) and V; Q by one-step TD.
    (actor, actor_optimizer, improved), previous = _improve_policy(
        learner, rows, gated, parts, batch, (normaliser, scale), draws, settings, stages, run
    )
    metrics |= improved | run("audit", stages.policy_metrics, actor, old.actor.log_std, rows)
    critic, critic_optimizer, valued = run(
        "update", stages.critic, old.critic, old.critic_optimizer, rows, draws.critic, settings.learning_rate
    )
    metrics |= valued
    if guide is None or frozen is None:
        return Learner(PPOState(actor, critic, actor_optimizer, critic_optimizer), None, previous), metrics
    visited = on_policy(rows)
    learned = run("update", stages.learn_q, guide, critic, old.critic, visited, draws.q)
    critic = learned.critic

    # 5) PET: the adapters alone, on D_on.
    tuned = guide.adapters, guide.pet_optimizer, {}
    if guide.adapters is not None:
        tuned = run("pet", stages.adapt, guide, frozen.prior, visited, batch, schedule.pet_steps, draws.pet)
    adapters, pet_optimizer, adapted = tuned

    # 6) Monitoring.
    norm = improved["actor_gradient_norm"]
    leaked = run("audit", stages.leakage, actor, frozen.probe, normaliser, rows, batch, weights, norm)
    prior = frozen.prior, frozen.condition, guide.adapters, adapters
    moved = run("audit", stages.prior_metrics, actor, *prior, gated.proposals, draws.audit)
    ppo = PPOState(actor, critic, actor_optimizer, critic_optimizer)
    own = learned.q, learned.optimizer, q_spread, learned.q_rank, guide.calibration, learned.judged
    guide = GuideState(*own, adapters, pet_optimizer)
    return Learner(ppo, guide, previous), metrics | learned.metrics | adapted | leaked | moved


def _improve_policy(
    learner: Learner,
    rows: Rows,
    gated: Any,
    parts: list[Rollout],
    batch: Batch,
    statistics: tuple[Any, ...],
    draws: Draws,
    settings: Settings,
    stages: Stages,
    run: Callable[..., Any],
) -> tuple[Candidate, Rollout | None]:
    """PPO's update; with a previous batch, the better of that and of one on both batches. And the batch to keep.

    The previous rows do not pass the gate of `admit`: they would not get through, and the audit reports them.
    """
    old = learner.ppo
    update = (old.actor, old.actor_optimizer, rows, gated)
    own = Candidate(*run("update", stages.actor, *update, draws.actor, settings))
    if learner.previous is None:
        return own, None
    older = run("gae", stages.previous_rows, old.actor, old.critic, learner.previous, *statistics)
    reused = Candidate(*run("update", stages.reuse, *update, draws.reuse, settings, older))
    winner = run("update", stages.contest, old.actor.log_std, own, reused, rows, older, batch)
    return winner, run("gae", stages.remember, parts)


def _collect_and_propose(
    learner: Learner,
    frozen: Frozen | None,
    rollout: Iterable[Rollout],
    normaliser: Normaliser,
    schedule: Schedule,
    draws: Draws,
    stages: Stages,
    run: Callable[..., Any],
) -> tuple[list[Rollout], list[Proposed]]:
    """All parts of the rollout, and the proposals on each, dispatched before the next is collected."""
    proposer = None
    if learner.guide is not None and frozen is not None:
        actor = learner.ppo.actor if stages.seeks_mode else None
        proposer = learner.guide.proposer(frozen.prior, frozen.condition, learner.ppo.critic, actor)
    parts, proposed = [], []
    for part in rollout:
        if proposer is not None:
            states = part.state_ids, part.observations, part.valid
            numbers = draws.proposals[len(parts)]
            proposed.append(run("proposals", stages.propose, proposer, *states, normaliser, schedule.beta, numbers))
        parts.append(part)
    return parts, proposed
