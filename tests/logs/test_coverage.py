"""Coverage levels (5.6): what each keeps, held against counts made by hand."""

import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.logs import Logs, load_logs
from ppo_dap.logs.coverage import SEGMENT, STRATA, best_episodes, cover, coverage_statistics


def ladder(episodes=50, length=20, seed=0):
    """Episode i has return i and actions of spread 0.1 + i / 100."""
    rng = np.random.default_rng(seed)
    rewards = np.repeat(np.arange(episodes) / length, length)
    actions = rng.normal(size=(episodes * length, 2)) * np.repeat(0.1 + np.arange(episodes) / 100, length)[:, None]
    ends = np.tile(np.arange(length) == length - 1, episodes)
    observations = np.repeat(np.arange(episodes), length)[:, None] + np.zeros((1, 3))
    return Logs(observations=observations, actions=actions, episode_ends=ends, rewards=rewards)


def episodes_of(logs):
    return set(np.unique(logs.observations[:, 0]).astype(int).tolist())


def test_wide_is_all_of_it():
    logs = ladder()
    assert cover(logs, "wide") is logs


def test_medium_keeps_the_share_of_every_stratum():
    kept = episodes_of(cover(ladder(), "medium", seed=3, fraction=0.3))
    counts = [sum(10 * i <= episode < 10 * (i + 1) for episode in kept) for i in range(STRATA)]
    assert counts == [3] * STRATA


def test_medium_is_seeded():
    logs = ladder()
    same, again, other = (cover(logs, "medium", seed=seed).hash() for seed in (1, 1, 2))
    assert same == again != other


def test_narrow_leaves_out_the_best_the_worst_and_the_straying():
    """Actions of one size in a segment, plus and minus, so that which segments stray least is known beforehand."""
    rng = np.random.default_rng(1)
    sizes = rng.permutation(np.linspace(0.1, 1.0, 100))  # of the 100 segments of 50 episodes
    signs = np.tile([1.0, -1.0], 500)
    logs = ladder()
    logs = Logs(
        observations=np.stack([logs.observations[:, 0], np.repeat(sizes, SEGMENT), signs], axis=1),
        actions=(signs * np.repeat(sizes, SEGMENT))[:, None],
        episode_ends=logs.episode_ends,
        rewards=logs.rewards,
    )
    narrow = cover(logs, "narrow", fraction=0.3)
    # Returns 0 to 49: the 10th percentile is 4.9 and the 60th 29.4. Their episodes hold segments 10 to 59.
    assert episodes_of(narrow) <= set(range(5, 30))
    assert narrow.num_rows == 0.3 * logs.num_rows
    smallest = np.sort(sizes[10:60])[:30]
    np.testing.assert_allclose(np.unique(narrow.observations[:, 1]), smallest, rtol=1e-6)


def test_a_cut_of_narrow_ends_an_episode():
    logs = ladder()
    numbered = Logs(
        observations=np.arange(logs.num_rows)[:, None],
        actions=logs.actions,
        episode_ends=logs.episode_ends,
        rewards=logs.rewards,
    )
    narrow = cover(numbered, "narrow")
    for rows in narrow.episode_slices():
        row = narrow.observations[rows, 0]
        np.testing.assert_array_equal(np.diff(row), 1)
        assert row[0] // 20 == row[-1] // 20
    assert min(narrow.episode_lengths()) == SEGMENT < 20


def test_levels_of_one_size_differ_in_what_they_hold():
    logs = load_logs("hopper-medium")
    wide, medium, narrow = (coverage_statistics(cover(logs, level)) for level in ("wide", "medium", "narrow"))
    assert abs(medium["rows"] - narrow["rows"]) < 0.05 * wide["rows"]
    assert narrow["action_std"] < 0.96 * medium["action_std"]
    assert narrow["action_log_volume"] < medium["action_log_volume"] - 0.1
    assert medium["action_std"] == pytest.approx(wide["action_std"], rel=0.02)
    assert medium["reward_mean"] == pytest.approx(wide["reward_mean"], rel=0.02)


def test_volume_is_the_gaussians_entropy_up_to_a_constant():
    rng = np.random.default_rng(0)
    mixing = np.array([[1.0, 0.0], [2.0, 0.5]])
    actions = rng.normal(size=(200_000, 2)) @ mixing.T
    ends = np.zeros(len(actions), bool)
    ends[-1] = True
    logs = Logs(observations=np.zeros((len(actions), 1)), actions=actions, episode_ends=ends)
    assert coverage_statistics(logs)["action_log_volume"] == pytest.approx(np.log(0.5), abs=0.01)


@pytest.mark.parametrize(
    ("change", "level", "message"),
    [
        (lambda logs: logs, "broad", "coverage 'broad'"),
        (lambda logs: Logs(logs.observations, logs.actions, logs.episode_ends), "medium", "no rewards"),
        (lambda logs: logs.select(range(9)), "narrow", "needs 10 episodes"),
    ],
)
def test_what_cannot_be_covered_is_refused(change, level, message):
    with pytest.raises(InputError, match=message):
        cover(change(ladder()), level)


def test_too_little_of_middling_return_is_refused():
    logs = ladder(length=4).select([*range(50)])
    long = Logs(
        observations=np.concatenate([logs.observations, np.full((2000, 3), 50.0)]),
        actions=np.concatenate([logs.actions, np.zeros((2000, 2))]),
        episode_ends=np.concatenate([logs.episode_ends, np.arange(2000) == 1999]),
        rewards=np.concatenate([logs.rewards, np.full(2000, 1.0)]),
    )
    with pytest.raises(InputError, match="middling return hold 104 rows of 2200"):
        cover(long, "narrow")


def returning(returns, lengths):
    """Episodes with these returns, all earned at a random row; row t's observation is (episode, t)."""
    rng = np.random.default_rng(0)
    rewards = [np.eye(length)[rng.integers(length)] * g for g, length in zip(returns, lengths, strict=True)]
    rows = sum(lengths)
    ends = np.isin(np.arange(rows), np.cumsum(lengths) - 1)
    episode = np.repeat(np.arange(len(lengths)), lengths)
    observations = np.stack([episode, np.arange(rows)], axis=1)
    return Logs(observations, rng.normal(size=(rows, 2)), ends, rewards=np.concatenate(rewards))


@pytest.mark.parametrize("share", [1e-6, 0.1, 0.33, 0.5, 0.8, 0.999])
def test_the_best_episodes_are_the_fewest_of_highest_return_that_hold_the_share(share):
    rng = np.random.default_rng(3)
    lengths = rng.integers(1, 60, 40)
    logs = returning(rng.normal(size=40) * 100, lengths)
    best = best_episodes(logs, share)
    # By hand: the next best, one at a time.
    left, chosen, rows = list(range(40)), [], 0
    totals = [float(logs.rewards[part].astype(np.float64).sum()) for part in logs.episode_slices()]
    while rows < share * logs.num_rows:
        chosen.append(max(left, key=lambda i: totals[i]))
        left.remove(chosen[-1])
        rows += int(lengths[chosen[-1]])
    expected = np.concatenate([np.arange(logs.num_rows)[logs.episode_slices()[i]] for i in sorted(chosen)])
    assert best.observations[:, 1].tolist() == expected.tolist()
    assert best.actions.tolist() == logs.actions[expected].tolist()
    assert best.episode_lengths().tolist() == [lengths[i] for i in sorted(chosen)]


def test_ties_go_to_the_earlier_episode_and_whole_shares_are_met_exactly():
    logs = returning([1.0, 2.0, 2.0, 2.0, 0.0], [20] * 5)
    assert episodes_of(best_episodes(logs, 0.2)) == {1}
    assert episodes_of(best_episodes(logs, 0.4)) == {1, 2}
    assert episodes_of(best_episodes(logs, 0.6)) == {1, 2, 3}
    assert episodes_of(best_episodes(logs, 0.61)) == {0, 1, 2, 3}
    # 0.55 of 100 is above 55 in floating point, and must not cost another episode.
    assert best_episodes(returning(range(20), [5] * 20), 0.55).num_episodes == 11


def test_the_best_of_all_is_all():
    logs = returning([3.0, 1.0], [4, 2])
    assert best_episodes(logs, 1.0) is logs
    assert best_episodes(logs, 0.9).hash() == logs.hash()


@pytest.mark.parametrize("share", [0.0, -0.5, 1.5, float("nan")])
def test_an_impossible_share_is_refused(share):
    with pytest.raises(InputError, match=r"logs_filter is .*: must be above 0 and at most 1"):
        best_episodes(ladder(), share)


def test_logs_without_rewards_have_no_best():
    logs = ladder()
    with pytest.raises(InputError, match=r"memory has no rewards: use logs with rewards, or no filter") as caught:
        best_episodes(Logs(logs.observations, logs.actions, logs.episode_ends), 0.5)
    assert "\n" not in str(caught.value)
