import contextlib

import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import Transition
from ppo_dap.training import evaluation


class Countdown:
    """Environment i pays 1 a step and ends after i + 2 of them, again and again."""

    num_envs = 3

    def reset(self):
        self.t = np.zeros(3, int)
        return np.zeros((3, 1), np.float32)

    def step(self, actions):
        self.t += 1
        ended = self.t % (np.arange(3) + 2) == 0
        zeros = np.zeros((3, 1), np.float32)
        return Transition(zeros, np.ones(3, np.float32), ended, np.zeros(3, bool), np.ones(3, bool), zeros)

    def close(self):
        self.closed = True


def constant_policy():
    one = np.ones(1, np.float32)
    return Policy((np.zeros((1, 1), np.float32),), (0 * one,), 0 * one, 0 * one, one, 10.0, -one, one)


def test_the_first_episode_of_each_environment_counts_and_no_other(monkeypatch):
    env = Countdown()
    monkeypatch.setattr(evaluation, "make_vector_env", lambda *a: env)
    result = evaluation.evaluate_policy(constant_policy(), "made-v0", 3, seed=0)
    assert result.returns == (2.0, 3.0, 4.0)
    assert result.lengths == (2, 3, 4)
    assert env.closed
    row = result.row(7)
    assert (row["return_mean"], row["length_mean"], row["episodes"], row["env_steps"]) == (3.0, 3.0, 3, 7)
    np.testing.assert_allclose(row["return_std"], np.std([2, 3, 4]))


@pytest.mark.parametrize("most", [4, 3])
def test_an_episode_without_an_end_is_told_and_not_waited_for(monkeypatch, most):
    """The longest of these has 4 steps."""
    env = Countdown()
    monkeypatch.setattr(evaluation, "make_vector_env", lambda *a: env)
    monkeypatch.setattr(evaluation, "ENDLESS", most)
    endless = pytest.raises(InputError, match="made-v0: an episode has no end after 3 steps: step must truncate it")
    with contextlib.nullcontext() if most == 4 else endless:
        assert evaluation.evaluate_policy(constant_policy(), "made-v0", 3, seed=0).lengths == (2, 3, 4)
    assert env.closed


def test_evaluation_depends_on_its_seed_alone():
    policy = Policy(
        (np.zeros((1, 3), np.float32),), (np.zeros(1, np.float32),), np.zeros(1, np.float32), np.zeros(3, np.float32),
        np.ones(3, np.float32), 10.0, np.full(1, -2.0, np.float32), np.full(1, 2.0, np.float32),
    )  # fmt: skip
    first, again, other = (evaluation.evaluate_policy(policy, "Pendulum-v1", 2, seed) for seed in (3, 3, 4))
    assert first == again != other
    assert first.lengths == (200, 200)
