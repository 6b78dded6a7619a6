"""The critic: one trunk with a value head, and the action-value function that guides proposals."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.mlp import MLP, Linear


class Critic(eqx.Module):
    """V_phi(s): tanh trunk and a linear head."""

    trunk: MLP
    v_head: Linear

    @staticmethod
    def create(rng: np.random.Generator, observation_size: int, hidden_size: int) -> Critic:
        """Orthogonal start, gain 1 on the value head."""
        return Critic(create_trunk(rng, observation_size, hidden_size), Linear.orthogonal(rng, hidden_size, 1, 1.0))

    def features(self, observations: Float[Array, "n obs"]) -> Float[Array, "n width"]:
        """The trunk's features, which Q may read."""
        return jnp.tanh(self.trunk(observations))

    def __call__(self, observations: Float[Array, "n obs"]) -> Float[Array, " n"]:
        """Values, in scaled-reward units."""
        return self.v_head(self.features(observations))[:, 0]


def create_trunk(rng: np.random.Generator, observation_size: int, hidden_size: int) -> MLP:
    """Two layers of `hidden_size`; `Critic.features` squashes the last one too."""
    return MLP.create(rng, (observation_size, hidden_size, hidden_size), "tanh", final_gain=2**0.5)


class QHead(eqx.Module):
    """Features and action to a number: the state part is computed once per state, the action part once per proposal."""

    state: Linear
    action: Linear
    out: Linear

    @staticmethod
    def create(rng: np.random.Generator, feature_size: int, action_size: int, hidden_size: int) -> QHead:
        """Orthogonal start."""
        return QHead(
            Linear.orthogonal(rng, feature_size, hidden_size, 2**0.5),
            Linear.orthogonal(rng, action_size, hidden_size, 2**0.5),
            Linear.orthogonal(rng, hidden_size, 1, 1.0),
        )

    def __call__(self, features: Float[Array, "n width"], actions: Float[Array, "n k act"]) -> Float[Array, "n k"]:
        """The head's value of k actions of each state."""
        hidden = jnp.tanh(self.state(features)[:, None, :] + self.action(actions))
        return self.out(hidden)[..., 0]


class QFunction(eqx.Module):
    """Q_phi(s, a) for guidance only: one head, or several that differ by their start."""

    trunk: MLP | None
    heads: tuple[QHead, ...]

    @staticmethod
    def create(
        rng: np.random.Generator,
        observation_size: int,
        action_size: int,
        feature_size: int,
        hidden_size: int,
        own_trunk: bool,
        num_heads: int = 1,
    ) -> QFunction:
        """Heads on features of `feature_size`, with a trunk of their own when `own_trunk`."""
        trunk = create_trunk(rng, observation_size, feature_size) if own_trunk else None
        heads = (QHead.create(rng, feature_size, action_size, hidden_size) for _ in range(num_heads))
        return QFunction(trunk, tuple(heads))

    def __call__(
        self, features: Float[Array, "n width"], actions: Float[Array, "n k act"], pessimism: float = 0.0
    ) -> Float[Array, "n k"]:
        """Q at k actions of each state, in scaled-reward units; actions are scaled.

        It is the heads' mean less `pessimism` times their spread: a lower bound.
        """
        if len(self.heads) == 1:
            return self.heads[0](features, actions)
        values = jnp.stack([head(features, actions) for head in self.heads])
        mean = jnp.mean(values, axis=0)
        return mean - pessimism * jnp.sqrt(jnp.var(values, axis=0) + 1e-12)


def q_features(
    critic: Critic | None, q: QFunction, observations: Float[Array, "n obs"], shared: bool
) -> Float[Array, "n width"]:
    """What Q reads: its own trunk if it has one, else V's trunk, with the gradient stopped unless `shared`."""
    if q.trunk is not None:
        return jnp.tanh(q.trunk(observations))
    if critic is None:
        raise ValueError("a Q without a trunk of its own reads a critic's")
    features = critic.features(observations)
    return features if shared else jax.lax.stop_gradient(features)
