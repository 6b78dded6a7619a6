"""The conditional normalising flow: RealNVP (Dinh et al., 2017) with the state fed to every coupling.

Sizes: n states, k actions a state, act action dimensions, obs observation dimensions, c numbers of condition.
Actions are scaled; the flow's last step is a tanh, so that all of its density lies within the box.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from ppo_dap.nets.adapters import Adapters
from ppo_dap.nets.mlp import MLP, Linear, silu
from ppo_dap.prior_config import FlowConfig
from ppo_dap.priors.network import network_inputs
from ppo_dap.priors.samplers import Field, Solver

LOG_SCALE_LIMIT = 2.0
"""Bound of one coupling's log-scale: no state, however odd, makes the flow overflow."""
EDGE = 1 - 1e-6
"""Largest action whose atanh is taken: at 1 it is infinite."""


class Coupling(eqx.Module):
    """x -> x exp(scale) + shift for some dimensions, with scale and shift from the others and from the state."""

    action_in: Linear
    hidden: Linear
    out: Linear

    @staticmethod
    def create(rng: np.random.Generator, action_size: int, width: int) -> Coupling:
        """A fresh coupling, near the identity."""
        return Coupling(
            Linear.lecun_normal(rng, action_size, width),
            Linear.lecun_normal(rng, width, width),
            Linear.lecun_normal(rng, width, 2 * action_size, 0.1),
        )

    def __call__(
        self, x: Float[Array, "n k act"], state: Float[Array, "n width"], kept: Bool[Array, " act"]
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k act"]]:
        """Log-scales and shifts, 0 for the dimensions that are `kept`, which are all that they depend on."""
        state, kept = state[:, None], kept[None, None]
        hidden = silu(self.hidden(silu(self.action_in(jnp.where(kept, x, 0.0)) + state)))
        raw, shift = jnp.split(self.out(hidden), 2, axis=-1)
        scale = LOG_SCALE_LIMIT * jnp.tanh(raw / LOG_SCALE_LIMIT)
        return jnp.where(kept, 0.0, scale), jnp.where(kept, 0.0, shift)


def kept_dimensions(couplings: int, action_size: int) -> Bool[np.ndarray, "couplings act"]:
    """Which dimensions each coupling keeps: the odd ones, the even ones, the second half, the first half, and again.

    The only dimension of an action of size 1 is never kept: such a flow is a squashed Gaussian.
    """
    dimensions = np.arange(action_size)
    odd, second = dimensions % 2 == 1, dimensions >= (action_size + 1) // 2
    kept = np.stack([(odd, ~odd, second, ~second)[i % 4] for i in range(couplings)])
    return kept & (action_size > 1)


class Flow(eqx.Module):
    """An action is tanh(spread * x), x the couplings' image of unit noise."""

    state_net: MLP
    couplings: Coupling
    """All of them, each array with an axis more: a loop compiles several times faster than so many copies."""
    observation_mean: Float[Array, " obs"]
    observation_std: Float[Array, " obs"]
    spread: Float[Array, ""]
    config: FlowConfig = eqx.field(static=True)

    @staticmethod
    def create(
        rng: np.random.Generator,
        config: FlowConfig,
        observation_mean: Float[Array, " obs"],
        observation_std: Float[Array, " obs"],
        action_spread: Float[Array, ""],
        action_size: int,
    ) -> Flow:
        """A fresh network, near a Gaussian of the logs' `action_spread` before its tanh."""
        inputs, width = observation_mean.shape[0] + config.num_conditions, config.width
        sizes = (inputs, config.state_width, config.state_width, width * config.couplings)
        couplings = [Coupling.create(rng, action_size, width) for _ in range(config.couplings)]
        return Flow(
            state_net=MLP.create(rng, sizes, "silu", 1.0),
            couplings=jax.tree.map(lambda *arrays: jnp.stack(arrays), *couplings),
            observation_mean=observation_mean,
            observation_std=observation_std,
            spread=action_spread,
            config=config,
        )

    def _action_size(self) -> int:
        return self.couplings.action_in.weight.shape[-1]

    def _layers(self, observations, condition):
        """Each coupling with its view of the state and the dimensions it keeps, from the noise to the action."""
        inputs = network_inputs(observations, condition, self.observation_mean, self.observation_std)
        # Once a state for all of its actions.
        states = jnp.stack(jnp.split(self.state_net(inputs), self.config.couplings, axis=-1))
        # The tag tells the data-flow proof that this array of the program's own is no data.
        kept = checkpoint_name(jnp.asarray(kept_dimensions(self.config.couplings, self._action_size())), "known")
        return self.couplings, states, kept

    def forward(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"], noise: Float[Array, "n k act"]
    ) -> Float[Array, "n k act"]:
        """Actions from unit noise."""

        def step(x, layer):
            coupling, state, kept = layer
            scale, shift = coupling(x, state, kept)
            return x * jnp.exp(scale) + shift, None

        x, _ = jax.lax.scan(step, noise, self._layers(observations, condition))
        return jnp.tanh(self.spread * x)

    def inverse(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"], actions: Float[Array, "n k act"]
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """The noise behind actions, and the log-determinant of its derivative by the action."""

        def step(carry, layer):
            (x, log_det), (coupling, state, kept) = carry, layer
            scale, shift = coupling(x, state, kept)
            return ((x - shift) * jnp.exp(-scale), log_det - jnp.sum(scale, axis=-1)), None

        spread = jax.lax.stop_gradient(self.spread)
        inside = jnp.clip(actions, -EDGE, EDGE)
        log_det = -jnp.sum(jnp.log1p(-jnp.square(inside)) + jnp.log(spread), axis=-1)
        start = jnp.arctanh(inside) / spread, log_det
        return jax.lax.scan(step, start, self._layers(observations, condition), reverse=True)[0]

    def log_prob(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"], actions: Float[Array, "n act"]
    ) -> Float[Array, " n"]:
        """Exact log-density of scaled actions, in nats; an action on the box's edge counts as just inside."""
        noise, log_det = self.inverse(observations, condition, actions[:, None])
        return (jnp.sum(jax.scipy.stats.norm.logpdf(noise), axis=-1) + log_det)[:, 0]

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """Shape of the unit noise of `sample`."""
        return (states, num, self._action_size())

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
        """k actions a state; nothing guides them."""
        return self.forward(observations, condition, noise), jnp.zeros(noise.shape[:2])

    def draw_loss(self, rng: np.random.Generator, *shape: int) -> Float[np.ndarray, "*shape act"]:
        """Dequantization noise, uniform in [-1, 1)."""
        return 2 * rng.random((*shape, self._action_size()), dtype=np.float32) - 1

    def loss(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        actions: Float[Array, "n act"],
        draws: Float[Array, "n act"],
        adapters: Adapters | None = None,
    ) -> Float[Array, ""]:
        """Mean negative log-likelihood of the dequantized actions, in nats.

        Shrunk by as much as the noise is wide, they stay within the box.
        """
        width = self.config.dequantization
        return -jnp.mean(self.log_prob(observations, condition, (1 - width) * actions + width * draws))
