"""PPO's real functions on tasks whose values and best actions are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppo.ppo_made import no_normaliser, orders_of, small_config
from ppo_dap.nets.policy import Policy
from ppo_dap.ppo.rollout import Collector
from ppo_dap.ppo.update import PPOState, Settings, estimate_advantages, improve_actor, improve_critic
from ppo_dap.tasks.vector import Transition

GAMMA = 0.5
PPO = small_config(num_envs=8, rollout_steps=256, minibatch_size=64, num_epochs=4, hidden_size=16, gamma=GAMMA)


class Probe:
    """Episodes of `length` steps; observations are a sign or the step's number, rewards `reward(obs, action, last)`."""

    num_envs = PPO.num_envs

    def __init__(self, reward, length=1, truncates=False, signs=False):
        self.reward, self.length, self.truncates, self.signs = reward, length, truncates, signs
        self.rng = np.random.default_rng(0)

    def reset(self):
        self.count = 0
        first = self.rng.choice([-1.0, 1.0], self.num_envs) if self.signs else np.zeros(self.num_envs)
        self.now = first.astype(np.float32)[:, None]
        return self.now

    def step(self, actions):
        self.count += 1
        last = self.count == self.length
        rewards = self.reward(self.now[:, 0], actions[:, 0], last).astype(np.float32)
        successors = self.now if self.signs else np.full_like(self.now, self.count)
        observations = self.now = self.reset() if last else successors
        ends = np.full(self.num_envs, last)
        no = np.zeros(self.num_envs, bool)
        flags = (no, ends) if self.truncates else (ends, no)
        return Transition(successors, rewards, *flags, ~no, observations)

    def close(self):
        pass


@functools.partial(jax.jit, static_argnames="ppo")
def iteration(state, parts, orders, ppo=PPO):
    rows = estimate_advantages(state.critic, parts, no_normaliser(1), jnp.ones(()), ppo)
    rate = jnp.float32(1e-2)
    actor, actor_optimizer, metrics = improve_actor(
        state.actor,
        state.actor_optimizer,
        rows,
        (),
        orders,
        Settings(rate, jnp.float32(np.inf), jnp.array(False)),
        ppo=ppo,
    )
    critic, critic_optimizer, _ = improve_critic(state.critic, state.critic_optimizer, rows, orders.rows, rate, ppo=ppo)
    return PPOState(actor, critic, actor_optimizer, critic_optimizer), metrics["ratio_error"]


def numpy_policy(actor):
    arrays = (tuple(np.asarray(getattr(layer, part)) for layer in actor.mlp.layers) for part in ("weight", "bias"))
    box = -np.ones(1, np.float32), np.ones(1, np.float32)
    return Policy(*arrays, np.asarray(actor.log_std), np.zeros(1, np.float32), np.ones(1, np.float32), 10.0, *box)


def train(probe, iterations):
    state = PPOState.create(np.random.default_rng(0), 1, 1, PPO.hidden_size)
    collector, rng = Collector(probe), np.random.default_rng(1)
    for i in range(iterations):
        parts = list(collector.collect(numpy_policy(state.actor), PPO.rollout_steps, 2, i, rng))
        state, ratio_error = iteration(state, parts, orders_of(PPO, seed=i))
        assert float(ratio_error) < 1e-4
    return state


def values(state, *observations):
    return np.asarray(state.critic(jnp.asarray(observations, jnp.float32)[:, None]))


def actions(state, *observations):
    return numpy_policy(state.actor)(np.asarray(observations, np.float32)[:, None])[:, 0]


def one(obs, action, last):
    return np.ones_like(obs)


@pytest.mark.parametrize(
    ("probe", "at", "expected"),
    [
        pytest.param(Probe(one), [0.0], [1.0], id="constant reward"),
        pytest.param(Probe(lambda o, a, last: o, signs=True), [-1.0, 1.0], [-1.0, 1.0], id="reward of observation"),
        pytest.param(Probe(lambda o, a, last: 1.0 * last + 0 * o, 2), [0.0, 1.0], [GAMMA, 1.0], id="discounting"),
        pytest.param(Probe(one, 2, True, True), [-1.0, 1.0], [2.0, 2.0], id="truncation"),
    ],
)
def test_values_become_the_known_ones(probe, at, expected):
    state = train(probe, 25)
    np.testing.assert_allclose(values(state, *at), expected, atol=0.1)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_action_moves_to_where_the_reward_is(sign):
    state = train(Probe(lambda o, a, last: np.sign(a) * sign), 10)
    assert actions(state, 0.0)[0] * sign > 0.8
    assert values(state, 0.0)[0] > 0.7


def test_the_action_follows_the_observation():
    state = train(Probe(lambda o, a, last: -np.square(a - 0.5 * o), signs=True), 30)
    np.testing.assert_allclose(actions(state, -1.0, 1.0), [-0.5, 0.5], atol=0.15)


def test_an_action_that_pays_only_later_is_found():
    """Two steps: the first action is rewarded in the second step, through the value of what it leads to."""

    class Delayed(Probe):
        def step(self, actions):
            if self.count == 0:
                self.first = actions
            return super().step(self.first)

    state = train(Delayed(lambda o, a, last: a * last, 2), 20)
    assert actions(state, 0.0)[0] > 0.8
