"""Generalised advantage estimation (Schulman et al. 2016; 3.2)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def gae(
    rewards: Float[Array, "time envs"],
    values: Float[Array, "time envs"],
    next_values: Float[Array, "time envs"],
    terminated: Bool[Array, "time envs"],
    truncated: Bool[Array, "time envs"],
    valid: Bool[Array, "time envs"],
    gamma: float,
    gae_lambda: float,
) -> Float[Array, "time envs"]:
    """Advantages. `next_values` are V at the true successors, final observations included.

    A termination has no value after it; a truncation does, and both end the recursion. Rows that are not `valid` get 0.
    """
    deltas = rewards + gamma * jnp.where(terminated, 0.0, next_values) - values
    carries_on = ~(terminated | truncated)

    def backwards(advantage, row):
        delta, carry_on, is_valid = row
        advantage = delta + gamma * gae_lambda * jnp.where(carry_on, advantage, 0.0)
        advantage = jnp.where(is_valid, advantage, 0.0)
        return advantage, advantage

    _, advantages = jax.lax.scan(backwards, jnp.zeros_like(values[0]), (deltas, carries_on, valid), reverse=True)
    return advantages
