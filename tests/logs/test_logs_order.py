"""Checks of the order of rows: each fires on a planted fault and not on the clean logs beside it."""

import dataclasses

import numpy as np
import pytest

from logs.logs_made import level, make_logs, message, write_d4rl, write_minari, write_npz
from ppo_dap.errors import InputError
from ppo_dap.logs import check_logs, load_logs, save_npz


def with_successors():
    """Three episodes with the true successors and time stamps of 0.1 s."""
    logs = make_logs()
    following = np.concatenate([logs.observations[1:], np.zeros((1, 3), np.float32)])
    following[logs.episode_ends] = 99.0
    times = np.concatenate([0.1 * np.arange(length) for length in logs.episode_lengths()])
    return dataclasses.replace(logs, next_observations=following, times=times)


def test_clean_logs_pass_every_check_of_order():
    report = check_logs(with_successors())
    for name in ("episodes", "terminations", "next observations", "time step", "returns"):
        assert level(report, name) == "ok"
        assert "not checked" not in message(report, name)
    assert "0.1 s, even" in message(report, "time step")
    bare = check_logs(make_logs(rewards=None, terminated=None))
    for name in ("terminations", "next observations", "time step", "returns"):
        assert message(bare, name).startswith("not checked")


def test_single_row_episodes():
    report = check_logs(make_logs([1, 1, 9, 9]))
    assert level(report, "episodes") == "warning"
    assert "2 have a single row" in message(report, "episodes")


def test_timeouts_flagged_as_terminations():
    logs = make_logs([5] * 6 + [3])
    flagged = dataclasses.replace(logs, terminated=logs.episode_ends)
    report = check_logs(flagged)
    assert level(report, "terminations") == "warning"
    assert "6 episodes of exactly 5 rows" in message(report, "terminations")
    some = logs.episode_ends.copy()
    some[4] = False
    assert level(check_logs(dataclasses.replace(logs, terminated=some)), "terminations") == "ok"


@pytest.mark.parametrize(
    ("rows", "values", "words"),
    [
        ([3, 6], "next episode", "at 2 of 2 episode ends the next observation is the next episode's first"),
        ([1, 4], "other", "2 of 9 rows are not followed by their next observation, first row 1: episode ends are"),
        (slice(None), "other", "9 of 9 rows are not followed by their next observation, first row 0: rows are shuff"),
    ],
)
def test_next_observations(rows, values, words):
    logs = with_successors()
    following = logs.next_observations.copy()
    following[rows] = np.roll(logs.observations, -1, axis=0)[rows] if values == "next episode" else 7.0
    report = check_logs(dataclasses.replace(logs, next_observations=following))
    assert level(report, "next observations") == "warning"
    assert message(report, "next observations").startswith(words)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda times: -times, "stands still or runs back in 9 of 9"),
        (lambda times: times + 0.5 * (np.arange(12) >= 9), "1 of 9 steps are gaps, the longest 0.6 s"),
        (lambda times: times + 0.02 * (np.arange(12) % 2), "0.12 s, but 44.4% of steps differ by more than 10%"),
    ],
)
def test_time_step(fault, words):
    logs = with_successors()
    report = check_logs(dataclasses.replace(logs, times=fault(logs.times)))
    assert level(report, "time step") == "warning"
    assert words in message(report, "time step")


def test_a_reward_that_is_an_error_value():
    rewards = make_logs().rewards.copy()
    rewards[7] = -1e6
    report = check_logs(make_logs(rewards=rewards))
    assert level(report, "returns") == "warning"
    assert "the reward -1e+06 of row 7" in message(report, "returns")
    assert level(check_logs(make_logs(rewards=np.arange(12) == 11)), "returns") == "ok"  # sparse is not an error


def test_successors_and_times_are_checked_hashed_and_taken_along():
    logs = with_successors()
    assert logs.times.dtype == np.float64
    assert logs.select([2, 0]).times.tolist() == [*logs.times[7:], *logs.times[:4]]
    np.testing.assert_array_equal(logs.select([1]).next_observations, logs.next_observations[4:7])
    bare = dataclasses.replace(logs, next_observations=None, times=None)
    hashes = {bare.hash(), logs.hash(), dataclasses.replace(logs, times=None).hash()}
    assert len(hashes) == 3
    assert make_logs().hash() == bare.hash()
    # The sample's hash as `ppo-dap collect` printed it when it was made, before there were these fields.
    assert load_logs("hopper-medium").hash() == "3eccfe413d83045f8bc64f3c2b39e69ac647d8e8f2517d96f159d8566a303282"
    for changes, words in (
        ({"next_observations": np.zeros((12, 2))}, "next_observations has 2 columns but observations has 3"),
        ({"next_observations": np.zeros((11, 3))}, "next_observations has 11 rows"),
        ({"times": np.zeros((12, 1))}, r"times has shape \(12, 1\)"),
        ({"times": np.full(12, np.nan)}, "times is nan at row 0"),
    ):
        with pytest.raises(InputError, match=words):
            make_logs(**changes)


def test_the_readers_keep_successors_and_times(tmp_path, monkeypatch):
    logs = with_successors()
    kept = {"next_observations": logs.next_observations, "times": logs.times}
    save_npz(logs, tmp_path / "saved.npz")
    assert load_logs(tmp_path / "saved.npz").hash() == logs.hash()
    for path in (write_npz(tmp_path / "a.npz", **kept), write_d4rl(tmp_path / "a.hdf5", **kept)):
        loaded = load_logs(path)
        np.testing.assert_array_equal(loaded.next_observations, logs.next_observations)
        np.testing.assert_array_equal(loaded.times, logs.times)
    minari = load_logs(write_minari(tmp_path / "root", monkeypatch))
    assert minari.next_observations is None  # there they can be no other than the next row
    assert minari.times is None
