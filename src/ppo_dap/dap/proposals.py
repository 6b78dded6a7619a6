"""Step 3 of Algorithm 1: D_syn, value-guided proposals on states of D_on, and their Gaussian proxy (Eq. 10)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ppo_dap.config import ProposalConfig
from ppo_dap.dap.guidance import (
    alpha_schedule,
    effective_sample_size,
    energy_weights,
    guidance_step,
    top_k_mask,
    within_state_spread,
)
from ppo_dap.nets.adapters import Adapters
from ppo_dap.nets.critic import QFunction
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig
from ppo_dap.priors.samplers import Field, sample_actions


class Proposals(eqx.Module):
    """D_syn: proposals with the provenance of their states. Actions are scaled to [-1, 1]."""

    state_ids: Int[Array, " n"]
    """The ids of the states in D_on; whoever uses a proposal asserts that its id is in the current batch."""
    raw_observations: Float[Array, "n obs"]
    """The states themselves, so that an id cannot stand for another state."""
    observations: Float[Array, "n obs"]
    """The same as the policy sees them (normalised)."""
    actions: Float[Array, "n k act"]
    """After guidance and resampling."""
    proxy_mean: Float[Array, "n act"]
    proxy_std: Float[Array, "n act"]


class States(eqx.Module):
    """The states of D_on that get proposals."""

    state_ids: Int[Array, " n"]
    raw_observations: Float[Array, "n obs"]
    """What the prior reads (it has a normaliser of its own, from its logs)."""
    observations: Float[Array, "n obs"]
    """What the policy reads."""
    features: Float[Array, "n width"]
    """What Q reads."""


def choose_states(weights: Float[Array, " rows"], key: PRNGKeyArray, num: int) -> Int[Array, " {num}"]:
    """Indices of `num` different rows of D_on, uniform over those with weight (rows without come last)."""
    order = jnp.where(weights > 0, jax.random.uniform(key, weights.shape), 2.0)
    return jnp.argsort(order)[:num]


def propose(
    denoiser: Denoiser,
    adapters: Adapters | None,
    q: QFunction,
    states: States,
    key: PRNGKeyArray,
    beta: Float[Array, ""],
    q_spread: Float[Array, ""],
    *,
    diffusion: DiffusionConfig,
    config: ProposalConfig,
) -> tuple[Proposals, dict[str, Float[Array, ""]]]:
    """K proposals a state: sampled, steered by grad Q (Eq. 8), filtered, weighted by Q (Eq. 7), resampled.

    `q_spread` is the running global scale of Q; the metric `q_spread` is this batch's, to update it with.
    """
    sample_key, resample_key = jax.random.split(key)
    drift = q_drift(q, states.features, diffusion.sigma_max, config) if "gradient" in config.guidance else None
    candidates, displacement = sample_actions(
        denoiser,
        adapters,
        states.raw_observations,
        jnp.zeros((states.observations.shape[0], diffusion.num_conditions)),
        sample_key,
        config.num_proposals,
        diffusion,
        sampler=config.sampler,
        num_steps=config.sampler_steps,
        drift=drift,
        displacement_cap=config.displacement_cap,
    )
    candidates = checkpoint_name(jax.lax.stop_gradient(candidates), "proposals")
    values = q(states.features, candidates)
    scale = jnp.maximum(q_spread, 1e-6) if config.q_scale == "running" else jnp.ones(())
    beta = beta if "energy" in config.guidance else jnp.zeros(())
    weights = energy_weights(values, beta, scale, top_k_mask(values, config.top_k))
    if "energy" in config.guidance or config.top_k is not None:
        chosen = jax.random.categorical(
            resample_key, jnp.log(weights)[:, None, :], axis=-1, shape=(weights.shape[0], config.num_proposals)
        )
    else:
        chosen = jnp.broadcast_to(jnp.arange(config.num_proposals)[None], weights.shape)
    actions = jnp.take_along_axis(candidates, chosen[..., None], axis=1)
    mean, std = gaussian_proxy(actions, config.proxy_std_floor)
    proposals = Proposals(states.state_ids, states.raw_observations, states.observations, actions, mean, std)
    metrics = {
        "q_spread": within_state_spread(values),
        "ess": jnp.mean(effective_sample_size(weights)),
        "high_q_rate": high_q_rate(values, chosen),
        "acceptance": acceptance(chosen),
        "guided_displacement": jnp.mean(displacement),
    }
    return proposals, metrics


def q_drift(q: QFunction, features: Float[Array, "n width"], sigma_max: float, config: ProposalConfig) -> Field:
    """The last term of Eq. 8 as a field of (noisy action, noise level)."""
    q_gradient = jax.grad(lambda actions: jnp.sum(q(features, actions)))

    def drift(x: Float[Array, "n k act"], sigma: Float[Array, ""]) -> Float[Array, "n k act"]:
        alpha = alpha_schedule(sigma, sigma_max, config.alpha_max)
        return guidance_step(q_gradient(x), alpha, config.guidance_cap, config.cap_on)

    return drift


def gaussian_proxy(
    actions: Float[Array, "n k act"], std_floor: float
) -> tuple[Float[Array, "n act"], Float[Array, "n act"]]:
    """Eq. 10: diagonal Gaussian with the moments of the k proposals; the spread gets a floor."""
    mean = jnp.mean(actions, axis=1)
    return mean, jnp.maximum(jnp.std(actions, axis=1), std_floor)


def high_q_rate(values: Float[Array, "n k"], chosen: Int[Array, "n k"]) -> Float[Array, ""]:
    """Share of D_syn at or above its state's 90th percentile of Q over the candidates (5.6)."""
    threshold = jnp.quantile(values, 0.9, axis=1, keepdims=True)
    return jnp.mean(jnp.take_along_axis(values, chosen, axis=1) >= threshold)


def acceptance(chosen: Int[Array, "n k"]) -> Float[Array, ""]:
    """Share of a state's candidates that are in D_syn after filtering and resampling (5.5)."""
    k = chosen.shape[1]
    present = jnp.any(chosen[:, :, None] == jnp.arange(k)[None, None, :], axis=1)
    return jnp.mean(present.astype(jnp.float32))
