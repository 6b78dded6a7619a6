"""Step 5 of Algorithm 1: parameter-efficient tuning of the prior on D_on (4.2, L_PET)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ppo_dap.config import AdaptationConfig
from ppo_dap.nets.adapters import Adapters, Backbone
from ppo_dap.ppo.surrogate import share
from ppo_dap.priors.network import TrainedNetwork

Provenance = Callable[[Int[Array, " n"], Float[Array, "n obs"]], Float[Array, " n"]]
"""(state_ids, raw states) -> 1 for each that is a row of D_on, else 0."""

ADAM: Any = optax.scale_by_adam(eps=1e-8)


def is_tuned(prior: Any, config: AdaptationConfig) -> TypeGuard[TrainedNetwork]:
    """Whether PET tunes this prior: it has hidden layers for adapters, and the frequency is not 0."""
    return config.pet_frequency > 0 and isinstance(prior, Backbone)


class PETData(eqx.Module):
    """What PET draws its minibatches from. Actions are scaled and clipped: what the environment executed."""

    state_ids: Int[Array, " rows"]
    observations: Float[Array, "rows obs"]
    """Raw: the prior has its own normaliser."""
    actions: Float[Array, "rows act"]
    weights: Float[Array, " rows"]


class PETDraws(NamedTuple):
    """The random numbers of as many PET steps as an iteration can have; those that are not due go unused."""

    rows: Float[Array, "steps batch"]
    """Uniform; which rows each step sees."""
    loss: Any
    """As the prior draws them."""

    @staticmethod
    def make(rng: np.random.Generator, prior: TrainedNetwork, actor_updates: int, config: AdaptationConfig):
        """Draws for an iteration of `actor_updates`."""
        most = max(1, -(-config.pet_frequency * actor_updates // 100))  # a loop of no steps is traced all the same
        size = (most, config.pet_minibatch_size)
        return PETDraws(rng.random(size, dtype=np.float32), prior.draw_loss(rng, *size))  # type: ignore[arg-type]


def steps_until(iteration: int, pet_frequency: int, actor_updates: int) -> int:
    """PET steps due in all of the first `iteration` iterations: f for every 100 actor updates, rounded down."""
    return iteration * pet_frequency * actor_updates // 100


def adapt(
    prior: TrainedNetwork,
    adapters: Adapters,
    optimizer: optax.OptState,
    rows: PETData,
    draws: PETDraws,
    num_steps: Int[Array, ""],
    *,
    config: AdaptationConfig,
    check: Provenance,
) -> tuple[Adapters, optax.OptState, dict[str, Float[Array, ""]]]:
    """`num_steps` Adam steps of L_PET in the adapters alone; the backbone is frozen.

    Every minibatch goes through `check`; the metric `pet_spr` is the smallest share of a minibatch that passed.
    """
    # On fresh rows nothing is known of the episode's return.
    condition = jnp.zeros((config.pet_minibatch_size, prior.config.num_conditions))
    # Rows without weight (no transition happened) come last and are never drawn.
    order = jnp.argsort(-rows.weights, stable=True)
    num_valid = jnp.sum(rows.weights)

    def step(i, carry):
        adapters, optimizer, total, spr = carry
        uniform, noise = jax.tree.map(lambda x: x[i], draws)
        index = order[jnp.floor(uniform * num_valid).astype(jnp.int32)]
        batch = jax.tree.map(lambda x: x[index], rows)
        loss, gradient = jax.value_and_grad(
            lambda a: prior.loss(batch.observations, condition, batch.actions, noise, a)
        )(adapters)
        updates, optimizer = ADAM.update(gradient, optimizer)
        adapters = jax.tree.map(lambda p, u: p - config.pet_learning_rate * u, adapters, updates)
        passed = jnp.sum(check(batch.state_ids, batch.observations))
        spr = jnp.minimum(spr, share(passed, jnp.float32(config.pet_minibatch_size)))
        return adapters, optimizer, total + loss, spr

    carry = (adapters, optimizer, jnp.zeros(()), jnp.ones(()))
    adapters, optimizer, total, spr = jax.lax.fori_loop(0, num_steps, step, carry)
    return adapters, optimizer, {"pet_loss": total / jnp.maximum(num_steps, 1), "pet_spr": spr}
