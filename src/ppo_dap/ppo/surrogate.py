"""The importance ratio (Eq. 4), the clipped surrogate (Eq. 5), and what compared PPOs have in its place.

ABPPO, PPO-GC and PPO-ARC are reconstructions: their papers could not be read, and no code of theirs is public.

Values that the data-flow proof looks for are tagged with `checkpoint_name`, which changes nothing in the program.
"""

from __future__ import annotations

import functools
import math

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


def generalised_clip_surrogate(
    ratio: Float[Array, " n"],
    advantages: Float[Array, " n"],
    weights: Float[Array, " n"],
    clip_epsilon: float,
    slope: float,
) -> Float[Array, ""]:
    """PPO-GC (Cheng et al. 2024), a reconstruction: E[min(r A, F(r) A)], where F is r inside the clip range and goes on
    from its ends with `slope` outside: 0 is Eq. 5, 1 is E[r A], below 0 rolls back.
    """
    advantages = checkpoint_name(advantages, "advantages")
    clipped = jnp.clip(ratio, 1 - clip_epsilon, 1 + clip_epsilon)
    relaxed = clipped + slope * (ratio - clipped)
    return weighted_mean(jnp.minimum(ratio * advantages, relaxed * advantages), weights)


def authentic_boundary_surrogate(
    ratio: Float[Array, " n"],
    advantages: Float[Array, " n"],
    weights: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, ""]:
    """ABPPO (Cheng, Huang and Wang 2022), a reconstruction: Eq. 5 with a range for each row (`authentic_bounds`)."""
    advantages = checkpoint_name(advantages, "advantages")
    clipped = jnp.clip(ratio, lower, upper)
    return weighted_mean(jnp.minimum(ratio * advantages, clipped * advantages), weights)


def authentic_bounds(z: Float[Array, "n act"], boundary_kl: float) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """ABPPO (Cheng, Huang and Wang 2022), a reconstruction: smallest and largest ratio within a trust region.

    `z` is (a - mu_old) / sigma_old. The bounds are over all policies that differ from the old one by a shift of the
    mean with KL(pi_old || pi) of at most `boundary_kl` nats. A change of the spread is not in them: close to the mean,
    where no shift makes an action more likely, the upper bound is 1.
    """
    distance = jnp.sqrt(jnp.sum(jnp.square(z), axis=-1))
    radius = math.sqrt(2 * boundary_kl)
    towards = jnp.minimum(radius, distance)
    return jnp.exp(-radius * distance - boundary_kl), jnp.exp(towards * distance - 0.5 * jnp.square(towards))


@functools.cache
def default_boundary_kl(action_size: int, clip_epsilon: float) -> float:
    """KL in nats at which `authentic_bounds`' upper bound is 1 + clip_epsilon on average over the old policy's actions.

    The average is over |z|, which follows the chi distribution with `action_size` degrees of freedom.
    """
    from scipy.integrate import quad
    from scipy.optimize import root_scalar

    log_norm = (action_size / 2 - 1) * math.log(2) + math.lgamma(action_size / 2)

    def excess(radius: float) -> float:
        def integrand(distance: float) -> float:
            towards = min(radius, distance)
            log_density = (action_size - 1) * math.log(distance) - 0.5 * distance**2 - log_norm
            return math.exp(towards * distance - 0.5 * towards**2 + log_density)

        # Beyond the radius the integrand falls off like a Gaussian around a point short of `far`.
        far = 2 * radius + math.sqrt(action_size)
        pieces = ((0.0, radius), (radius, far), (far, far + 40.0))
        return sum(quad(integrand, *piece, limit=200)[0] for piece in pieces) - 1 - clip_epsilon

    largest = 1.0
    while excess(largest) < 0:
        largest *= 2
    return 0.5 * root_scalar(excess, bracket=(0.0, largest), xtol=1e-12).root ** 2


def centred_surrogate(
    ratio: Float[Array, " n"],
    centre: Float[Array, " n"],
    advantages: Float[Array, " n"],
    weights: Float[Array, " n"],
    clip_epsilon: float,
) -> Float[Array, ""]:
    """PPO-ARC (Cheng, Guo and Wang 2024), a reconstruction after GePPO (Queeney et al. 2021): Eq. 5 on rows of an older
    policy mu, E[min(r A, clip(r, c - eps, c + eps) A)] with r = pi_theta / mu and c = pi_k / mu.
    """
    advantages = checkpoint_name(advantages, "advantages")
    clipped = jnp.clip(ratio, centre - clip_epsilon, centre + clip_epsilon)
    return weighted_mean(jnp.minimum(ratio * advantages, clipped * advantages), weights)


def weighted_mean(values: Float[Array, " n"], weights: Float[Array, " n"]) -> Float[Array, ""]:
    """Mean over the rows with weight, 0 when there is none."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-8)


def share(part: Float[Array, ""], whole: Float[Array, ""]) -> Float[Array, ""]:
    """part / whole, and exactly 1 where they are the same.

    A GPU's quotient of equal numbers need not be; nor a CPU's by a constant, which XLA makes a product.
    """
    return jnp.where(part == whole, 1.0, part / whole)


def normalise(advantages: Float[Array, " n"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Advantages to mean 0 and standard deviation 1 over the rows with weight."""
    mean = weighted_mean(advantages, weights)
    variance = weighted_mean(jnp.square(advantages - mean), weights)
    return (advantages - mean) / (jnp.sqrt(variance) + 1e-8)
