"""Sampling from a denoiser: the stochastic solver of Eq. 8 and a second-order one that needs half the steps (4.7).

Sizes: n states, k proposals a state, act action dimensions. A sampler knows no network: `denoise(x, sigma)` is the
denoised action of x at noise level sigma, `drift(x, sigma)` the guidance term alpha_t grad Q of Eq. 8, already capped.
All actions are scaled to [-1, 1]; denoised actions are clamped to that box, and so is the result.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ppo_dap.errors import unknown

Field = Callable[[Array, Array], Array]
"""A function of (x, sigma), shapes (n, k, act) and (), with the shape of x."""


def karras_sigmas(num_steps: int, sigma_min: float, sigma_max: float, rho: float) -> Float[Array, " levels"]:
    """Karras et al. (2022), Eq. 5: `num_steps` falling noise levels, then 0."""
    ramp = jnp.linspace(1.0, 0.0, num_steps)
    low, high = sigma_min ** (1 / rho), sigma_max ** (1 / rho)
    return jnp.append((low + ramp * (high - low)) ** rho, 0.0)


def ancestral(
    denoise: Field,
    sigmas: Float[Array, " levels"],
    noise: Float[Array, "levels n k act"],
    drift: Field | None = None,
    displacement_cap: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
    """Equation 8: a_{t-1} = mu(a_t, s, t) + sigma_t z + alpha_t grad Q(s, a_t).

    mu and sigma_t are mean and spread of the noisier action's exact step back, given its denoised value (DDPM's
    posterior). Returns the actions and, per proposal, the summed norms of the guidance steps.
    """
    remaining = jnp.square(sigmas[1:] / sigmas[:-1])
    spreads = sigmas[1:] * jnp.sqrt(1 - remaining)

    def step(carry, inputs):
        x, displacement = carry
        sigma, share, spread, z = inputs
        denoised = jnp.clip(denoise(x, sigma), -1.0, 1.0)
        mean = denoised + share * (x - denoised)
        return _guide(mean + spread * z, x, sigma, drift, displacement, displacement_cap), None

    start = (sigmas[0] * noise[0], jnp.zeros(noise.shape[1:3], noise.dtype))
    (x, displacement), _ = jax.lax.scan(step, start, (sigmas[:-1], remaining, spreads, noise[1:]))
    return jnp.clip(x, -1.0, 1.0), displacement


def dpmpp_2m(
    denoise: Field,
    sigmas: Float[Array, " levels"],
    noise: Float[Array, "draws n k act"],
    drift: Field | None = None,
    displacement_cap: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
    """DPM-Solver++ 2M (Lu et al., 2022, Algorithm 2) with Eq. 8's guidance: deterministic after the start `noise[0]`.

    Each step extrapolates the denoised action from the last two, which makes it second order in log(sigma).
    """
    log_sigmas = jnp.log(jnp.maximum(sigmas, jnp.finfo(sigmas.dtype).tiny))
    steps = log_sigmas[:-1] - log_sigmas[1:]
    # h_i / (2 h_{i-1}); a step without a predecessor or down to 0 noise stays first order.
    slopes = jnp.concatenate([jnp.zeros(1), steps[1:] / (2 * steps[:-1])])
    slopes = jnp.where(sigmas[1:] > 0, slopes, 0.0)

    def step(carry, inputs):
        x, displacement, previous = carry
        sigma, ratio, slope = inputs
        denoised = jnp.clip(denoise(x, sigma), -1.0, 1.0)
        target = denoised + slope * (denoised - previous)
        moved = _guide(target + ratio * (x - target), x, sigma, drift, displacement, displacement_cap)
        return (*moved, denoised), None

    start = (sigmas[0] * noise[0], jnp.zeros(noise.shape[1:3], noise.dtype), jnp.zeros_like(noise[0]))
    (x, displacement, _), _ = jax.lax.scan(step, start, (sigmas[:-1], sigmas[1:] / sigmas[:-1], slopes))
    return jnp.clip(x, -1.0, 1.0), displacement


def _guide(stepped, x, sigma, drift, displacement, cap):
    """Add the guidance at x to the sampler's own step, shortened so that its total norm stays within `cap`."""
    if drift is None:
        return stepped, displacement
    push = drift(x, sigma)
    norm = jnp.sqrt(jnp.sum(jnp.square(push), axis=-1))
    if cap is not None:
        allowed = jnp.clip(cap - displacement, 0.0, norm)
        push = push * (allowed / jnp.maximum(norm, jnp.finfo(norm.dtype).tiny))[..., None]
        norm = allowed
    return stepped + push, displacement + norm


def centred_start(denoise: Field, sigma: Float[Array, ""], noise: Float[Array, "n k act"]) -> Float[Array, "n k act"]:
    """Unit noise whose `sigma`-fold is spread around what the denoiser expects, not around 0.

    A noisy action really has the mean of the actions. A deterministic solver keeps such an offset: with modes 0.45 and
    -0.4 it is 0.013 in their shares at sigma = 5. The stochastic one forgets it.
    """
    return noise + denoise(sigma * noise, sigma) / sigma


SAMPLERS = {"ancestral": ancestral, "dpmpp_2m": dpmpp_2m}


class Solver(NamedTuple):
    """A sampler by name, its number of steps, and how far it goes towards what the prior is asked for."""

    name: str
    num_steps: int
    condition_weight: float = 1.0
    """Classifier-free guidance (Ho & Salimans, 2022): 1 is the conditioned prior, 0 the unconditioned one."""

    def noise_shape(self, *size: int) -> tuple[int, ...]:
        """Shape of the unit noise for actions of `size`: all of it is drawn before the loop, the deterministic
        solver's is its start alone. Raises `InputError` for an unknown sampler.
        """
        if self.name not in SAMPLERS:
            raise unknown("sampler", self.name, SAMPLERS)
        return (1 if self.name == "dpmpp_2m" else self.num_steps + 1, *size)
