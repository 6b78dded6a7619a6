"""Supervised start from logs (3.4, optional): no advantages and no PPO on logs, only regression, before Stage II."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from ppo_dap.config import Config
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs, best_episodes
from ppo_dap.nets.actor import Actor, log_prob
from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.critic import Critic, q_features
from ppo_dap.nets.normalizer import RewardScale, RunningMoments
from ppo_dap.nets.policy import scale_actions
from ppo_dap.tasks import TaskSpec
from ppo_dap.training.state import TrainState

WARM_START_STREAM = 6
BATCH = 256
PATIENCE = 3
"""Passes without a better held-out loss before a fit ends."""


def warm_start(state: TrainState, logs: Logs, spec: TaskSpec, config: Config) -> TrainState:
    """`state` with the normaliser and the actor, and with `actor_critic` also V and Q, started from `logs`.

    Raises `InputError` when V or Q is asked for, or the best episodes, and the logs have no rewards.
    """
    start = config.warm
    if start.warm_start == "none":
        return state
    if start.logs_filter < 1:
        logs = best_episodes(logs, start.logs_filter)
    moments = RunningMoments.create(spec.observation_size).update(logs.observations)
    train, held_out = (_data(part, moments, spec, config) for part in logs.split(seed=config.run.seed))
    learner = state.learner
    actor = _fit(learner.ppo.actor, _actor_loss, train, held_out, config)
    # The spread's maximum likelihood given the means is known exactly; Adam would take thousands of steps to get there.
    spread = jnp.sqrt(jnp.mean(jnp.square(train["actions"] - actor(train["observations"])), axis=0))
    actor = eqx.tree_at(lambda a: a.log_std, actor, jnp.log(jnp.maximum(spread, start.warm_start_std_floor)))
    learner = eqx.tree_at(lambda s: s.ppo.actor, learner, actor)
    if start.warm_start == "actor" and not start.q_warm_start:
        return TrainState(learner, moments, state.reward_scale)
    reward_scale = _reward_scale(logs, config)
    for part, source in ((train, 0), (held_out, 1)):
        returns = logs.split(seed=config.run.seed)[source].returns_to_go(config.ppo.gamma)
        assert returns is not None  # _reward_scale has checked
        part["returns"] = on_device(returns / reward_scale.std)
    if start.warm_start == "actor_critic":
        critic = _fit(learner.ppo.critic, _critic_loss, train, held_out, config)
        learner = eqx.tree_at(lambda s: s.ppo.critic, learner, critic)
    if learner.guide is not None:
        critic = learner.ppo.critic
        q = _fit(learner.guide.q, lambda q, rows: _q_loss(q, critic, rows), train, held_out, config)
        learner = eqx.tree_at(lambda s: s.guide.q, learner, q)
    # What PPO divides rewards by is a part of the critic's start.
    return TrainState(learner, moments, reward_scale if start.warm_start == "actor_critic" else state.reward_scale)


def _data(logs: Logs, moments: RunningMoments, spec: TaskSpec, config: Config) -> dict[str, Array]:
    clip = config.ppo.observation_clip
    observations = np.clip((logs.observations - moments.mean) / moments.std, -clip, clip)
    actions = np.clip(scale_actions(logs.actions, spec.action_low, spec.action_high), -1, 1)
    return {"observations": on_device(observations), "actions": on_device(actions)}


def _reward_scale(logs: Logs, config: Config) -> RewardScale:
    """The running scale that PPO would have after the logged rewards, as if one environment had made them."""
    if logs.rewards is None:
        asked = "warm_start 'actor_critic'" if config.warm.warm_start == "actor_critic" else "q_warm_start"
        raise InputError(f"{asked} needs logs with rewards; these have none: use warm_start 'actor' alone")
    scale, every = RewardScale.create(1), np.ones((logs.num_rows, 1), bool)
    scale = scale.update(logs.rewards[:, None], logs.episode_ends[:, None], every, config.ppo.gamma)
    return RewardScale(scale.moments, np.zeros(config.ppo.num_envs))


def _actor_loss(actor: Actor, rows: dict[str, Array]) -> Float[Array, ""]:
    """Negative log-likelihood of the logged actions."""
    return -jnp.mean(log_prob(rows["actions"], actor(rows["observations"]), actor.log_std))


def _critic_loss(critic: Critic, rows: dict[str, Array]) -> Float[Array, ""]:
    return jnp.mean(jnp.square(critic(rows["observations"]) - rows["returns"]))


def _q_loss(q: Any, critic: Critic, rows: dict[str, Array]) -> Float[Array, ""]:
    features = q_features(critic, q, rows["observations"], shared=False)
    values = [head(features, rows["actions"][:, None, :])[:, 0] for head in q.heads]
    return jnp.asarray(sum(jnp.mean(jnp.square(v - rows["returns"])) for v in values))


def _fit(model: Any, loss: Callable[..., Any], train: dict, held_out: dict, config: Config) -> Any:
    """`model` after at most `warm_start_epochs` passes of Adam; the one with the best held-out loss."""
    optimizer = optax.adam(1e-3)
    count = train["observations"].shape[0]
    size = min(BATCH, count)

    @jax.jit
    def epoch(model, state, order):
        def step(carry, index):
            model, state = carry
            gradient = jax.grad(loss)(model, {name: x[index] for name, x in train.items()})
            updates, state = optimizer.update(gradient, state)
            return (optax.apply_updates(model, updates), state), None

        (model, state), _ = jax.lax.scan(step, (model, state), order)
        return model, state, loss(model, held_out)

    best, best_loss, waited, state = model, np.inf, 0, optimizer.init(model)
    rng = np.random.default_rng([config.run.seed, WARM_START_STREAM])
    for _ in range(config.warm.warm_start_epochs):
        order = rng.permutation(count)[: count // size * size].reshape(-1, size)
        model, state, value = epoch(model, state, order)
        waited = 0 if value < best_loss else waited + 1
        if value < best_loss:
            best, best_loss = model, float(value)
        if waited >= PATIENCE:
            break
    return best
