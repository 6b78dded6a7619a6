"""Many copies on one model against Gymnasium's route: the same bits."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ppo_dap.tasks import VectorEnv, make_vector_env
from ppo_dap.tasks.catalogue import make_gymnasium
from ppo_dap.tasks.striker_vector import StrikerVectorEnv
from ppo_dap.tasks.vector import wrap_gymnasium

pytestmark = pytest.mark.usefixtures("without_video")

SEED = 7


def play(env, actions):
    """First observations and every field of every transition, as bytes; ends with a second reset."""
    seen = [env.reset().tobytes()]
    for action in actions:
        seen += [(part.dtype.str, part.tobytes()) for part in env.step(action)]
    seen.append(env.reset().tobytes())
    env.close()
    return seen


def gymnasiums(copies, seed):
    made = [lambda: make_gymnasium("Striker-v2")] * copies
    return wrap_gymnasium(SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP), seed)


def actions_for(copies, steps):
    """Beyond the motors' range too; as strong as a swing, so that arms, balls, cups and the table meet."""
    rng = np.random.default_rng(1)
    slow = np.repeat(rng.uniform(-4, 4, (steps // 10, copies, 7)), 10, axis=0)
    return slow.astype(np.float32)


@pytest.mark.parametrize(("copies", "threads"), [(8, 1), (8, 3), (2, 4), (1, 1)])
def test_it_gives_what_gymnasium_gives_bit_for_bit(copies, threads):
    actions = actions_for(copies, 220)
    env = make_vector_env("Striker-v2", copies, SEED, threads)
    assert isinstance(env, StrikerVectorEnv)
    assert isinstance(env, VectorEnv)
    assert play(env, actions) == play(gymnasiums(copies, SEED), actions)


def test_another_seed_or_another_action_gives_other_bits():
    actions = actions_for(2, 100)
    one = play(make_vector_env("Striker-v2", 2, SEED), actions)
    assert one != play(make_vector_env("Striker-v2", 2, SEED + 1), actions)
    actions[50, 1, 3] += 1e-3
    assert one != play(make_vector_env("Striker-v2", 2, SEED), actions)


def test_the_actions_of_the_comparison_hit_something():
    env = make_vector_env("Striker-v2", 8, SEED)
    before, steps = env.reset(), [env.step(a) for a in actions_for(8, 100)]
    ball_and_goal = steps[-1].next_observations[:, 17:23] - before[:, 17:23]
    assert (np.abs(ball_and_goal).max(1) > 0.01).sum() >= 2


def test_all_copies_are_truncated_together_with_their_true_last_observations():
    env = make_vector_env("ppo_dap/Striker-v2", 3, SEED)
    env.reset()
    for t in range(1, 201):
        step = env.step(np.zeros((3, 7), np.float32))
        assert step.valid.all()
        assert not step.terminated.any()
        np.testing.assert_array_equal(step.truncated, t % 100 == 0)
        same = np.array_equal(step.next_observations, step.observations)
        assert same == (t % 100 != 0)
    assert len(np.unique(step.observations[:, 20])) == 3  # each copy draws its own goal
