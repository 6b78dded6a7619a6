"""What every prior's network is: p(a | s, c) as a pytree of arrays, with its settings in a static field `config`.

Sizes: n states, k actions a state, act action dimensions, obs observation dimensions, c numbers of condition. Inside a
network actions are scaled: the action space's box is [-1, 1]. Observations are raw: a network has the moments of its
logs. A condition of zeros asks for nothing in particular.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.adapters import Adapters
from ppo_dap.priors.samplers import Field, Solver

OBSERVATION_CLIP = 10.0


def network_inputs(
    observations: Float[Array, "n obs"],
    condition: Float[Array, "n c"],
    mean: Float[Array, " obs"],
    std: Float[Array, " obs"],
) -> Float[Array, "n inputs"]:
    """What a network sees of the state: the observation in the logs' standard deviations, clipped, and the condition.

    No gradient enters the moments, which are those of the logs and stay so.
    """
    mean, std = jax.lax.stop_gradient((mean, std))
    shape = observations.shape
    normalised = (observations - jnp.broadcast_to(mean, shape)) / jnp.broadcast_to(std, shape)
    return jnp.concatenate([jnp.clip(normalised, -OBSERVATION_CLIP, OBSERVATION_CLIP), condition], axis=-1)


class Rows(NamedTuple):
    """Rows to fit to, with scaled actions."""

    observations: Float[Array, "rows obs"]
    condition: Float[Array, "rows c"]
    actions: Float[Array, "rows act"]


@runtime_checkable
class ClosedForm(Protocol):
    """A network whose distribution is a Gaussian that it can name: no proxy has to be estimated from samples."""

    def gaussian(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"]
    ) -> tuple[Float[Array, "n act"], Float[Array, "n act"]]:
        """Mean and standard deviation at each state."""
        ...


@runtime_checkable
class Network(Protocol):
    """A family of conditional distributions, of which an instance is one."""

    config: Any
    """Its settings, hashable."""

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """Shape of the unit normal noise from which `num` actions for each of `states` are made."""
        ...

    def sample(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        noise: Float[Array, ...],
        solver: Solver,
        adapters: Adapters | None = None,
        drift: Field | None = None,
        displacement_cap: float | None = None,
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """k actions a state, within the box, and how far guidance moved each: a function of the noise and no other
        randomness. `solver`, `adapters` and `drift` are the diffusion prior's; others are given None for the latter.
        """
        ...


@runtime_checkable
class TrainedNetwork(Network, Protocol):
    """A family that is fitted by descent on a loss."""

    @staticmethod
    def create(
        rng: np.random.Generator,
        config: Any,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        action_spread: Float[Array, ""],
        action_size: int,
    ) -> TrainedNetwork:
        """A network before its fit, for logs with these moments (of all scaled actions together: their spread)."""
        ...

    def draw_loss(self, rng: np.random.Generator, *shape: int) -> Any:
        """The random numbers of `loss` over rows of `shape`, (*steps, n), as a pytree with these leading axes."""
        ...

    def loss(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        actions: Float[Array, "n act"],
        draws: Any,
        adapters: Adapters | None = None,
    ) -> Float[Array, ""]:
        """What the fit minimises."""
        ...


class BuiltNetwork(Network, Protocol):
    """A family that is made of its rows at once, with nothing to train; the random control has `blank` alone."""

    @staticmethod
    def build(train: Rows, held_out: Rows, config: Any, rng: np.random.Generator) -> tuple[Any, dict[str, Any]]:
        """The network, and a summary with `rows`, `steps` (0), `validation_loss` and whatever else there is to say."""
        ...

    @staticmethod
    def blank(config: Any, tensors: Mapping[str, np.ndarray]) -> Any:
        """The shapes of a saved one, for reading it from the `tensors` of its prior's file."""
        ...
