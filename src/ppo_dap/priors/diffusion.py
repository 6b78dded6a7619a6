"""The diffusion prior's denoiser and its loss (Section 4.2, Eq. 6), preconditioned as in Karras et al. (2022).

Sizes: n states, k noisy actions a state, act action dimensions, obs observation dimensions, c numbers of condition.
All actions are scaled: the action space's box is [-1, 1].
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ppo_dap.errors import InputError, unknown
from ppo_dap.nets.adapters import Adapters, apply_hidden
from ppo_dap.nets.mlp import MLP, Linear, silu

NOISE_FREQUENCIES = 8
OBSERVATION_CLIP = 10.0


@dataclass(frozen=True)
class DiffusionConfig:
    """Network, noise range, fit and default sampler of a diffusion prior."""

    width: int = 128
    """Units of every hidden layer."""
    depth: int = 2
    """Hidden layers between the first and the output layer: the place of the adapters."""
    num_conditions: int = 0
    """Numbers beside the observation that the prior is conditioned on."""
    sigma_min: float = 0.02
    """Smallest noise level, in scaled actions."""
    sigma_max: float = 5.0
    """Largest noise level; must exceed the box's width for the start to forget the action."""
    rho: float = 7.0
    """Spacing of the sampling levels (Karras et al., Eq. 5)."""
    noise_distribution: Literal["lognormal", "loguniform"] = "lognormal"
    """P(sigma) of Eq. 6."""
    loss_weighting: Literal["edm", "none"] = "edm"
    """Weight of a noise level in the loss: Karras et al.'s, which lets each level count the same, or Eq. 6 as is."""
    batch_size: int = 512
    """Rows of one step of the fit."""
    learning_rate: float = 5e-3
    """Adam's rate after warm-up; falls to 0 along a cosine over `max_steps`."""
    warmup_steps: int = 200
    """Steps over which the rate rises from 0."""
    max_steps: int = 6_000
    """Most steps of the fit."""
    chunk_steps: int = 200
    """Steps between two looks at the held-out loss."""
    patience: int = 10
    """Looks at the held-out loss without a better one before the fit stops."""
    ema_decay: float = 0.999
    """Decay of the averaged weights, which are the ones that are validated and kept."""
    validation_fraction: float = 0.1
    """Share of the episodes that is held out."""
    sampler: Literal["ancestral", "dpmpp_2m"] = "ancestral"
    """Solver of `Prior.sample`."""
    sampler_steps: int = 20
    """Denoising steps of `Prior.sample`."""

    def __post_init__(self):
        for f in dataclasses.fields(self):
            _validate(f.name, getattr(self, f.name), f.default)
        if not self.sigma_min < self.sigma_max:
            raise InputError(f"sigma_min {self.sigma_min} must be below sigma_max {self.sigma_max}")
        for name in ("validation_fraction", "ema_decay"):
            if getattr(self, name) >= 1:
                raise InputError(f"{name} must be below 1, not {getattr(self, name)!r}")


_MAY_BE_ZERO = ("num_conditions", "warmup_steps", "ema_decay")
_CHOICES = {
    "noise_distribution": ("lognormal", "loguniform"),
    "loss_weighting": ("edm", "none"),
    "sampler": ("ancestral", "dpmpp_2m"),
}


def _validate(name: str, value: Any, default: object) -> None:
    """Refuse a value that is not of its default's type, or not in its range."""
    if name in _CHOICES:
        if value not in _CHOICES[name]:
            raise unknown(f"value of {name}", value, _CHOICES[name])
        return
    kind, right = (int, "an integer") if isinstance(default, int) else (int | float, "a number")
    right += " of 0 or more" if name in _MAY_BE_ZERO else " above 0"
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if not (is_number and (value >= 0 if name in _MAY_BE_ZERO else value > 0)):
        raise InputError(f"{name} must be {right}, not {value!r}")


class Denoiser(eqx.Module):
    """D(x; sigma, s) = c_skip x + c_out F(c_in x, sigma, s): the expected action behind the noisy action x."""

    state_net: MLP
    action_in: Linear
    noise_in: Linear
    hidden: tuple[Linear, ...]
    out: Linear
    observation_mean: Float[Array, " obs"]
    observation_std: Float[Array, " obs"]
    sigma_data: Float[Array, ""]

    @staticmethod
    def create(
        key: PRNGKeyArray,
        config: DiffusionConfig,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        sigma_data: Float[Array, ""],
        action_size: int,
    ) -> Denoiser:
        """A fresh network; the moments and `sigma_data` (spread of the scaled actions) are those of the logs."""
        width = config.width
        keys = jax.random.split(key, 4 + config.depth)
        inputs = observation_mean.shape[0] + config.num_conditions
        return Denoiser(
            state_net=MLP.create(keys[0], (inputs, width, width), "silu", 1.0),
            action_in=Linear.lecun_normal(keys[1], action_size, width),
            noise_in=Linear.lecun_normal(keys[2], 2 * NOISE_FREQUENCIES + 1, width),
            hidden=tuple(Linear.lecun_normal(k, width, width, 2**0.5) for k in keys[4:]),
            # A small output starts D near c_skip x, the best guess that ignores the state.
            out=Linear.lecun_normal(keys[3], width, action_size, 0.1),
            observation_mean=observation_mean,
            observation_std=observation_std,
            sigma_data=sigma_data,
        )

    def embed(self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"]) -> Float[Array, "n width"]:
        """What F needs to know about the state: computed once a state, used at every step of all its k actions."""
        mean, std = jax.lax.stop_gradient((self.observation_mean, self.observation_std))
        shape = observations.shape
        normalised = (observations - jnp.broadcast_to(mean, shape)) / jnp.broadcast_to(std, shape)
        clipped = jnp.clip(normalised, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        return self.state_net(jnp.concatenate([clipped, condition], axis=-1))

    def __call__(
        self,
        x: Float[Array, "n k act"],
        embedding: Float[Array, "n width"],
        sigma: Float[Array, ""] | Float[Array, "n k"],
        adapters: Adapters | None = None,
    ) -> Float[Array, "n k act"]:
        """The denoised actions; a scalar `sigma` is embedded once for all of them."""
        sigma = sigma.reshape(1, 1) if sigma.ndim == 0 else sigma
        c_skip, c_out, c_in = preconditioning(sigma[..., None], jax.lax.stop_gradient(self.sigma_data))
        h = self.action_in(c_in * x) + embedding[:, None, :] + self.noise_in(noise_features(sigma))
        h = silu(h)
        for i, layer in enumerate(self.hidden):
            h = apply_hidden(layer, None if adapters is None else adapters.layers[i], h)
        return c_skip * x + c_out * self.out(h)


def preconditioning(
    sigma: Float[Array, "*batch"], sigma_data: Float[Array, ""]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
    """c_skip, c_out, c_in of Karras et al. (2022), Table 1: F sees and predicts numbers of unit spread."""
    total = jnp.square(sigma) + jnp.square(sigma_data)
    return jnp.square(sigma_data) / total, sigma * sigma_data * jax.lax.rsqrt(total), jax.lax.rsqrt(total)


def noise_features(sigma: Float[Array, "*batch"]) -> Float[Array, "*batch features"]:
    """c_noise = log(sigma) / 4 with a few of its sines and cosines."""
    c_noise = jnp.log(sigma)[..., None] / 4
    angles = jnp.pi / 2 * jnp.concatenate([c_noise * (j + 1) for j in range(NOISE_FREQUENCIES)], axis=-1)
    return jnp.concatenate([c_noise, jnp.sin(angles), jnp.cos(angles)], axis=-1)


def draw_sigmas(
    key: PRNGKeyArray, num: int, sigma_data: Float[Array, ""], config: DiffusionConfig
) -> Float[Array, " {num}"]:
    """sigma ~ P(sigma), one in each of `num` equally likely strata, which takes most of the loss's variance away.

    Row i gets stratum i, so rows must come in random order.
    """
    low, high = jnp.log(config.sigma_min), jnp.log(config.sigma_max)
    u = (jnp.arange(num) + jax.random.uniform(key, (num,))) / num
    if config.noise_distribution == "loguniform":
        return jnp.exp(low + u * (high - low))
    # Karras et al.'s N(-1.2, 1.2^2) is for data of spread 0.5; relative to the data's own spread it is this.
    z = jax.scipy.special.ndtri(jnp.clip(u, 1e-6, 1 - 1e-6))
    return jnp.exp(jnp.clip(jnp.log(sigma_data) - 0.5 + 1.2 * z, low, high))


def denoising_loss(
    denoiser: Denoiser,
    adapters: Adapters | None,
    observations: Float[Array, "n obs"],
    condition: Float[Array, "n c"],
    actions: Float[Array, "n act"],
    key: PRNGKeyArray,
    config: DiffusionConfig,
) -> Float[Array, ""]:
    """Equation 6: squared error of the denoised action, over sigma ~ P(sigma) and Gaussian noise.

    With on-policy rows and differentiated in the adapters alone, this is L_PET of Section 4.2.
    """
    sigma_key, noise_key = jax.random.split(key)
    sigma_data = jax.lax.stop_gradient(denoiser.sigma_data)
    sigma = draw_sigmas(sigma_key, actions.shape[0], sigma_data, config)
    noisy = actions + sigma[:, None] * jax.random.normal(noise_key, actions.shape, actions.dtype)
    embedding = denoiser.embed(observations, condition)
    denoised = denoiser(noisy[:, None, :], embedding, sigma[:, None], adapters)[:, 0, :]
    errors = jnp.sum(jnp.square(denoised - actions), axis=-1)
    if config.loss_weighting == "edm":
        errors = errors * (jnp.square(sigma) + jnp.square(sigma_data)) / jnp.square(sigma * sigma_data)
    return jnp.mean(errors)
