"""The conditional variational autoencoder (Sohn et al., 2015) with the loss of BCQ (Fujimoto et al., 2019).

Sizes: n states, k actions a state, act action dimensions, z latent numbers, obs observation dimensions, c numbers of
condition. Actions are scaled.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.adapters import Adapters
from ppo_dap.nets.mlp import MLP
from ppo_dap.prior_config import VAEConfig
from ppo_dap.priors.network import network_inputs
from ppo_dap.priors.samplers import Field, Solver

LOG_STD_LIMITS = (-4.0, 15.0)
"""Of a latent number, as BCQ clips them."""


class VAE(eqx.Module):
    """An action is tanh(decoder(s, z)) with z ~ N(0, I).

    BCQ draws its actions with z clipped to [-0.5, 0.5], which stays near the likeliest ones. A prior's samples must
    have the logs' spread, so here z is not clipped.
    """

    encoder: MLP
    decoder: MLP
    observation_mean: Float[Array, " obs"]
    observation_std: Float[Array, " obs"]
    config: VAEConfig = eqx.field(static=True)

    @staticmethod
    def create(
        rng: np.random.Generator,
        config: VAEConfig,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        action_spread: Float[Array, ""],
        action_size: int,
    ) -> VAE:
        """A fresh network; it needs no `action_spread`."""
        inputs = observation_mean.shape[0] + config.num_conditions
        latent = config.latents_per_action * action_size
        hidden = (config.width, config.width)
        return VAE(
            encoder=MLP.create(rng, (inputs + action_size, *hidden, 2 * latent), "silu", 0.1),
            decoder=MLP.create(rng, (inputs + latent, *hidden, action_size), "silu", 1.0),
            observation_mean=observation_mean,
            observation_std=observation_std,
            config=config,
        )

    def _inputs(self, observations, condition):
        return network_inputs(observations, condition, self.observation_mean, self.observation_std)

    def _latent_size(self) -> int:
        return self.encoder.layers[-1].weight.shape[0] // 2

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """Shape of the unit noise of `sample`: the latent code."""
        return (states, num, self._latent_size())

    def sample(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        noise: Float[Array, "n k z"],
        solver: Solver,
        adapters: Adapters | None = None,
        drift: Field | None = None,
        displacement_cap: float | None = None,
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """k actions a state; nothing guides them."""
        inputs = self._inputs(observations, condition)[:, None]
        inputs = jnp.broadcast_to(inputs, (*noise.shape[:2], inputs.shape[-1]))
        return jnp.tanh(self.decoder(jnp.concatenate([inputs, noise], axis=-1))), jnp.zeros(noise.shape[:2])

    def draw_loss(self, rng: np.random.Generator, *shape: int) -> Float[np.ndarray, "*shape z"]:
        """Unit noise of the latent code."""
        return rng.standard_normal((*shape, self._latent_size()), dtype=np.float32)

    def encode(
        self, inputs: Float[Array, "n inputs"], actions: Float[Array, "n act"]
    ) -> tuple[Float[Array, "n z"], Float[Array, "n z"]]:
        """Mean and log standard deviation of q(z | s, a)."""
        mean, log_std = jnp.split(self.encoder(jnp.concatenate([inputs, actions], axis=-1)), 2, axis=-1)
        return mean, jnp.clip(log_std, *LOG_STD_LIMITS)

    def loss(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        actions: Float[Array, "n act"],
        draws: Float[Array, "n z"],
        adapters: Adapters | None = None,
    ) -> Float[Array, ""]:
        """Mean squared error of the decoded action plus `kl_weight` times the mean KL(q(z | s, a) || N(0, 1)).

        Both are means over rows and numbers, as in BCQ. With 2 latents a dimension and weight 0.5 that is the evidence
        bound of a decoder with noise of variance 1/8, which `sample` does not add: spread below 0.35 is lost.
        """
        inputs = self._inputs(observations, condition)
        mean, log_std = self.encode(inputs, actions)
        latent = mean + jnp.exp(log_std) * draws
        decoded = jnp.tanh(self.decoder(jnp.concatenate([inputs, latent], axis=-1)))
        kl = 0.5 * (jnp.square(mean) + jnp.exp(2 * log_std) - 1) - log_std
        return jnp.mean(jnp.square(decoded - actions)) + self.config.kl_weight * jnp.mean(kl)
