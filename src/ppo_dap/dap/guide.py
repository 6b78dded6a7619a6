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

from ppo_dap.config import Config
from ppo_dap.dap import adaptation, q_learning
from ppo_dap.dap.objective import Batch, GatedProposals, admit_proposals, provenance
from ppo_dap.dap.proposals import ProposalDraws, Proposals, States, choose_states, propose
from ppo_dap.nets.adapters import Adapters, adapter_norm, init_adapters
from ppo_dap.nets.critic import Critic, QFunction, q_features
from ppo_dap.ppo.update import Rows
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig

Q_SPREAD_DECAY = 0.9
"""Memory of the running global scale of Q, an iteration each."""


class GuideState(eqx.Module):
    """Q, the adapters and their optimizers: none of it is PPO's."""

    q: QFunction
    q_optimizer: optax.OptState
    q_spread: Float[Array, ""]
    adapters: Adapters
    pet_optimizer: optax.OptState

    def proposer(self, denoiser: Denoiser, critic: Critic | None) -> Proposer:
        """With the frozen denoiser, and the critic whose trunk Q reads."""
        return Proposer(denoiser, self.adapters, self.q, self.q_spread, critic)


class Proposer(NamedTuple):
    """What proposals are made with: no optimizer, since each array that a stage is called with costs the host time."""

    denoiser: Denoiser
    adapters: Adapters
    q: QFunction
    q_spread: Float[Array, ""]
    critic: Critic | None


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


def on_policy(rows: Rows) -> OnPolicy:
    """PPO's rows as the guide sees them."""
    executed = jnp.clip(rows.actions, -1.0, 1.0)
    return OnPolicy(rows.state_ids, rows.raw_observations, rows.observations, executed, rows.q_targets, rows.weights)


def create_guide(
    rng: np.random.Generator, critic: Critic | None, sizes: tuple[int, int], config: Config, denoiser: Denoiser
) -> GuideState:
    """A fresh Q head and identity adapters for (observation, action) `sizes`; Q reads `critic`'s trunk."""
    own_trunk = config.q.q_trunk == "separate"
    q = QFunction.create(rng, *sizes, config.ppo.hidden_size, config.q.q_hidden_size, own_trunk)
    adapters = init_adapters(rng, denoiser, config.adaptation.adapter, config.adaptation.adapter_rank)
    return GuideState(
        q,
        q_learning.ADAM.init(q_learning.trainable(q, critic, config.q)),
        jnp.asarray(np.float32(1)),
        adapters,
        adaptation.ADAM.init(adapters),
    )


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
    diffusion: DiffusionConfig,
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
    proposals, metrics = propose(
        proposer.denoiser,
        proposer.adapters,
        proposer.q,
        states,
        draws,
        beta,
        proposer.q_spread,
        diffusion=diffusion,
        config=config.proposals,
    )
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
    metrics["spr"] = jnp.sum(gated.gate) / jnp.maximum(sum(part.wanted for part in parts), 1)
    return gated, Q_SPREAD_DECAY * guide.q_spread + (1 - Q_SPREAD_DECAY) * spread, metrics


def learn_q(
    guide: GuideState, critic: Critic | None, rows: OnPolicy, orders: Int[Array, "epochs rows"], *, config: Config
) -> tuple[QFunction, Critic | None, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 4, Q's part: one-step TD on the actions that were executed (clipped to the box)."""
    data = q_learning.QData(rows.observations, rows.actions, rows.q_targets, rows.weights)
    size = min(config.ppo.minibatch_size, rows.weights.shape[0])
    q, critic, optimizer, loss = q_learning.fit_q(
        guide.q, critic, guide.q_optimizer, data, orders, minibatch_size=size, config=config.q
    )
    return q, critic, optimizer, {"q_loss": loss}


def adapt_prior(
    guide: GuideState,
    denoiser: Denoiser,
    rows: OnPolicy,
    batch: Batch,
    num_steps: Int[Array, ""],
    draws: adaptation.PETDraws,
    *,
    config: Config,
    diffusion: DiffusionConfig,
) -> tuple[Adapters, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 5: PET on the actions that were executed."""
    data = adaptation.PETData(rows.state_ids, rows.raw_observations, rows.actions, rows.weights)
    adapters, optimizer, metrics = adaptation.adapt(
        denoiser,
        guide.adapters,
        guide.pet_optimizer,
        data,
        draws,
        num_steps,
        diffusion=diffusion,
        config=config.adaptation,
        check=lambda ids, observations: provenance(ids, observations, batch),
    )
    return adapters, optimizer, metrics | {"adapter_norm": adapter_norm(adapters)}
