"""Value guidance of proposals (4.3): energy weights (Eq. 7) and the gradient step inside the denoising (Eq. 8)."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def beta_schedule(progress: float, beta_max: float, anneal: float) -> float:
    """Energy temperature at `progress` (0 to 1) of the run: linear from 0 to `beta_max` over the first `anneal`."""
    return beta_max * min(1.0, progress / anneal)


def energy_weights(
    q: Float[Array, "n k"],
    beta: Float[Array, ""],
    scale: Float[Array, ""],
    kept: Bool[Array, "n k"],
    log_density: Float[Array, "n k"] | None = None,
) -> Float[Array, "n k"]:
    """Eq. 7: w_i proportional to exp(beta Q(s, a_i)) over the `kept` proposals, summing to 1 in each state.

    `scale` divides Q: one number for all states, so that a state in which all actions are alike keeps even weights.
    `log_density` is added to the exponent: kappa log pi(a_i | s), for weights that seek the policy's own mode.
    """
    energy = beta * q / scale
    if log_density is not None:
        energy = energy + log_density
    energy = jnp.where(kept, energy, -jnp.inf)
    # The state's largest energy, not its mean, is taken off: the same weights, and no overflow.
    weights = jnp.exp(energy - jnp.max(energy, axis=1, keepdims=True))
    return weights / jnp.sum(weights, axis=1, keepdims=True)


def within_state_spread(q: Float[Array, "n k"]) -> Float[Array, ""]:
    """Root of the mean over states of Q's variance among a state's proposals."""
    return jnp.sqrt(jnp.mean(jnp.var(q, axis=1)))


def top_k_mask(q: Float[Array, "n k"], top_k: int | None) -> Bool[Array, "n k"]:
    """True for the `top_k` proposals with the highest Q in each state (all when None); ties keep the first."""
    if top_k is None:
        return jnp.ones(q.shape, bool)
    ranks = jnp.argsort(jnp.argsort(-q, axis=1, stable=True), axis=1, stable=True)
    return ranks < top_k


def farthest(actions: Float[Array, "n k act"], num: int) -> Int[Array, "n num"]:
    """Indices of `num` actions of each state that lie far apart: the first, then each time the one whose nearest chosen
    one is farthest (Gonzalez, 1985).
    """
    distances = jnp.sum(jnp.square(actions[:, :, None, :] - actions[:, None, :, :]), axis=-1)
    chosen, nearest = [jnp.zeros(actions.shape[0], jnp.int32)], distances[:, 0]
    for _ in range(num - 1):
        chosen.append(jnp.argmax(nearest, axis=1).astype(jnp.int32))
        to_last = jnp.take_along_axis(distances, chosen[-1][:, None, None], axis=1)[:, 0]
        nearest = jnp.minimum(nearest, to_last)
    return jnp.stack(chosen, axis=1)


def effective_sample_size(weights: Float[Array, "n k"]) -> Float[Array, " n"]:
    """ESS = 1 / sum of squared weights (5.6)."""
    return 1.0 / jnp.sum(jnp.square(weights), axis=1)


def alpha_schedule(sigma: Float[Array, ""], sigma_max: float, alpha_max: float) -> Float[Array, ""]:
    """Noise-aware strength (4.3): alpha_max (1 - sigma_t / sigma_max), so 0 where there is only noise."""
    return alpha_max * (1.0 - sigma / sigma_max)


def guidance_step(
    q_gradient: Float[Array, "n k act"], alpha: Float[Array, ""], cap: float, cap_on: Literal["step", "gradient"]
) -> Float[Array, "n k act"]:
    """The last term of Eq. 8, alpha_t grad_a Q, with its norm capped at `cap` (4.3).

    With `cap_on = "gradient"` it is grad Q whose norm is capped, before alpha_t (Table 2).
    """
    if cap_on == "gradient":
        return alpha * clip_norm(q_gradient, cap)
    return clip_norm(alpha * q_gradient, cap)


def clip_norm(vectors: Float[Array, "n k act"], cap: float) -> Float[Array, "n k act"]:
    """Each vector shortened to norm `cap` where it is longer."""
    norm = jnp.sqrt(jnp.sum(jnp.square(vectors), axis=-1, keepdims=True))
    return vectors * jnp.minimum(1.0, cap / jnp.maximum(norm, 1e-12))
