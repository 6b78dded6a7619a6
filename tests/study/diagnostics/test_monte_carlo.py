"""Monte-Carlo returns on chains whose values are known in closed form, and planted faults."""

import gymnasium
import numpy as np
import pytest

from ppo_dap.nets.policy import Policy
from ppo_dap.study.diagnostics.monte_carlo import (
    Scoring,
    Walk,
    default_horizon,
    monte_carlo_returns,
    returns_to_go,
    walk,
)

GAMMA = 0.9


class Chain:
    """x counts up from where it is; the reward is x + the action; it terminates after x has been `end`."""

    def __init__(self, end=5.0):
        self.x, self.end = 0.0, end

    def step(self, action):
        reward, ended = self.x + float(action[0]), self.x >= self.end
        self.x += 1
        return np.array([self.x], np.float32), reward, ended

    def save(self):
        return self.x

    def restore(self, saved):
        self.x = saved


class Stuck(Chain):
    """The fault of a simulator that does not go back."""

    def restore(self, saved):
        pass


def policy(std=1e-6):
    one = np.ones(1, np.float32)
    layers = ((np.zeros((1, 1), np.float32),), (0 * one,))
    return Policy(*layers, np.log(std) * one, 0 * one, one, 10.0, -one, one)


def scoring(value=0.0, std=1.0, clip=1e9, gamma=GAMMA):
    return Scoring(gamma, std, clip, lambda observations: np.full(len(observations), float(value)))


def chain_return(x, action, end=5):
    """The closed sum, rewards one by one."""
    return action + sum(GAMMA**t * (x + t) for t in range(end - x + 1))


def test_returns_of_a_chain_that_terminates():
    actions = np.array([[[0.5], [-0.25]], [[0.0], [1.0]]])
    found = monte_carlo_returns([Chain(), Chain()], policy(), [0.0, 3.0], actions, scoring(value=99), 50, 0)
    wanted = [[chain_return(x, a) for a in pair] for x, pair in zip((0, 3), actions[..., 0], strict=True)]
    assert found.shape == (2, 2, 2)
    assert found == pytest.approx(np.repeat(np.array(wanted)[..., None], 2, axis=2), abs=1e-4)


def test_a_simulator_that_does_not_go_back_gives_other_returns():
    found = monte_carlo_returns([Stuck()], policy(), [3.0], np.zeros((1, 2, 1)), scoring(), 50, 0)
    assert np.abs(found[0, 1] - chain_return(3, 0)) > 0.5


@pytest.mark.parametrize("horizon", [1, 7, 40])
def test_v_stands_for_what_comes_after_the_horizon(horizon):
    class Endless(Chain):
        def step(self, action):
            return super().step(action)[0], 1.0, False

    true = 1 / (1 - GAMMA)
    found = monte_carlo_returns([Endless()], policy(), [0.0], np.zeros((1, 1, 1)), scoring(true), horizon, 0)
    assert found == pytest.approx(true)
    cut = monte_carlo_returns([Endless()], policy(), [0.0], np.zeros((1, 1, 1)), scoring(0.0), horizon, 0)
    assert cut == pytest.approx((1 - GAMMA**horizon) * true)


def test_the_noise_of_the_policy_averages_out_and_is_shared_by_a_states_actions():
    copies = [Chain() for _ in range(2000)]
    found = monte_carlo_returns(copies, policy(0.2), [2.0], np.array([[[0.3], [-0.3]]]), scoring(), 50, 0)
    # Noise enters from the second step on, 0.2 a step: its variance is summed by hand.
    error = 0.2 * np.sqrt(sum(GAMMA ** (2 * t) for t in range(1, 4)))
    assert found[0, 0].std() == pytest.approx(error, rel=0.06)
    assert found[0, 0].mean() == pytest.approx(chain_return(2, 0.3), abs=4 * error / np.sqrt(2000))
    assert found[0, 0] - found[0, 1] == pytest.approx(np.full(2000, 0.6), abs=1e-5)


def test_some_copies_end_before_others():
    found = monte_carlo_returns([Chain(5), Chain(3)], policy(), [2.0], np.zeros((1, 1, 1)), scoring(value=7), 3, 0)
    late = sum(GAMMA**t * (2 + t) for t in range(3)) + GAMMA**3 * 7
    assert found[0, 0] == pytest.approx([late, chain_return(2, 0, end=3)], abs=1e-4)


def test_rewards_are_scaled_and_clipped_as_in_training():
    assert scoring(std=2.0, clip=3.0)([1.0, 10.0, -10.0]).tolist() == [0.5, 3.0, -3.0]


def test_horizons():
    assert GAMMA ** default_horizon(GAMMA) < 0.05 <= GAMMA ** (default_horizon(GAMMA) - 1)
    assert default_horizon(0.99) == 299
    assert (default_horizon(1.0), default_horizon(0.9999), default_horizon(0.0)) == (1000, 1000, 1)


def trajectory(rewards, terminated=(), truncated=()):
    n = len(rewards)
    flags = [np.isin(np.arange(n), ends) for ends in (terminated, truncated)]
    observations = np.arange(n, dtype=np.float32)[:, None]
    zeros = np.zeros((n, 1), np.float32)
    return Walk(observations, observations + 1, zeros, np.array(rewards, float), *flags, kept=np.arange(n), saved=[])


def test_returns_to_go_by_hand():
    found = returns_to_go(trajectory([1, 2, 3, 4, 5], terminated=[1], truncated=[3]), scoring(value=10))
    assert found == pytest.approx([1 + 0.9 * 2, 2, 3 + 0.9 * (4 + 9), 4 + 9, 5 + 9])


class Counter(gymnasium.Env):
    """The observation counts the steps of the episode."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    x = 0

    def reset(self, *, seed=None, options=None):
        self.x = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.x += 1
        return np.array([self.x], np.float32), float(action[0]), self.x == 7, False, {}


def test_a_walk_keeps_states_as_they_were_visited():
    env = Counter()
    found = walk(env, policy(0.5), 40, 6, 0, lambda: env.x)
    assert len(found.kept) == len(set(found.kept.tolist())) == 6
    assert found.saved == found.observations[found.kept, 0].tolist()
    assert found.observations[:, 0].tolist() == [t % 7 for t in range(40)]
    assert found.next_observations[:, 0].tolist() == [t % 7 + 1 for t in range(40)]
    assert found.terminated.tolist() == [t % 7 == 6 for t in range(40)]
    assert found.rewards == pytest.approx(found.actions[:, 0])
    assert found.actions.std() == pytest.approx(0.5, rel=0.3)
    assert walk(env, policy(), 5, 9, 0, None).kept.tolist() == [0, 1, 2, 3, 4]
    assert walk(env, policy(), 5, 9, 0, None).saved == []
