"""The cloned behaviour pi_BC(a | s): a diagonal Gaussian, fitted by its likelihood.

Sizes: n states, k actions a state, act action dimensions, obs observation dimensions, c numbers of condition.
Actions are scaled, and the Gaussian is not cut at the box; only its samples are.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.adapters import Adapters
from ppo_dap.nets.mlp import MLP
from ppo_dap.prior_config import BehaviourConfig
from ppo_dap.priors.network import network_inputs
from ppo_dap.priors.samplers import Field, Solver


class ClonedGaussian(eqx.Module):
    """N(mean(s), diag(std(s)^2)).

    The spread depends on the state: logs of several behaviours agree in some states and not in others, and one spread
    for all would pull the policy hardest just where the logs say least.
    """

    net: MLP
    observation_mean: Float[Array, " obs"]
    observation_std: Float[Array, " obs"]
    config: BehaviourConfig = eqx.field(static=True)

    @staticmethod
    def create(
        rng: np.random.Generator,
        config: BehaviourConfig,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        action_spread: Float[Array, ""],
        action_size: int,
    ) -> ClonedGaussian:
        """A fresh network; starts near mean 0 and standard deviation 1, whatever the logs' `action_spread`."""
        inputs = observation_mean.shape[0] + config.num_conditions
        net = MLP.create(rng, (inputs, config.width, config.width, 2 * action_size), "silu", 0.1)
        return ClonedGaussian(net, observation_mean, observation_std, config)

    def gaussian(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"]
    ) -> tuple[Float[Array, "n act"], Float[Array, "n act"]]:
        """Mean and standard deviation in scaled actions: what the exact KL to the clone takes."""
        inputs = network_inputs(observations, condition, self.observation_mean, self.observation_std)
        mean, free = jnp.split(self.net(inputs), 2, axis=-1)
        # Softplus, not a maximum: a spread that was once below the floor still has a gradient that brings it back.
        floor = self.config.log_std_floor
        return mean, jnp.exp(floor + jax.nn.softplus(free - floor))

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """Shape of the unit noise of `sample`."""
        return (states, num, self.net.layers[-1].weight.shape[0] // 2)

    def sample(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        noise: Float[Array, "n k act"],
        solver: Solver,
        adapters: Adapters | None = None,
        drift: Field | None = None,
        displacement_cap: float | None = None,
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """k actions a state, clipped to the box; nothing guides them."""
        mean, std = (x[:, None] for x in self.gaussian(observations, condition))
        return jnp.clip(mean + std * noise, -1.0, 1.0), jnp.zeros(noise.shape[:2])

    def draw_loss(self, rng: np.random.Generator, *shape: int) -> tuple[()]:
        """The likelihood takes no random numbers."""
        return ()

    def loss(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        actions: Float[Array, "n act"],
        draws: tuple[()] = (),
        adapters: Adapters | None = None,
    ) -> Float[Array, ""]:
        """Mean negative log-likelihood of the actions, in nats."""
        mean, std = self.gaussian(observations, condition)
        return -jnp.mean(jnp.sum(jax.scipy.stats.norm.logpdf(actions, mean, std), axis=-1))
