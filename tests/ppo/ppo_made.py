"""A scripted task, a small numpy policy and random rows for the tests of PPO."""

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from ppo_dap.config import PPOConfig
from ppo_dap.nets.policy import Policy
from ppo_dap.ppo.update import Normaliser, Orders, Rows, draw_orders

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32)
TERMINATES, TRUNCATES, BOTH = (True, False), (False, True), (True, True)


class Scripted(gymnasium.Env):
    """Episodes as `script` says, in turn: (length, (terminated, truncated)). Observation: (step, episode)."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(LOW, HIGH)

    def __init__(self, script):
        self.script, self.episode, self.actions = script, -1, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.episode = 0, self.episode + 1
        return np.array([0.0, self.episode]), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.actions.append(action.copy())
        length, flags = self.script[self.episode % len(self.script)]
        self.count += 1
        terminated, truncated = flags if self.count == length else (False, False)
        observation = np.array([self.count, self.episode], np.float64)
        return observation, scripted_reward(self.count, self.episode), terminated, truncated, {}


def scripted_reward(count, episode):
    return 1.0 * count + 0.25 * episode


def make_policy(seed=0, observation_size=2, action_size=2, task=None):
    rng = np.random.default_rng(seed)
    sizes = [(4, observation_size), (3, 4), (action_size, 3)]
    return Policy(
        tuple(rng.standard_normal(s).astype(np.float32) for s in sizes),
        tuple(rng.standard_normal(s[0]).astype(np.float32) for s in sizes),
        np.linspace(-0.5, 0.3, action_size).astype(np.float32),
        rng.standard_normal(observation_size).astype(np.float32),
        rng.uniform(0.5, 2, observation_size).astype(np.float32),
        3.0,
        np.resize(LOW, action_size),
        np.resize(HIGH, action_size),
        task,
    )


def changed(node, **values):
    """A copy of a module with some fields replaced."""
    return eqx.tree_at(lambda n: [getattr(n, name) for name in values], node, list(values.values()))


def small_config(**changes):
    sizes = {"num_envs": 4, "rollout_steps": 64, "minibatch_size": 16, "num_epochs": 3, "hidden_size": 8}
    return PPOConfig(**{**sizes, **changes})


def no_normaliser(observation_size):
    return Normaliser(jnp.zeros(observation_size), jnp.ones(observation_size))


def orders_of(ppo, seed=0, added=0):
    """Orders of D_on's rows, and of `added` other ones."""
    rng = np.random.default_rng(seed)
    return Orders(*(draw_orders(rng, ppo.num_epochs, rows) for rows in (ppo.rollout_steps, added)))


def make_rows(actor, count=64, seed=0):
    """Rows on which `actor` is the policy that collected them."""
    rng = np.random.default_rng(seed)
    obs_size, act_size = actor.mlp.layers[0].weight.shape[1], len(actor.log_std)
    observations = jnp.asarray(rng.standard_normal((count, obs_size)), jnp.float32)
    means = jax.jit(lambda actor, o: actor(o))(actor, observations)
    noise = rng.standard_normal((count, act_size)).astype(np.float32)
    log_std = np.asarray(actor.log_std)
    log_probs = (-0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)).sum(-1)
    return Rows(
        state_ids=jnp.arange(count, dtype=jnp.int32),
        raw_observations=observations,
        observations=observations,
        actions=means + np.exp(log_std) * noise,
        old_log_probs=jnp.asarray(log_probs, jnp.float32),
        old_means=means,
        advantages=jnp.asarray(rng.standard_normal(count), jnp.float32),
        returns=jnp.sin(observations[:, 0]),
        q_targets=jnp.zeros(count),
        weights=jnp.ones(count),
    )
