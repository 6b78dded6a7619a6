"""EnvPool and Gymnasium give the same tasks, though with different versions of MuJoCo.

A fixed policy with random weights plays both, with seeds of their own. Welch's test at the 0.1% level compares the
returns and the lengths over the first steps of an episode (as many as the table says: falls come early, and long
episodes would leave time for few). With the table's numbers of episodes it finds, with 90% probability, returns that
differ by the table's last column: 1% of the mean on Hopper, 4% on Pusher, 14% on HumanoidStandup, 18% on Walker2d, 20%
on HalfCheetah, 55% on Ant, and 6 on Swimmer, whose returns are near 0. Single steps are compared much finer below.
"""

import itertools

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy import stats

from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import describe, make_vector_env
from ppo_dap.tasks.catalogue import CATALOGUE, make_gymnasium
from ppo_dap.tasks.vector import wrap_gymnasium

pytestmark = pytest.mark.usefixtures("without_video")

LEVEL = 0.001
# task: episodes in each backend, steps of each, difference of returns found with 90% probability
SAMPLES = {
    "Ant-v5": (80, 60, 20.0),
    "HalfCheetah-v5": (20, 1000, 107.0),
    "Hopper-v5": (60, 60, 0.5),
    "HumanoidStandup-v5": (16, 100, 490.0),
    "Pusher-v5": (60, 100, 9.0),
    "Swimmer-v5": (20, 300, 6.0),
    "Walker2d-v5": (60, 60, 1.0),
}


def make_policy(task):
    """Two layers of 16 with weights large enough that actions reach the bounds."""
    spec, rng = describe(task), np.random.default_rng(0)
    sizes = (spec.observation_size, 16, spec.action_size)
    weights = tuple(
        (2 * rng.standard_normal((after, before)) / before**0.5).astype(np.float32)
        for before, after in itertools.pairwise(sizes)
    )
    zeros = [np.zeros(size, np.float32) for size in sizes]
    ones = np.ones(sizes[0], np.float32)
    bounds = (spec.action_low, spec.action_high)
    return Policy(weights, (zeros[1], zeros[2]), zeros[2], zeros[0], ones, 10.0, *bounds)


def through_gymnasium(task, copies, seed):
    made = [lambda: make_gymnasium(task)] * copies
    return wrap_gymnasium(SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP), seed)


def play(env, policy, copies, steps):
    """Returns and lengths of each copy's first episode, or of as much of it as `steps` hold."""
    observations = env.reset()
    returns, lengths, running = np.zeros(copies), np.zeros(copies, int), np.ones(copies, bool)
    for _ in range(steps):
        step = env.step(policy(observations))
        returns += np.where(running, step.rewards, 0.0)
        lengths += running
        running &= ~(step.terminated | step.truncated)
        observations = step.observations
        if not running.any():
            break
    env.close()
    return returns, lengths


def welch(one, other):
    """p of equal means; and the difference that a test at `LEVEL` finds with 90% probability at these spreads."""
    if np.ptp(np.concatenate([one, other])) == 0:
        return 1.0, 0.0
    degrees = len(one) + len(other) - 2
    error = np.sqrt(one.var(ddof=1) / len(one) + other.var(ddof=1) / len(other))
    detects = error * (stats.t.ppf(1 - LEVEL / 2, degrees) + stats.t.ppf(0.9, degrees))
    moments = [f(sample) for sample in (one, other) for f in (np.mean, lambda x: np.std(x, ddof=1), len)]
    return stats.ttest_ind_from_stats(*moments, equal_var=False).pvalue, detects


@pytest.fixture(scope="module")
def played():
    """(returns, lengths) in EnvPool and in Gymnasium, by task; played once."""
    known = {}

    def both(task):
        if task not in known:
            (copies, steps, _), policy = SAMPLES[task], make_policy(task)
            envs = make_vector_env(task, copies, 0), through_gymnasium(task, copies, 1000)
            known[task] = [play(env, policy, copies, steps) for env in envs]
        return known[task]

    return both


def test_every_task_that_envpool_serves_is_compared():
    assert {task for task, spec in CATALOGUE.items() if spec.backend == "envpool"} == set(SAMPLES)


@pytest.mark.parametrize("task", SAMPLES)
def test_returns_and_lengths_agree(task, played):
    (returns, lengths), (their_returns, their_lengths) = played(task)
    p, detects = welch(returns, their_returns)
    assert p > LEVEL
    assert detects < SAMPLES[task][2]
    assert welch(lengths.astype(float), their_lengths.astype(float))[0] > LEVEL
    ends_early = (lengths < SAMPLES[task][1]).any()
    assert ends_early == CATALOGUE[task].terminates
    # Planted: half as much again as the test is said to find.
    assert welch(returns + 1.5 * SAMPLES[task][2], their_returns)[0] < LEVEL


# task: leading positions that are not observed, whether velocities are clipped at 10 when they are observed
PLANAR = {"HalfCheetah-v5": (1, False), "Hopper-v5": (1, True), "Swimmer-v5": (2, False), "Walker2d-v5": (1, True)}


@pytest.mark.parametrize("task", PLANAR)
def test_one_step_from_the_same_state_agrees(task):
    """EnvPool's observation put into Gymnasium as its state: both go on alike, but for the rounding to float32."""
    (hidden, clipped), policy = PLANAR[task], make_policy(task)
    env, differences = make_vector_env(task, 4, 0), []
    observations = env.reset()
    with make_gymnasium(task) as other:
        other.reset(seed=0)
        base = other.unwrapped
        positions = base.model.nq - hidden
        for _ in range(60):
            actions = policy(observations)
            step = env.step(actions)
            for i in np.flatnonzero(step.valid):
                state = observations[i].astype(np.float64)
                if clipped and np.abs(state[positions:]).max() > 9.9:
                    continue
                base.set_state(np.append(np.zeros(hidden), state[:positions]), state[positions:])
                successor, reward, *_ = base.step(actions[i])
                error = np.abs(successor - step.next_observations[i]).max()
                differences.append((error, abs(reward - step.rewards[i]), np.abs(successor - state).max()))
            observations = step.observations
    env.close()
    error, reward_error, moved = np.median(differences, axis=0)
    assert len(differences) > 30
    assert error < 2e-6
    assert reward_error < 1e-6
    assert moved > 0.01  # planted: standing still would be seen
