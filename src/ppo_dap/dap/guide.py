"""The guide: what proposals are made with and learn by, and the stages of an iteration that are its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ppo_dap.config import Config, QConfig
from ppo_dap.dap import adaptation, q_learning
from ppo_dap.dap.calibration import Calibration, calibrate
from ppo_dap.dap.objective import Batch, GatedProposals, admit_proposals, provenance
from ppo_dap.dap.proposals import ProposalDraws, Proposals, Proposer, States, choose_states, propose
from ppo_dap.nets.actor import Actor
from ppo_dap.nets.adapters import Adapters, Backbone, adapter_norm, init_adapters
from ppo_dap.nets.arrays import first_state, on_device
from ppo_dap.nets.critic import Critic, QFunction, q_features
from ppo_dap.ppo.surrogate import share
from ppo_dap.ppo.update import Rows
from ppo_dap.priors.network import Network, TrainedNetwork

Q_SPREAD_DECAY = 0.9
"""Memory of the running global scale of Q, an iteration each."""
Q_RANK_DECAY = 0.9
"""The same of Q's rank correlation."""


class Judged(NamedTuple):
    """What Q said of fresh rows before it learned from them, and what it should have said."""

    values: Float[Array, " rows"]
    targets: Float[Array, " rows"]
    weights: Float[Array, " rows"]


class GuideState(eqx.Module):
    """Q, the adapters and their optimizers: none of it is PPO's."""

    q: QFunction
    q_optimizer: optax.OptState
    q_spread: Float[Array, ""]
    """Running global scale of Q within a state."""
    q_rank: Float[Array, ""]
    """Running rank correlation of Q - V with the advantages of fresh rows."""
    calibration: Calibration | None
    judged: Judged | None
    """What the next calibration is fitted on."""
    adapters: Adapters | None
    """None where the prior stays as it is."""
    pet_optimizer: optax.OptState

    def proposer(
        self, prior: Network, condition: Float[Array, " c"], critic: Critic | None, actor: Actor | None
    ) -> Proposer:
        """With the frozen prior and what it is asked for, the critic whose trunk Q reads, and the policy."""
        running = self.q_spread, self.q_rank, self.calibration
        return Proposer(prior, condition, self.adapters, self.q, *running, critic, actor)


class Visited(eqx.Module):
    """States of D_on, or of a part of it, a row each: what proposals are made for."""

    state_ids: Int[Array, " rows"]
    raw_observations: Float[Array, "rows obs"]
    """What the prior reads."""
    observations: Float[Array, "rows obs"]
    """What the policy and Q read (normalised)."""
    weights: Float[Array, " rows"]
    """1, or 0 for a row in which no transition happened."""


class Proposed(eqx.Module):
    """Proposals on a part of D_on, not yet admitted."""

    proposals: Proposals
    wanted: Int[Array, ""]
    """How many of them are for rows in which a transition happened."""
    q_spread: Float[Array, ""]
    metrics: dict[str, Float[Array, ""]]


class OnPolicy(eqx.Module):
    """What the guide needs of D_on, a row each."""

    state_ids: Int[Array, " rows"]
    raw_observations: Float[Array, "rows obs"]
    """What the prior reads."""
    observations: Float[Array, "rows obs"]
    """What the policy and Q read (normalised)."""
    actions: Float[Array, "rows act"]
    """As executed: scaled and clipped to [-1, 1]."""
    q_targets: Float[Array, " rows"]
    weights: Float[Array, " rows"]
    advantages: Float[Array, " rows"] | None = None
    """GAE's; None where the PPO is not ours."""
    returns: Float[Array, " rows"] | None = None
    """GAE's: advantages + V."""


def on_policy(rows: Rows) -> OnPolicy:
    """PPO's rows as the guide sees them."""
    executed = jnp.clip(rows.actions, -1.0, 1.0)
    return OnPolicy(
        rows.state_ids,
        rows.raw_observations,
        rows.observations,
        executed,
        rows.q_targets,
        rows.weights,
        rows.advantages,
        rows.returns,
    )


def create_guide(
    rng: np.random.Generator, critic: Critic | None, sizes: tuple[int, int], config: Config, prior: Network
) -> GuideState:
    """A fresh Q and identity adapters for (observation, action) `sizes`; Q reads `critic`'s trunk."""
    own_trunk = config.q.q_trunk == "separate"
    q = QFunction.create(rng, *sizes, config.ppo.hidden_size, config.q.q_hidden_size, own_trunk, config.q.q_heads)
    adapters = None
    if adaptation.is_tuned(prior, config.adaptation) and isinstance(prior, Backbone):
        adapters = init_adapters(rng, prior, config.adaptation.adapter, config.adaptation.adapter_rank)
    blank = Judged(*(on_device(np.zeros(config.ppo.rollout_steps)) for _ in Judged._fields))
    return GuideState(
        q,
        first_state(q_learning.ADAM, q_learning.trainable(q, critic, config.q)),
        on_device(1),
        on_device(0),
        *((None, None) if config.q.q_calibration == "none" else (Calibration.identity(), blank)),
        adapters,
        () if adapters is None else first_state(adaptation.ADAM, adapters),
    )


def recalibrated(guide: GuideState, config: QConfig) -> GuideState:
    """With Q's calibration fitted on the rows that it was last judged on; on the host, which waits for them."""
    if config.q_calibration == "none" or guide.judged is None:
        return guide
    values, targets, weights = (np.asarray(x) for x in guide.judged)
    kept = weights > 0
    if not kept.any():  # before the first iteration
        return guide
    calibration = calibrate(values[kept], targets[kept], config.q_calibration)
    return eqx.tree_at(lambda g: g.calibration, guide, calibration)


def num_proposal_states(num_rows: int, parts: int, config: Config) -> int:
    """States that get proposals: the same whole number for every minibatch of an epoch, and for every part of D_on."""
    unit = math.lcm(max(1, num_rows // config.ppo.minibatch_size), parts)
    return max(1, int(config.proposals.proposal_fraction * num_rows / unit)) * unit


def make_proposals(
    proposer: Proposer,
    visited: Visited,
    beta: Float[Array, ""],
    draws: ProposalDraws,
    *,
    config: Config,
) -> Proposed:
    """Step 3: proposals on a random subset of the visited states, as many as there are draws for."""
    index = choose_states(visited.weights, draws.order, draws.resample.shape[0])
    observations = visited.observations[index]
    states = States(
        visited.state_ids[index],
        visited.raw_observations[index],
        observations,
        q_features(proposer.critic, proposer.q, observations, shared=False),
    )
    proposals, metrics = propose(proposer, states, draws, beta, config=config.proposals)
    # Rows in which no transition happened fill up the subset when it wants more states than there are; the gate stops
    # them, and they are no proposals of another batch.
    return Proposed(proposals, jnp.sum(visited.weights[index] > 0), metrics.pop("q_spread"), metrics)


def gate_proposals(
    guide: GuideState, parts: Sequence[Proposed], batch: Batch
) -> tuple[GatedProposals, Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The proposals of all parts of D_on behind the provenance gate; also Q's new running scale, and metrics.

    Among them `spr`, Eq. 12: the share of the proposals whose states come from the current on-policy batch.
    """
    gated = admit_proposals(jax.tree.map(lambda *x: jnp.concatenate(x), *(part.proposals for part in parts)), batch)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(part.metrics for part in parts))
    spread = jnp.sqrt(jnp.mean(jnp.stack([jnp.square(part.q_spread) for part in parts])))
    metrics = {name: jnp.mean(values) for name, values in stacked.items()}
    wanted = jnp.maximum(sum(part.wanted for part in parts), 1).astype(jnp.float32)
    metrics["spr"] = share(jnp.sum(gated.gate), wanted)
    return gated, Q_SPREAD_DECAY * guide.q_spread + (1 - Q_SPREAD_DECAY) * spread, metrics


class Learned(NamedTuple):
    """What Q's part of step 4 gives."""

    q: QFunction
    critic: Critic | None
    """As it was, except its trunk where Q shares it."""
    optimizer: optax.OptState
    q_rank: Float[Array, ""]
    judged: Judged | None
    metrics: dict[str, Float[Array, ""]]


def learn_q(
    guide: GuideState,
    critic: Critic | None,
    old_critic: Critic | None,
    rows: OnPolicy,
    orders: Int[Array, "epochs rows"],
    *,
    config: Config,
) -> Learned:
    """Step 4, Q's part: regression on the actions that were executed (clipped to the box).

    Q is judged on the rows before it learns from them, with the features (of `old_critic`) that it guided by.
    """
    targets = {"td": rows.q_targets, "gae": rows.returns, "advantage": rows.advantages}[config.q.q_target]
    if targets is None:
        raise ValueError(f"rows without advantages cannot give the q_target {config.q.q_target!r}")
    data = q_learning.QData(rows.observations, rows.actions, targets, rows.weights)
    size = min(config.ppo.minibatch_size, rows.weights.shape[0])
    q, critic, optimizer, loss = q_learning.fit_q(
        guide.q, critic, guide.q_optimizer, data, orders, minibatch_size=size, config=config.q
    )
    metrics, q_rank, judged = {"q_loss": loss}, guide.q_rank, guide.judged
    if rows.advantages is not None and rows.returns is not None:
        features = q_features(old_critic, guide.q, rows.observations, shared=False)
        values = guide.q(features, rows.actions[:, None, :])[:, 0]
        # V is what GAE's returns have beside its advantages.
        ranked = values if config.q.q_target == "advantage" else values - (rows.returns - rows.advantages)
        metrics["q_rank"] = q_learning.rank_correlation(ranked, rows.advantages, rows.weights)
        q_rank = Q_RANK_DECAY * guide.q_rank + (1 - Q_RANK_DECAY) * metrics["q_rank"]
        judged = None if guide.judged is None else Judged(values, targets, rows.weights)
    return Learned(q, critic, optimizer, q_rank, judged, metrics)


def adapt_prior(
    guide: GuideState,
    prior: TrainedNetwork,
    rows: OnPolicy,
    batch: Batch,
    num_steps: Int[Array, ""],
    draws: adaptation.PETDraws,
    *,
    config: Config,
) -> tuple[Adapters, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 5: PET on the actions that were executed."""
    data = adaptation.PETData(rows.state_ids, rows.raw_observations, rows.actions, rows.weights)
    assert guide.adapters is not None  # else there is no such stage
    adapters, optimizer, metrics = adaptation.adapt(
        prior,
        guide.adapters,
        guide.pet_optimizer,
        data,
        draws,
        num_steps,
        config=config.adaptation,
        check=lambda ids, observations: provenance(ids, observations, batch),
    )
    return adapters, optimizer, metrics | {"adapter_norm": adapter_norm(adapters)}
