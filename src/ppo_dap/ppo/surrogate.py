"""The importance ratio (Eq. 4) and the clipped surrogate (Eq. 5).

Values that the data-flow proof looks for are tagged with `checkpoint_name`, which changes nothing in the program.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float


def importance_ratio(log_probs: Float[Array, " n"], old_log_probs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Eq. 4: pi_theta(a | s) / pi_theta_old(a | s)."""
    return checkpoint_name(jnp.exp(log_probs - old_log_probs), "ratio")


def clipped_surrogate(
    ratio: Float[Array, " n"], advantages: Float[Array, " n"], weights: Float[Array, " n"], clip_epsilon: float
) -> Float[Array, ""]:
    """Eq. 5: E[min(r A, clip(r, 1 - eps, 1 + eps) A)], to be maximised; a mean over rows by `weights` (0 masks)."""
    advantages = checkpoint_name(advantages, "advantages")
    clipped = jnp.clip(ratio, 1 - clip_epsilon, 1 + clip_epsilon)
    return weighted_mean(jnp.minimum(ratio * advantages, clipped * advantages), weights)


def weighted_mean(values: Float[Array, " n"], weights: Float[Array, " n"]) -> Float[Array, ""]:
    """Mean over the rows with weight, 0 when there is none."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-8)


def normalise(advantages: Float[Array, " n"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Advantages to mean 0 and standard deviation 1 over the rows with weight."""
    mean = weighted_mean(advantages, weights)
    variance = weighted_mean(jnp.square(advantages - mean), weights)
    return (advantages - mean) / (jnp.sqrt(variance) + 1e-8)
