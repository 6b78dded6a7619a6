"""The guide: what proposals are made with and learn by, and the stages of an iteration that are its own."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ppo_dap.config import Config
from ppo_dap.dap import adaptation, q_learning
from ppo_dap.dap.objective import Batch, GatedProposals, admit_proposals, provenance
from ppo_dap.dap.proposals import States, choose_states, propose
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
    key: PRNGKeyArray, critic: Critic | None, sizes: tuple[int, int], config: Config, denoiser: Denoiser
) -> GuideState:
    """A fresh Q head and identity adapters for (observation, action) `sizes`; Q reads `critic`'s trunk."""
    q_key, adapter_key = jax.random.split(key)
    own_trunk = config.q.q_trunk == "separate"
    q = QFunction.create(q_key, *sizes, config.ppo.hidden_size, config.q.q_hidden_size, own_trunk)
    adapters = init_adapters(adapter_key, denoiser, config.adaptation.adapter, config.adaptation.adapter_rank)
    return GuideState(
        q,
        q_learning.ADAM.init(q_learning.trainable(q, critic, config.q)),
        jnp.ones(()),
        adapters,
        adaptation.ADAM.init(adapters),
    )


def num_proposal_states(num_rows: int, config: Config) -> int:
    """States that get proposals: the same whole number for every minibatch of an epoch."""
    num_minibatches = max(1, num_rows // config.ppo.minibatch_size)
    return max(1, int(config.proposals.proposal_fraction * num_rows / num_minibatches)) * num_minibatches


def make_proposals(
    guide: GuideState,
    denoiser: Denoiser,
    critic: Critic | None,
    rows: OnPolicy,
    batch: Batch,
    beta: Float[Array, ""],
    key: PRNGKeyArray,
    *,
    config: Config,
    diffusion: DiffusionConfig,
) -> tuple[GatedProposals, Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Step 3: proposals on a random subset of D_on's states; also Q's new running scale, and metrics.

    Among them `spr`, Eq. 12: the share of the proposals whose states come from the current on-policy batch.
    """
    choose_key, propose_key = jax.random.split(key)
    index = choose_states(rows.weights, choose_key, num_proposal_states(rows.weights.shape[0], config))
    observations = rows.observations[index]
    states = States(
        rows.state_ids[index],
        rows.raw_observations[index],
        observations,
        q_features(critic, guide.q, observations, shared=False),
    )
    proposals, metrics = propose(
        denoiser,
        guide.adapters,
        guide.q,
        states,
        propose_key,
        beta,
        guide.q_spread,
        diffusion=diffusion,
        config=config.proposals,
    )
    gated = admit_proposals(proposals, batch)
    spread = Q_SPREAD_DECAY * guide.q_spread + (1 - Q_SPREAD_DECAY) * metrics.pop("q_spread")
    # Rows in which no transition happened fill up the subset when it wants more states than there are; the gate stops
    # them, and they are no proposals of another batch.
    expected = jnp.sum(batch.weights[index] > 0)
    return gated, spread, metrics | {"spr": jnp.sum(gated.gate) / jnp.maximum(expected, 1)}


def learn_q(
    guide: GuideState, critic: Critic | None, rows: OnPolicy, key: PRNGKeyArray, *, config: Config
) -> tuple[QFunction, Critic | None, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 4, Q's part: one-step TD on the actions that were executed (clipped to the box)."""
    data = q_learning.QData(rows.observations, rows.actions, rows.q_targets, rows.weights)
    size = min(config.ppo.minibatch_size, rows.weights.shape[0])
    q, critic, optimizer, loss = q_learning.fit_q(
        guide.q, critic, guide.q_optimizer, data, key, minibatch_size=size, config=config.q
    )
    return q, critic, optimizer, {"q_loss": loss}


def adapt_prior(
    guide: GuideState,
    denoiser: Denoiser,
    rows: OnPolicy,
    batch: Batch,
    num_steps: Int[Array, ""],
    key: PRNGKeyArray,
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
        key,
        num_steps,
        diffusion=diffusion,
        config=config.adaptation,
        check=lambda ids, observations: provenance(ids, observations, batch),
    )
    return adapters, optimizer, metrics | {"adapter_norm": adapter_norm(adapters)}
