"""The diffusion prior's denoiser and its loss (Section 4.2, Eq. 6), preconditioned as in Karras et al. (2022).

Sizes: n states, k noisy actions a state, act action dimensions, obs observation dimensions, c numbers of condition.
All actions are scaled: the action space's box is [-1, 1].
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from ppo_dap.nets.adapters import Adapters, apply_hidden, merge
from ppo_dap.nets.mlp import MLP, Linear, silu
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors.network import network_inputs
from ppo_dap.priors.samplers import SAMPLERS, Field, Solver, centred_start, karras_sigmas

NOISE_FREQUENCIES = 8


class Denoiser(eqx.Module):
    """D(x; sigma, s) = c_skip x + c_out F(c_in x, sigma, s): the expected action behind the noisy action x.

    State and noise level shift the first layer, and scale and shift each hidden one (FiLM, Perez et al., 2018). That
    costs a product of vectors where a wider or deeper network for the actions would cost one of matrices.
    """

    state_net: MLP
    action_in: Linear
    noise_in: Linear
    hidden: tuple[Linear, ...]
    out: Linear
    observation_mean: Float[Array, " obs"]
    observation_std: Float[Array, " obs"]
    sigma_data: Float[Array, ""]
    config: DiffusionConfig = eqx.field(static=True)

    @staticmethod
    def create(
        rng: np.random.Generator,
        config: DiffusionConfig,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        sigma_data: Float[Array, ""],
        action_size: int,
    ) -> Denoiser:
        """A fresh network; the moments and `sigma_data` (spread of the scaled actions) are those of the logs."""
        width = config.width
        inputs = observation_mean.shape[0] + config.num_conditions
        conditioned = width * (1 + 2 * config.depth)
        return Denoiser(
            state_net=MLP.create(rng, (inputs, config.state_width, config.state_width, conditioned), "silu", 1.0),
            action_in=Linear.lecun_normal(rng, action_size, width),
            noise_in=Linear.lecun_normal(rng, 2 * NOISE_FREQUENCIES + 1, conditioned),
            hidden=tuple(Linear.lecun_normal(rng, width, width, 2**0.5) for _ in range(config.depth)),
            # A small output starts D near c_skip x, the best guess that ignores the state.
            out=Linear.lecun_normal(rng, width, action_size, 0.1),
            observation_mean=observation_mean,
            observation_std=observation_std,
            sigma_data=sigma_data,
            config=config,
        )

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """Shape of the unit noise of `sample`."""
        return solver.noise_shape(states, num, self.out.weight.shape[0])

    def sample(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        noise: Float[Array, "draws n k act"],
        solver: Solver,
        adapters: Adapters | None = None,
        drift: Field | None = None,
        displacement_cap: float | None = None,
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """k actions a state, and how far guidance moved each."""
        options = {"drift": drift, "displacement_cap": displacement_cap}
        return sample_actions(self, adapters, observations, condition, noise, solver, self.config, **options)

    def draw_loss(self, rng: np.random.Generator, *shape: int) -> LossDraws:
        """The random numbers of `loss` over rows of `shape`, (*steps, n)."""
        return LossDraws.make(rng, *shape, self.out.weight.shape[0])

    def loss(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        actions: Float[Array, "n act"],
        draws: LossDraws,
        adapters: Adapters | None = None,
    ) -> Float[Array, ""]:
        """Eq. 6; in the adapters alone, L_PET."""
        return denoising_loss(self, adapters, observations, condition, actions, draws, self.config)

    def embed(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"]
    ) -> Float[Array, "n conditioned"]:
        """What F needs to know about the state: computed once a state, used at every step of all its k actions."""
        return self.state_net(network_inputs(observations, condition, self.observation_mean, self.observation_std))

    def __call__(
        self,
        x: Float[Array, "n k act"],
        embedding: Float[Array, "n conditioned"],
        sigma: Float[Array, ""] | Float[Array, "n k"],
        adapters: Adapters | None = None,
    ) -> Float[Array, "n k act"]:
        """The denoised actions; a scalar `sigma` is embedded once for all of them."""
        sigma = sigma.reshape(1, 1) if sigma.ndim == 0 else sigma
        c_skip, c_out, c_in = preconditioning(sigma[..., None], jax.lax.stop_gradient(self.sigma_data))
        noise = self.noise_in(noise_features(sigma))
        # One sum for all layers before it meets the proposals: with one sigma for all it is a row a state.
        first, *rest = jnp.split(embedding[:, None, :] + noise, 1 + 2 * len(self.hidden), axis=-1)
        h = silu(self.action_in(c_in * x) + first)
        for i, layer in enumerate(self.hidden):
            adapter = None if adapters is None else adapters.layers[i]
            scale, shift = rest[2 * i], rest[2 * i + 1]
            h = apply_hidden(layer, adapter, h, lambda y, a=scale, b=shift: y * (1 + a) + b)
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


class LossDraws(NamedTuple):
    """The random numbers of one denoising loss over n rows; with a leading axis, those of several."""

    uniform: Float[Array, "*steps n"]
    """Where in its stratum each row's sigma lies."""
    noise: Float[Array, "*steps n act"]

    @staticmethod
    def make(rng: np.random.Generator, *shape: int) -> LossDraws:
        """Draws for rows of actions of `shape`, (*steps, n, act)."""
        return LossDraws(rng.random(shape[:-1], dtype=np.float32), rng.standard_normal(shape, dtype=np.float32))  # type: ignore[arg-type]


def spread_sigmas(
    uniform: Float[Array, " n"], sigma_data: Float[Array, ""], config: DiffusionConfig
) -> Float[Array, " n"]:
    """sigma ~ P(sigma), one in each of n equally likely strata, which takes most of the loss's variance away.

    Row i gets stratum i, so rows must come in random order.
    """
    low, high = jnp.log(config.sigma_min), jnp.log(config.sigma_max)
    num = uniform.shape[0]
    u = (jnp.arange(num) + uniform) / num
    if config.noise_distribution == "loguniform":
        return jnp.exp(low + u * (high - low))
    # Karras et al.'s N(-1.2, 1.2^2) is for data of spread 0.5; relative to the data's own spread it is this.
    # The tag tells the data-flow proof that the arrays in it are the function's coefficients.
    z = checkpoint_name(jax.scipy.special.ndtri(jnp.clip(u, 1e-6, 1 - 1e-6)), "known")
    return jnp.exp(jnp.clip(jnp.log(sigma_data) - 0.5 + 1.2 * z, low, high))


def denoising_loss(
    denoiser: Denoiser,
    adapters: Adapters | None,
    observations: Float[Array, "n obs"],
    condition: Float[Array, "n c"],
    actions: Float[Array, "n act"],
    draws: LossDraws,
    config: DiffusionConfig,
) -> Float[Array, ""]:
    """Equation 6: squared error of the denoised action, over sigma ~ P(sigma) and Gaussian noise.

    With on-policy rows and differentiated in the adapters alone, this is L_PET of Section 4.2.
    """
    sigma_data = jax.lax.stop_gradient(denoiser.sigma_data)
    sigma = spread_sigmas(draws.uniform, sigma_data, config)
    noisy = actions + sigma[:, None] * draws.noise
    embedding = denoiser.embed(observations, condition)
    denoised = denoiser(noisy[:, None, :], embedding, sigma[:, None], adapters)[:, 0, :]
    errors = jnp.sum(jnp.square(denoised - actions), axis=-1)
    if config.loss_weighting == "edm":
        errors = errors * (jnp.square(sigma) + jnp.square(sigma_data)) / jnp.square(sigma * sigma_data)
    return jnp.mean(errors)


def sample_actions(
    denoiser: Denoiser,
    adapters: Adapters | None,
    observations: Float[Array, "n obs"],
    condition: Float[Array, "n c"],
    noise: Float[Array, "draws n k act"],
    solver: Solver,
    config: DiffusionConfig,
    *,
    drift: Field | None = None,
    displacement_cap: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
    """k actions a state from `noise` of the shape `solver.noise_shape` gives, and how far guidance moved each."""
    denoiser, adapters = merge(denoiser, adapters)
    embedding = denoiser.embed(observations, condition)
    sigmas = karras_sigmas(solver.num_steps, config.sigma_min, config.sigma_max, config.rho)

    def denoise(x, sigma):
        return denoiser(x, embedding, sigma, adapters)

    if solver.condition_weight != 1 and config.num_conditions:
        free, asked = denoiser.embed(observations, jnp.zeros_like(condition)), denoise

        def denoise(x, sigma):
            unconditioned = denoiser(x, free, sigma, adapters)
            return unconditioned + solver.condition_weight * (asked(x, sigma) - unconditioned)

    if solver.name == "dpmpp_2m":
        noise = centred_start(denoise, sigmas[0], noise[0])[None]
    return SAMPLERS[solver.name](denoise, sigmas, noise, drift, displacement_cap)
