"""The Gaussian actor and the closed forms of its distribution. Actions are scaled: [-1, 1] is the task's box."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.mlp import MLP


class Actor(eqx.Module):
    """pi_theta(a | s): a tanh MLP gives the mean, a free vector the log standard deviation. Unsquashed."""

    mlp: MLP
    log_std: Float[Array, " act"]

    @staticmethod
    def create(rng: np.random.Generator, observation_size: int, action_size: int, hidden_size: int) -> Actor:
        """Orthogonal start, gain 0.01 on the mean head, standard deviation 1."""
        sizes = (observation_size, hidden_size, hidden_size, action_size)
        return Actor(MLP.create(rng, sizes, "tanh", final_gain=0.01), on_device(np.zeros(action_size)))

    def __call__(self, observations: Float[Array, "n obs"]) -> Float[Array, "n act"]:
        """Means at normalised observations."""
        return self.mlp(observations)


def log_prob(
    actions: Float[Array, "*n act"], mean: Float[Array, "*n act"], log_std: Float[Array, " act"]
) -> Float[Array, "*n"]:
    """Log-density of a diagonal Gaussian with state-independent spread."""
    log_std = jnp.broadcast_to(log_std, mean.shape)
    z = (actions - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * math.log(2 * math.pi), axis=-1)


def gaussian_kl(
    mean_p: Float[Array, "n act"],
    log_std_p: Float[Array, "#n act"],
    mean_q: Float[Array, "n act"],
    log_std_q: Float[Array, "#n act"],
) -> Float[Array, " n"]:
    """KL(p || q) of diagonal Gaussians, a row each, in nats."""
    variance_ratio = jnp.exp(2 * (log_std_p - log_std_q))
    shift = ((mean_p - mean_q) * jnp.exp(-log_std_q)) ** 2
    return jnp.sum(0.5 * (variance_ratio + shift - 1) + log_std_q - log_std_p, axis=-1)


def tree_norm(tree) -> Float[Array, ""]:
    """Euclidean norm over all leaves."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)))
