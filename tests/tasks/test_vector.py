import gymnasium
import numpy as np
import pytest

from ppo_dap.tasks import Transition, make_vector_env
from ppo_dap.tasks.vector import NextStepEnv

ENVS = 3


def run(task, seed, steps, threads=1, scale=1.0):
    """First observations and all transitions under random actions, the same for every seed of the task."""
    env = make_vector_env(task, ENVS, seed, threads)
    rng = np.random.default_rng(0)
    size = 1 if task == "Pendulum-v1" else 3
    first = env.reset()
    actions = rng.uniform(-scale, scale, (steps, ENVS, size)).astype(np.float32)
    steps = [env.step(a) for a in actions]
    env.close()
    return first, actions, Transition(*(np.stack(column) for column in zip(*steps, strict=True)))


@pytest.fixture(scope="module")
def hopper():
    return run("Hopper-v5", 0, 150)


@pytest.fixture(scope="module")
def pendulum():
    return run("Pendulum-v1", 0, 450)


def equal(one, other):
    return all(np.array_equal(a, b) for a, b in zip((one[0], *one[2]), (other[0], *other[2]), strict=True))


def test_one_seed_gives_one_trajectory_and_another_seed_another(hopper, pendulum):
    assert equal(run("Hopper-v5", 0, 150, threads=2), hopper)
    assert not equal(run("Hopper-v5", 1, 150), hopper)
    assert equal(run("Pendulum-v1", 0, 450), pendulum)
    assert not equal(run("Pendulum-v1", 1, 450), pendulum)
    assert equal(run("Pendulum-v1", 2**31, 450), pendulum)  # seeds are taken modulo 2^31


@pytest.mark.parametrize("task", ["hopper", "pendulum"])
def test_copies_start_differently(task, request):
    first = request.getfixturevalue(task)[0]
    assert len(np.unique(first, axis=0)) == ENVS


@pytest.mark.parametrize("task", ["hopper", "pendulum"])
def test_a_step_continues_from_the_one_before(task, request):
    first, _, steps = request.getfixturevalue(task)
    before = np.concatenate([first[None], steps.observations[:-1]])
    ended = steps.terminated | steps.truncated
    assert ended.any()
    inside = ~ended & steps.valid
    np.testing.assert_array_equal(steps.next_observations[inside], steps.observations[inside])
    assert np.abs(steps.next_observations - before)[inside].max(-1).min() > 0  # something moves in every row


def test_envpool_masks_the_row_after_an_episodes_end(hopper):
    _, _, steps = hopper
    ended = steps.terminated | steps.truncated
    assert ended.sum() > 5
    assert steps.valid[0].all()
    np.testing.assert_array_equal(~steps.valid[1:], ended[:-1])
    masked = ~steps.valid
    assert not np.any(steps.rewards[masked])
    assert not np.any(ended[masked])
    assert np.all(steps.rewards[steps.valid] != 0)


class Repeating:
    """A backend whose reset row repeats the flags and the reward of the episode's end."""

    def reset(self):
        return np.zeros((1, 2)), {}

    def step(self, actions):
        return np.ones((1, 2)), np.array([5.0]), np.array([True]), np.array([False]), {}


def test_a_reset_row_ends_nothing_whatever_the_backend_says():
    env = NextStepEnv(Repeating(), 1, None)
    env.reset()
    steps = [env.step(np.zeros((1, 1))) for _ in range(4)]
    assert [(bool(s.valid[0]), bool(s.terminated[0]), float(s.rewards[0])) for s in steps] == 2 * [
        (True, True, 5.0),
        (False, False, 0.0),
    ]


def healthy(observations):
    """Gymnasium's documentation of Hopper: height above 0.7 and angle within 0.2."""
    return (observations[..., 0] > 0.7) & (np.abs(observations[..., 1]) < 0.2)


def test_the_last_successor_of_an_episode_is_its_final_observation(hopper):
    _, _, steps = hopper
    np.testing.assert_array_equal(healthy(steps.next_observations), ~steps.terminated)
    after = steps.observations[~steps.valid]
    assert healthy(after).all()  # planted: the observation after the reset is another


@pytest.mark.usefixtures("without_video")
def test_hopper_moves_as_a_single_gymnasium_environment_does(hopper):
    first, actions, steps = hopper
    before = np.concatenate([first[None], steps.observations[:-1]])
    slow = (np.abs(before[..., 5:]) < 9).all(-1) & steps.valid  # velocities are observed clipped at 10
    rows = [*np.argwhere(slow & steps.terminated)[:5], *np.argwhere(slow)[::60]]
    assert len(rows) > 8
    with gymnasium.make("Hopper-v5") as env:
        env.reset(seed=0)
        for t, i in rows:
            state = before[t, i].astype(np.float64)
            env.unwrapped.set_state(np.concatenate([[0.0], state[:5]]), state[5:])
            successor, reward, terminated, _, _ = env.unwrapped.step(actions[t, i])
            np.testing.assert_allclose(steps.next_observations[t, i], successor, rtol=1e-2, atol=1e-2)
            assert steps.rewards[t, i] == pytest.approx(reward, abs=1e-2)
            assert steps.terminated[t, i] == terminated


def test_pendulum_is_truncated_with_its_true_final_observation(pendulum):
    """Gymnasium resets at once; the final observation follows from the last state by the documented dynamics."""
    first, actions, steps = pendulum
    assert steps.valid.all()
    assert not steps.terminated.any()
    np.testing.assert_array_equal(np.flatnonzero(steps.truncated.all(1)), [199, 399])
    before = np.concatenate([first[None], steps.observations[:-1]])
    cos, sin, speed = np.moveaxis(before, -1, 0)
    new_speed = np.clip(speed + (15 * sin + 3 * actions[..., 0]) * 0.05, -8, 8)
    angle = np.arctan2(sin, cos) + new_speed * 0.05
    expected = np.stack([np.cos(angle), np.sin(angle), new_speed], -1)
    np.testing.assert_allclose(steps.next_observations, expected, atol=1e-4)
    assert np.abs(steps.observations[199] - expected[199]).max() > 0.05  # planted: a reset observation is far from it
