"""Steps 2 and 4 of Algorithm 1 for PPO itself: advantages of D_on, then epochs of minibatch steps.

The gradient of what a method adds to PPO's objective comes in as a function, is computed on its own and is added after
PPO's gradient: PPO's part of the program is the same whether there is such a term or not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from ppo_dap.config import PPOConfig
from ppo_dap.nets.actor import Actor, gaussian_kl, log_prob, tree_norm
from ppo_dap.nets.arrays import first_state
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.gae import gae
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.surrogate import (
    authentic_boundary_surrogate,
    authentic_bounds,
    centred_surrogate,
    clipped_surrogate,
    default_boundary_kl,
    generalised_clip_surrogate,
    importance_ratio,
    normalise,
    weighted_mean,
)

ADAM: Any = optax.scale_by_adam(eps=1e-5)


class PPOState(eqx.Module):
    """What PPO updates: networks and their optimizers, apart from everything of the prior."""

    actor: Actor
    critic: Critic
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState

    @staticmethod
    def create(rng: np.random.Generator, observation_size: int, action_size: int, hidden_size: int) -> PPOState:
        """Fresh networks."""
        actor = Actor.create(rng, observation_size, action_size, hidden_size)
        critic = Critic.create(rng, observation_size, hidden_size)
        return PPOState(actor, critic, first_state(ADAM, actor), first_state(ADAM, critic))


class Rows(eqx.Module):
    """D_on flattened to rows, with all that the update needs; `observations` are normalised and clipped."""

    state_ids: Int[Array, " rows"]
    raw_observations: Float[Array, "rows obs"]
    observations: Float[Array, "rows obs"]
    actions: Float[Array, "rows act"]
    old_log_probs: Float[Array, " rows"]
    old_means: Float[Array, "rows act"]
    advantages: Float[Array, " rows"]
    returns: Float[Array, " rows"]
    q_targets: Float[Array, " rows"]
    weights: Float[Array, " rows"]
    """1, or 0 for a row in which no transition happened."""


class PreviousRows(eqx.Module):
    """D_{k-1} flattened to rows, as the iteration after it sees them (ppo/reuse.py)."""

    state_ids: Int[Array, " rows"]
    raw_observations: Float[Array, "rows obs"]
    observations: Float[Array, "rows obs"]
    actions: Float[Array, "rows act"]
    old_log_probs: Float[Array, " rows"]
    """Of the policy that acted, pi_{k-1}."""
    centre: Float[Array, " rows"]
    """pi_k(a | s) / pi_{k-1}(a | s)."""
    advantages: Float[Array, " rows"]
    weights: Float[Array, " rows"]
    """1, or 0 for a row in which no transition happened."""


class Normaliser(NamedTuple):
    """The observations' statistics, frozen for one iteration."""

    mean: Float[Array, " obs"]
    std: Float[Array, " obs"]

    def __call__(self, observations: Float[Array, "*n obs"], clip: float) -> Float[Array, "*n obs"]:
        """Normalised observations."""
        shape = observations.shape
        mean, std = jnp.broadcast_to(self.mean, shape), jnp.broadcast_to(self.std, shape)
        return jnp.clip((observations - mean) / std, -clip, clip)


def estimate_advantages(
    critic: Critic, parts: Sequence[Rollout], normaliser: Normaliser, reward_std: Float[Array, ""], ppo: PPOConfig
) -> Rows:
    """Step 2: values, GAE, regression targets; and the one-step target of Q, r + gamma (1 - terminated) V(s').

    `parts` follow each other in time; rewards are divided by `reward_std`.
    """
    rollout = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    time, envs = rollout.rewards.shape

    def flat(x):
        return x.reshape(time * envs, *x.shape[2:])

    observations = normaliser(flat(rollout.observations), ppo.observation_clip)
    successors = normaliser(flat(rollout.next_observations), ppo.observation_clip)
    values, next_values = critic(observations), critic(successors)
    rewards = jnp.clip(rollout.rewards / reward_std, -ppo.reward_clip, ppo.reward_clip)
    grid = (time, envs)
    advantages = gae(
        rewards,
        values.reshape(grid),
        next_values.reshape(grid),
        rollout.terminated,
        rollout.truncated,
        rollout.valid,
        ppo.gamma,
        ppo.gae_lambda,
    )
    advantages = checkpoint_name(flat(advantages), "advantages")
    return Rows(
        state_ids=flat(rollout.state_ids),
        raw_observations=flat(rollout.observations),
        observations=observations,
        actions=flat(rollout.actions),
        old_log_probs=flat(rollout.log_probs),
        old_means=flat(rollout.means),
        advantages=advantages,
        returns=advantages + values,
        q_targets=flat(rewards) + ppo.gamma * jnp.where(flat(rollout.terminated), 0.0, next_values),
        weights=flat(rollout.valid).astype(jnp.float32),
    )


def ppo_loss(
    actor: Actor,
    rows: Rows,
    old_log_std: Float[Array, " act"],
    previous: PreviousRows | None = None,
    *,
    ppo: PPOConfig,
) -> tuple[Float[Array, ""], tuple]:
    """Minus Eq. 5, or minus the configured surrogate in its place, on a minibatch; also the means and the ratio.

    With `previous` rows, minus the mean of that and of their own surrogate, each normalised on its own.
    """
    means = actor(rows.observations)
    log_probs = log_prob(rows.actions, means, actor.log_std)
    # A masked row's ratio is 1: a weight of 0 would not stop an overflow in it.
    ratio = importance_ratio(jnp.where(rows.weights > 0, log_probs, rows.old_log_probs), rows.old_log_probs)
    advantages = normalise(rows.advantages, rows.weights)
    surrogate = _surrogate(ratio, advantages, rows, old_log_std, ppo)
    if previous is not None:
        surrogate = 0.5 * (surrogate + _previous_surrogate(actor, previous, ppo))
    return -surrogate, (means, ratio)


def _previous_surrogate(actor: Actor, rows: PreviousRows, ppo: PPOConfig) -> Float[Array, ""]:
    log_probs = log_prob(rows.actions, actor(rows.observations), actor.log_std)
    ratio = importance_ratio(jnp.where(rows.weights > 0, log_probs, rows.old_log_probs), rows.old_log_probs)
    advantages = normalise(rows.advantages, rows.weights)
    return centred_surrogate(ratio, rows.centre, advantages, rows.weights, ppo.clip_epsilon)


def _surrogate(ratio, advantages, rows: Rows, old_log_std, ppo: PPOConfig) -> Float[Array, ""]:
    if ppo.surrogate == "generalised_clip":
        return generalised_clip_surrogate(ratio, advantages, rows.weights, ppo.clip_epsilon, ppo.clip_slope)
    if ppo.surrogate == "authentic_boundary":
        boundary_kl = ppo.boundary_kl
        if boundary_kl is None:
            boundary_kl = default_boundary_kl(rows.actions.shape[-1], ppo.clip_epsilon)
        z = (rows.actions - rows.old_means) * jnp.exp(-old_log_std)[None]
        return authentic_boundary_surrogate(ratio, advantages, rows.weights, *authentic_bounds(z, boundary_kl))
    return clipped_surrogate(ratio, advantages, rows.weights, ppo.clip_epsilon)


def value_loss(critic: Critic, rows: Rows) -> Float[Array, ""]:
    """Mean squared error of V against GAE's returns."""
    return weighted_mean(jnp.square(critic(rows.observations) - rows.returns), rows.weights)


AddedGradient = Callable[[Actor, Rows, Any, Any], tuple[Actor, dict[str, Float[Array, ""]]]]
"""(actor, minibatch of D_on, minibatch of what the method adds, weights) -> gradient to add to PPO's, and metrics."""


def nothing_to_add(actor: Actor, rows: Rows, minibatch: Any, weights: Any) -> tuple[Actor, dict[str, Float[Array, ""]]]:
    """Stands for `added_gradient` in plain PPO, whose `Settings.adds` is False: never called on numbers."""
    return actor, {}


class Orders(NamedTuple):
    """In which order each epoch of the actor's deals out D_on's rows, and the rows of what the method adds."""

    rows: Int[Array, "epochs rows"]
    added: Int[Array, "epochs n"]


class Settings(NamedTuple):
    """Numbers that change from iteration to iteration (traced, so that nothing recompiles)."""

    learning_rate: Float[Array, ""]
    kl_limit: Float[Array, ""]
    """Epochs stop after one whose mean policy-KL exceeds this; infinite when `kl_rule` is another."""
    adds: Bool[Array, ""]
    """Whether something is added to PPO's gradient."""
    added_weights: Any = ()
    """Weights of what the method adds (Eq. 9)."""


def improve_actor(
    actor: Actor,
    optimizer: optax.OptState,
    rows: Rows,
    added: Any,
    orders: Orders,
    settings: Settings,
    previous: PreviousRows | None = None,
    *,
    ppo: PPOConfig,
    added_gradient: AddedGradient | None = None,
) -> tuple[Actor, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 4, the actor: `num_epochs` passes over D_on in shuffled minibatches, fewer when the KL rule stops them.

    `added` holds what `added_gradient` sees, with a multiple of the number of minibatches as leading axis; it is
    shuffled and dealt out like D_on's rows, by orders of its own. Rows of a `previous` batch, as many as D_on's, are
    dealt out beside them. The metric `pgshare` is Eq. 13: the norm of PPO's gradient over that of the whole.
    """
    num_minibatches = ppo.rollout_steps // ppo.minibatch_size
    old_log_std = actor.log_std

    def minibatch_step(carry, batch):
        return _actor_step(carry, batch, settings, old_log_std, ppo, added_gradient)

    def run(carry, order):
        batches = deal((rows, previous), order.rows, num_minibatches), deal(added, order.added, num_minibatches)
        carry, metrics = jax.lax.scan(minibatch_step, carry, batches)
        return carry, jnp.mean(metrics["policy_kl_minibatch"]) > settings.kl_limit, metrics

    def skip(carry, order):
        shapes = jax.eval_shape(run, carry, order)[2]
        return carry, jnp.array(True), jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), shapes)

    def epoch(carry, order):
        learned, stopped = carry
        learned, stopped, metrics = jax.lax.cond(stopped, skip, run, learned, order)
        return (learned, stopped), metrics

    start = ((actor, optimizer), jnp.array(False))
    ((actor, optimizer), _), metrics = jax.lax.scan(epoch, start, orders)
    summary = {name: jnp.nanmean(values) for name, values in metrics.items()}
    summary["ratio_error"] = metrics["ratio_error"][0, 0]
    summary["actor_updates"] = jnp.sum(~jnp.isnan(metrics["policy_kl_minibatch"])).astype(jnp.float32)
    return actor, optimizer, summary


def _actor_step(carry, batch, settings: Settings, old_log_std, ppo: PPOConfig, added_gradient):
    (actor, optimizer), ((own, previous), extra) = carry, batch
    actor = jax.tree.map(lambda leaf: checkpoint_name(leaf, "theta"), actor)
    of_loss = jax.value_and_grad(partial(ppo_loss, ppo=ppo), has_aux=True)
    (loss, (means, ratio)), gradient = of_loss(actor, own, old_log_std, previous)
    policy_kl = gaussian_kl(means, actor.log_std[None], own.old_means, old_log_std[None])
    metrics = {
        "ppo_loss": loss,
        "policy_kl_minibatch": weighted_mean(policy_kl, own.weights),
        "ratio_error": jnp.max(jnp.abs(ratio - 1) * own.weights),
    }
    ppo_norm = tree_norm(gradient)
    # A branch of its own in every program, taken or not: the compiler cannot fuse PPO's part with what is added, so
    # PPO's bits are the same with and without (a barrier is not enough: XLA's CPU compiler removes it before fusing).
    add = added_gradient or nothing_to_add
    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(add, actor, own, extra, settings.added_weights))
    extra_gradient, extra_metrics = jax.lax.cond(
        settings.adds, lambda: add(actor, own, extra, settings.added_weights), lambda: zeros
    )
    extra_gradient = jax.tree.map(lambda leaf: checkpoint_name(leaf, "added"), extra_gradient)
    gradient = jax.tree.map(jnp.add, gradient, extra_gradient)
    metrics |= extra_metrics
    metrics["actor_gradient_norm"] = tree_norm(gradient)
    metrics["pgshare"] = ppo_norm / (metrics["actor_gradient_norm"] + 1e-8)
    learned = _adam(actor, gradient, optimizer, settings.learning_rate, ppo.max_grad_norm)
    return learned, metrics


def improve_critic(
    critic: Critic,
    optimizer: optax.OptState,
    rows: Rows,
    orders: Int[Array, "epochs rows"],
    learning_rate: Float[Array, ""],
    *,
    ppo: PPOConfig,
) -> tuple[Critic, optax.OptState, dict[str, Float[Array, ""]]]:
    """Step 4, V: `num_epochs` passes over D_on. Apart from the actor's, so that nothing that is added there, and no KL
    rule, changes what V learns.
    """

    def step(carry, batch):
        critic, optimizer = carry
        loss, gradient = jax.value_and_grad(value_loss)(critic, batch)
        gradient = jax.tree.map(lambda g: ppo.value_coefficient * g, gradient)
        return _adam(critic, gradient, optimizer, learning_rate, ppo.max_grad_norm), loss

    def epoch(carry, order):
        return jax.lax.scan(step, carry, deal(rows, order, ppo.rollout_steps // ppo.minibatch_size))

    (critic, optimizer), losses = jax.lax.scan(epoch, (critic, optimizer), orders)
    return critic, optimizer, {"value_loss": jnp.mean(losses)}


def _adam(params, gradient, optimizer_state, learning_rate, max_norm: float):
    scale = jnp.minimum(1.0, max_norm / (tree_norm(gradient) + 1e-6))
    gradient = jax.tree.map(lambda g: g * scale, gradient)
    updates, optimizer_state = ADAM.update(gradient, optimizer_state)
    return jax.tree.map(lambda p, u: p - learning_rate * u, params, updates), optimizer_state


def deal(rows, order: Int[Array, " rows"], num_minibatches: int):
    """Rows in the given order, with a leading axis of minibatches."""
    return jax.tree.map(lambda x: x[order].reshape(num_minibatches, -1, *x.shape[1:]), rows)


def draw_orders(rng: np.random.Generator, epochs: int, rows: int) -> Int[np.ndarray, "{epochs} {rows}"]:
    """A random order of the rows for each epoch."""
    return rng.permuted(np.tile(np.arange(rows, dtype=np.int32), (epochs, 1)), axis=1)
