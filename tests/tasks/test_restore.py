"""Simulators that go back: the same state and actions give the same bits, and what cannot do that is not trusted."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.tasks.catalogue import make_gymnasium
from ppo_dap.tasks.restore import MujocoSimulator, Restorable, make_restorable, repeats

pytestmark = pytest.mark.usefixtures("without_video")


def forgetful(task):
    """A MuJoCo task whose reward counts the steps that were taken: no state of MuJoCo's says how many."""
    env, counted = make_gymnasium(task), itertools.count()
    step = env.unwrapped.step

    def counting(action):
        observation, reward, *rest = step(action)
        return observation, reward + next(counted), *rest

    env.unwrapped.step = counting
    return env


def randomised(task):
    """A MuJoCo task whose body weighs something else in each copy."""
    env = make_gymnasium(task)
    model: Any = env.unwrapped.model
    model.body_mass[1:] *= next(WEIGHTS)
    return env


WEIGHTS = itertools.count(1)


def copies(*arguments, **options):
    """What can be restored, as the test expects."""
    found = make_restorable(*arguments, **options)
    assert found is not None
    return found


class OnlyPositions(MujocoSimulator):
    """The fault of keeping positions and velocities alone."""

    def save(self):
        return self._env.data.qpos.copy(), self._env.data.qvel.copy()

    def restore(self, saved):
        self._env.set_state(*saved)


@pytest.mark.parametrize("task", ["Walker2d-v5", "Ant-v5", "Pusher-v5", "Striker-v2"])
def test_a_restored_state_repeats_its_rewards(task):
    env = make_gymnasium(task)
    simulator, rng = MujocoSimulator(env), np.random.default_rng(0)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (30, *env.action_space.shape))
    env.reset(seed=3)
    for action in actions[:20]:
        env.step(action)
    saved = simulator.save()
    first = [env.step(action) for action in actions]
    for simulator_, fresh in ((simulator, None), (*copies(task, 1, seed=9), "another copy")):
        simulator_.restore(saved)
        for action, (observation, reward, terminated, _, _) in zip(actions, first, strict=True):
            seen, got, ended = simulator_.step(action)
            assert (got, ended) == (reward, terminated), fresh
            assert np.array_equal(seen, observation.astype(np.float32))
    simulator.restore(saved)
    assert simulator.step(actions[0] / 2)[1] != first[0][1]  # another action, another reward


def test_time_limits_do_not_end_a_future():
    env = gymnasium.make("Swimmer-v5", max_episode_steps=3)
    simulator = MujocoSimulator(env)
    env.reset(seed=0)
    assert not any(simulator.step(np.zeros(2, np.float32))[2] for _ in range(10))


def test_a_simulator_is_restorable():
    (simulator,) = copies("Hopper-v5", 1)
    assert isinstance(simulator, Restorable)


def test_tasks_without_mujoco_cannot_be_restored():
    assert make_restorable("Pendulum-v1", 2) is None


@pytest.mark.parametrize("fault", [forgetful, randomised])
def test_a_task_that_keeps_more_than_is_saved_is_found(fault, monkeypatch):
    monkeypatch.setattr("ppo_dap.tasks.restore.make_gymnasium", fault)
    assert make_restorable("Hopper-v5", 2) is None
    monkeypatch.setattr("ppo_dap.tasks.restore.make_gymnasium", make_gymnasium)
    assert len(copies("Hopper-v5", 2)) == 2


@pytest.mark.parametrize(
    ("cause", "told"),
    [("No module named 'imageio'", r"install ppo-dap\[video\]"), ("no such task", "no such task")],
)
def test_why_a_task_cannot_be_made(cause, told, monkeypatch):
    def fail(task):
        raise InputError(f"task {task!r} cannot be made: {cause}")

    monkeypatch.setattr("ppo_dap.tasks.restore.make_gymnasium", fail)
    with pytest.raises(InputError, match=told):
        make_restorable("Hopper-v5", 2)


def test_positions_and_velocities_alone_are_not_enough():
    envs = [make_gymnasium("Striker-v2") for _ in range(2)]
    for i, env in enumerate(envs):
        env.reset(seed=i)
    actions = np.random.default_rng(0).uniform(-3, 3, (24, 7)).astype(np.float32)
    assert repeats(MujocoSimulator(envs[0]), MujocoSimulator(envs[1]), actions)
    assert not repeats(OnlyPositions(envs[0]), OnlyPositions(envs[1]), actions)
