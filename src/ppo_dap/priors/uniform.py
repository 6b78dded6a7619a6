"""The random control's network: uniform over the action space's box, whatever the state."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.adapters import Adapters
from ppo_dap.prior_config import RandomConfig
from ppo_dap.priors.samplers import Field, Solver


class Uniform(eqx.Module):
    """p(a | s) = 1 / volume of the box."""

    centre: Float[Array, " act"]
    """Zeros: they say how many dimensions there are."""
    config: RandomConfig = eqx.field(static=True)

    @staticmethod
    def blank(config: RandomConfig, tensors: Mapping[str, np.ndarray]) -> Uniform:
        """The shapes of a saved one."""
        return jax.eval_shape(lambda: Uniform(jnp.zeros(tensors["action_low"].shape), config))

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """A number for each of the action's."""
        return (states, num, self.centre.shape[0])

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
        """k actions a state, from the noise through the normal distribution function; nothing guides them."""
        uniform = 2 * jax.scipy.special.ndtr(noise) - 1
        return jnp.broadcast_to(self.centre, noise.shape) + uniform, jnp.zeros(noise.shape[:2], jnp.float32)
