"""Step 3 of Algorithm 1: D_syn, value-guided proposals on states of D_on, and their Gaussian proxy (Eq. 10)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from ppo_dap.config import ProposalConfig
from ppo_dap.dap.calibration import Calibration
from ppo_dap.dap.guidance import (
    alpha_schedule,
    effective_sample_size,
    energy_weights,
    farthest,
    guidance_step,
    top_k_mask,
    within_state_spread,
)
from ppo_dap.nets.actor import Actor, log_prob
from ppo_dap.nets.adapters import Adapters
from ppo_dap.nets.critic import Critic, QFunction
from ppo_dap.priors.network import ClosedForm, Network
from ppo_dap.priors.samplers import Field, Solver


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


class Proposer(NamedTuple):
    """What proposals are made with: no optimizer, since each array that a stage is called with costs the host time."""

    prior: Network
    condition: Float[Array, " c"]
    """What the prior is asked for."""
    adapters: Adapters | None
    q: QFunction
    q_spread: Float[Array, ""]
    """Running global scale of Q."""
    q_rank: Float[Array, ""]
    """Running rank correlation of Q - V with the advantages of fresh rows."""
    calibration: Calibration | None
    critic: Critic | None
    """Whose trunk Q reads, unless Q has its own."""
    actor: Actor | None
    """For weights that seek its mode."""

    def value(
        self, features: Float[Array, "n width"], actions: Float[Array, "n k act"], config: ProposalConfig
    ) -> Float[Array, "n k"]:
        """Q as proposals see it."""
        values = self.q(features, actions, config.q_pessimism)
        return values if self.calibration is None else self.calibration(values)


class ProposalDraws(NamedTuple):
    """The random numbers of the proposals on one part of D_on."""

    order: Float[Array, " rows"]
    """Uniform; the states with the smallest get proposals."""
    noise: Float[Array, ...]
    """Unit noise of the sampler."""
    resample: Float[Array, "n kept"]
    """Uniform; for drawing D_syn by the energy weights."""

    @staticmethod
    def make(rng: np.random.Generator, rows: int, states: int, prior: Network, config: ProposalConfig):
        """Draws for proposals of `prior` on `states` of `rows`."""
        k = config.num_proposals
        noise = prior.noise_shape(solver(config), states, k)
        kept = config.keep_diverse or k
        uniforms = (rng.random(shape, dtype=np.float32) for shape in ((rows,), (states, kept)))
        return ProposalDraws(next(uniforms), rng.standard_normal(noise, dtype=np.float32), next(uniforms))  # type: ignore[arg-type]


def solver(config: ProposalConfig) -> Solver:
    """The configured sampler."""
    return Solver(config.sampler, config.sampler_steps, config.prior_return_weight)


def choose_states(weights: Float[Array, " rows"], uniform: Float[Array, " rows"], num: int) -> Int[Array, " {num}"]:
    """Indices of `num` different rows of D_on, uniform over those with weight (rows without come last)."""
    return jnp.argsort(jnp.where(weights > 0, uniform, 2.0))[:num]


def propose(
    proposer: Proposer, states: States, draws: ProposalDraws, beta: Float[Array, ""], *, config: ProposalConfig
) -> tuple[Proposals, dict[str, Float[Array, ""]]]:
    """K proposals a state: sampled, steered by grad Q (Eq. 8), filtered, weighted by Q (Eq. 7), resampled.

    The metric `q_spread` is this batch's, to update the running global scale of Q with.
    """
    trust = jnp.clip(proposer.q_rank, 0.0, 1.0) if config.guidance_gate else None
    candidates, displacement = _sample(proposer, states, draws.noise, trust, config)
    if config.keep_diverse is not None:
        chosen = farthest(candidates, config.keep_diverse)
        candidates = jnp.take_along_axis(candidates, chosen[..., None], axis=1)
        displacement = jnp.take_along_axis(displacement, chosen, axis=1)
    candidates = checkpoint_name(jax.lax.stop_gradient(candidates), "proposals")
    values = proposer.value(states.features, candidates, config)
    weights = _weights(proposer, states, candidates, values, beta if trust is None else beta * trust, config)
    if weighted(config):
        chosen = resample(weights, draws.resample)
    else:
        chosen = jnp.broadcast_to(jnp.arange(weights.shape[1])[None], weights.shape)
    actions = jnp.take_along_axis(candidates, chosen[..., None], axis=1)
    mean, std = gaussian_proxy(actions, config.proxy_std_floor)
    if not weighted(config) and isinstance(proposer.prior, ClosedForm):
        asked = conditions(proposer.condition, actions.shape[0])
        mean, std = proposer.prior.gaussian(states.raw_observations, asked)
    # Tagged once more: Q and the prior have chosen and weighted since, and this is how they get at the policy.
    actions, mean, std = (checkpoint_name(x, "proposals") for x in (actions, mean, std))
    proposals = Proposals(states.state_ids, states.raw_observations, states.observations, actions, mean, std)
    metrics = {
        "q_spread": within_state_spread(values),
        "ess": jnp.mean(effective_sample_size(weights)),
        "high_q_rate": high_q_rate(values, chosen),
        "acceptance": acceptance(chosen),
        "guided_displacement": jnp.mean(displacement),
    }
    return proposals, metrics


def weighted(config: ProposalConfig) -> bool:
    """Whether D_syn is drawn from the candidates by weights; else it is the candidates themselves."""
    return "energy" in config.guidance or config.top_k is not None or config.mode_seeking > 0


def conditions(condition: Float[Array, " c"], num: int) -> Float[Array, "{num} c"]:
    """The same condition for each of `num` states."""
    return jnp.broadcast_to(condition[None], (num, condition.shape[0]))


def _sample(proposer: Proposer, states: States, noise, trust, config: ProposalConfig):
    """The prior's K actions a state, guided where that is asked for, and how far guidance moved each."""
    drift, prior = None, proposer.prior
    if "gradient" in config.guidance:

        def value(actions):
            return proposer.value(states.features, actions, config)

        drift = q_drift(value, prior.config.sigma_max, config, trust)
    return prior.sample(
        states.raw_observations,
        conditions(proposer.condition, states.observations.shape[0]),
        noise,
        solver(config),
        proposer.adapters,
        drift,
        config.displacement_cap,
    )


def _weights(proposer: Proposer, states: States, candidates, values, beta, config: ProposalConfig):
    """Energy weights (Eq. 7), with the policy's own density where weights seek its mode."""
    scale = jnp.maximum(proposer.q_spread, 1e-6) if config.q_scale == "running" else jnp.ones(())
    beta = beta if "energy" in config.guidance else jnp.zeros(())
    log_density = None
    if config.mode_seeking > 0 and proposer.actor is not None:
        means = jnp.broadcast_to(proposer.actor(states.observations)[:, None, :], candidates.shape)
        log_density = config.mode_seeking * log_prob(candidates, means, proposer.actor.log_std)
    return energy_weights(values, beta, scale, top_k_mask(values, config.top_k), log_density)


def q_drift(
    value: Callable[[Array], Array], sigma_max: float, config: ProposalConfig, trust: Float[Array, ""] | None = None
) -> Field:
    """The last term of Eq. 8 as a field of (noisy action, noise level), for `value`: actions (n, k, act) to Q (n, k).

    `trust` multiplies alpha.
    """
    q_gradient = jax.grad(lambda actions: jnp.sum(value(actions)))

    def drift(x: Float[Array, "n k act"], sigma: Float[Array, ""]) -> Float[Array, "n k act"]:
        alpha = alpha_schedule(sigma, sigma_max, config.alpha_max)
        alpha = alpha if trust is None else alpha * trust
        return guidance_step(q_gradient(x), alpha, config.guidance_cap, config.cap_on)

    return drift


def resample(weights: Float[Array, "n k"], uniform: Float[Array, "n draws"]) -> Int[Array, "n draws"]:
    """Indices drawn with replacement by `weights`, from uniform numbers through the inverse distribution function."""
    edges = jnp.cumsum(weights, axis=1)
    # Scaled by the last edge: rounding must not leave a gap above it. The strict comparison never lands on weight 0.
    reached = (uniform * edges[:, -1:])[:, :, None] >= edges[:, None, :]
    return jnp.minimum(jnp.sum(reached, axis=-1), weights.shape[1] - 1)


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
