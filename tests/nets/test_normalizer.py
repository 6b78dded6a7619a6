from itertools import pairwise

import numpy as np
import pytest

from ppo_dap.nets.normalizer import RewardScale, RunningMoments

CUTS = [0, 1, 1, 7, 7, 200, 1000]


def in_pieces(rows):
    moments = RunningMoments.create(rows.shape[1])
    for start, end in pairwise(CUTS):
        moments = moments.update(rows[start:end])
    return moments


@pytest.mark.parametrize("offset", [0.0, 1e6, -1e6])
def test_moments_in_pieces_are_those_of_all_rows(offset):
    rows = np.random.default_rng(0).standard_normal((1000, 3)) * [1, 0.01, 30] + offset
    moments = in_pieces(rows)
    assert moments.count == 1000
    np.testing.assert_allclose(moments.mean, rows.mean(0), rtol=1e-12)
    np.testing.assert_allclose(moments.std, rows.std(0), rtol=1e-6)
    # Planted: the textbook formula in float32 loses it at this offset.
    single = rows.astype(np.float32)
    naive = np.sqrt(np.abs(np.square(single).mean(0) - np.square(single.mean(0))))
    assert np.allclose(naive, rows.std(0), rtol=1e-2) == (offset == 0)


def test_float32_rows_are_summed_in_float64():
    rows = (np.random.default_rng(0).standard_normal((1000, 2)) + 1e4).astype(np.float32)
    np.testing.assert_allclose(in_pieces(rows).std, rows.astype(np.float64).std(0), rtol=1e-9)


def test_nothing_new_changes_nothing():
    moments = in_pieces(np.random.default_rng(0).standard_normal((1000, 2)))
    assert moments.update(np.zeros((0, 2))) is moments


def test_where_nothing_varies_the_standard_deviation_is_1():
    fresh = RunningMoments.create(2)
    np.testing.assert_array_equal(fresh.std, [1, 1])
    np.testing.assert_array_equal(fresh.update(np.array([[5.0, 6.0]])).std, [1, 1])
    rows = np.stack([np.full(1000, 0.1), np.full(1000, 1e6), np.arange(1000.0)], 1)
    np.testing.assert_allclose(in_pieces(rows).std, [1, 1, rows[:, 2].std()])


def brute_force_std(rewards, ended, valid, gamma):
    """Spread of sum_k gamma^k r_(t-k) within an episode, written out for every row."""
    seen = []
    for env in range(rewards.shape[1]):
        episode = []
        for reward, end, counts in zip(rewards[:, env], ended[:, env], valid[:, env], strict=True):
            if counts:
                episode.append(float(reward))
                seen.append(sum(gamma**k * r for k, r in enumerate(reversed(episode))))
                if end:
                    episode = []
    return np.std(seen)


def random_rewards(time=60):
    rng = np.random.default_rng(0)
    ended = rng.random((time, 3)) < 0.15
    ended[1:] &= ~ended[:-1]
    valid = np.ones_like(ended)
    valid[1:] = ~ended[:-1]
    return np.where(valid, rng.standard_normal((time, 3)) + 1, 1e3), ended, valid


def test_reward_scale_is_the_spread_of_the_discounted_return():
    rewards, ended, valid = random_rewards()
    scale = RewardScale.create(3)
    assert scale.std == 1
    for part in (slice(0, 20), slice(20, 60)):  # episodes go on over the cut
        scale = scale.update(rewards[part], ended[part], valid[part], 0.9)
    assert scale.std == pytest.approx(brute_force_std(rewards, ended, valid, 0.9), rel=1e-9)
    # Planted: counting masked rows, or letting returns run over an episode's end, gives another number.
    everything = np.ones_like(valid)
    for fault in ((ended, everything), (np.zeros_like(ended), valid)):
        wrong = RewardScale.create(3).update(rewards, *fault, 0.9)
        assert wrong.std != pytest.approx(scale.std, rel=1e-2)


def test_a_restart_forgets_open_episodes_but_not_the_scale():
    rewards, ended, valid = random_rewards()
    scale = RewardScale.create(3).update(rewards, ended, valid, 0.9)
    restarted = scale.restart()
    assert restarted.std == scale.std
    assert np.any(scale.discounted)
    assert not np.any(restarted.discounted)
