import dataclasses

import numpy as np
import pytest

from logs.logs_made import LENGTHS, make_arrays, make_logs
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs


def test_counts_slices_and_returns_equal_hand_values():
    logs = Logs(
        np.arange(10).reshape(5, 2), np.zeros((5, 1)), np.array([0, 1, 0, 0, 1]), rewards=np.array([1, 2, 3, 4, 5])
    )
    assert (logs.num_rows, logs.num_episodes, logs.observation_size, logs.action_size) == (5, 2, 2, 1)
    assert logs.episode_slices() == [slice(0, 2), slice(2, 5)]
    assert logs.episode_lengths().tolist() == [2, 3]
    assert logs.episode_returns().tolist() == [3, 12]
    assert logs.observations.dtype == np.float32
    assert logs.episode_ends.dtype == bool
    assert "5 rows, 2 episodes" in repr(logs)


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99, 1.0])
def test_returns_to_go_equal_the_brute_force_sum(gamma):
    logs = make_logs()
    expected, start = [], 0
    for length in LENGTHS:
        rewards = logs.rewards[start : start + length].astype(np.float64)
        expected += [sum(gamma**k * rewards[t + k] for k in range(length - t)) for t in range(length)]
        start += length
    result = logs.returns_to_go(gamma)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, expected, rtol=1e-6)


def test_returns_without_rewards_are_none():
    logs = make_logs(rewards=None)
    assert logs.returns_to_go(0.9) is None
    assert logs.episode_returns() is None


def test_select_keeps_episodes_whole_and_in_the_given_order():
    logs = make_logs()
    chosen = logs.select([2, 0])
    np.testing.assert_array_equal(chosen.observations, np.concatenate([logs.observations[7:], logs.observations[:4]]))
    assert chosen.episode_lengths().tolist() == [5, 4]
    assert chosen.terminated.tolist() == [False] * 8 + [True]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("fraction", [0.01, 0.1, 0.5, 0.99])
def test_split_never_shares_an_episode_and_loses_no_row(seed, fraction):
    lengths = [3 + i % 4 for i in range(17)]
    ids = np.repeat(np.arange(17), lengths)
    logs = make_logs(lengths, observations=np.stack([ids, np.arange(len(ids))], axis=1))
    train, validation = logs.split(fraction, seed)
    ids_of = [set(part.observations[:, 0].tolist()) for part in (train, validation)]
    assert not ids_of[0] & ids_of[1]
    assert all(ids_of)
    rows = np.concatenate([train.observations[:, 1], validation.observations[:, 1]])
    assert sorted(rows) == list(range(len(ids)))
    assert len(ids_of[1]) == min(max(round(fraction * 17), 1), 16)


def test_split_depends_on_the_seed_alone():
    logs = make_logs([2] * 40)
    assert logs.split(seed=3)[1].hash() == logs.split(seed=3)[1].hash()
    assert logs.split(seed=3)[1].hash() != logs.split(seed=4)[1].hash()


def test_a_single_episode_is_cut_at_its_last_tenth():
    ends = np.arange(20) == 19
    logs = Logs(np.arange(20.0)[:, None], np.zeros((20, 1)), ends, terminated=ends)
    train, validation = logs.split()
    assert train.observations[:, 0].tolist() == list(range(18))
    assert validation.observations[:, 0].tolist() == [18, 19]
    assert train.episode_ends[-1]
    assert not train.terminated.any()  # a cut is no termination
    assert validation.terminated.tolist() == [False, True]


def test_hash_is_stable_and_one_flipped_bit_changes_it():
    logs = make_logs(task="Hopper-v5", action_low=np.full(2, -1.0), action_high=np.ones(2))
    assert logs.hash() == make_logs(task="Hopper-v5", action_low=np.full(2, -1.0), action_high=np.ones(2)).hash()
    for name in ("observations", "actions", "rewards", "action_low"):
        array = getattr(logs, name).copy()
        array.view(np.uint32).reshape(-1)[-1] ^= 1
        assert dataclasses.replace(logs, **{name: array}).hash() != logs.hash(), name
    flipped = logs.terminated.copy()
    flipped[-1] ^= True
    assert dataclasses.replace(logs, terminated=flipped).hash() != logs.hash()
    assert dataclasses.replace(logs, terminated=None).hash() != logs.hash()
    assert dataclasses.replace(logs, task="Hopper-v4").hash() != logs.hash()
    assert dataclasses.replace(logs, source="elsewhere").hash() == logs.hash()


def test_arrays_are_read_only_but_the_callers_stay_writable():
    arrays = make_arrays()
    logs = Logs(arrays["observations"], arrays["actions"], arrays["terminated"] | arrays["truncated"])
    with pytest.raises(ValueError, match="read-only"):
        logs.observations[0, 0] = 1.0
    arrays["observations"][0, 0] = 1.0


def _with(name, index, value, dtype=None):
    array = make_arrays()[name].astype(dtype) if dtype else make_arrays()[name].copy()
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (_with("observations", (5, 2), np.nan), r"observations is nan at row 5, column 2 \(1 such"),
        (_with("actions", (1, 1), -np.inf), "actions is -inf at row 1, column 1"),
        (_with("rewards", 7, np.nan), "rewards is nan at row 7"),
        (_with("observations", (5, 2), 1e300, np.float64), r"observations is 1e\+300 at row 5"),
        ({"actions": np.zeros(12)}, r"actions has shape \(12,\): must be \(rows, act\), so \(12, 1\) if"),
        ({"observations": np.zeros((12, 3, 1))}, r"observations has shape \(12, 3, 1\): must be \(rows, obs\)"),
        ({"observations": np.zeros((12, 0))}, "at least one row and one column"),
        ({"actions": np.array([["a"] * 2] * 12)}, "actions has dtype <U1: must be numbers"),
        ({"actions": np.zeros((12, 2), complex)}, "actions has dtype complex128: must be numbers"),
        ({"actions": np.array([[None] * 2] * 12)}, "actions has dtype object: must be numbers"),
        ({"actions": np.zeros((11, 2))}, "actions has 11 rows but observations has 12"),
        ({"rewards": np.zeros((12, 1))}, r"rewards has shape \(12, 1\): must be \(rows,\)"),
        ({"rewards": np.zeros(13)}, "rewards has 13 rows"),
        ({"terminated": np.full(12, 2)}, "terminated is 2 at row 0: must be 0 or 1"),
        ({"terminated": np.zeros((12, 1))}, r"terminated has shape \(12, 1\)"),
        ({"terminated": np.ones(12, bool)}, "terminated is True at row 0 where episode_ends is False"),
        ({"episode_ends": np.zeros(12, bool)}, "episode_ends is False at row 11"),
        ({"action_low": np.zeros(2)}, "action_high is None"),
        ({"action_low": np.zeros(3), "action_high": np.ones(3)}, "action_low has 3 entries but actions has 2 columns"),
        ({"action_low": np.array([0, 1]), "action_high": np.ones(2)}, "in column 1: action_low must be below"),
        ({"action_low": np.array([0, np.nan]), "action_high": np.ones(2)}, "action_low is nan at row 1"),
        ({"task": " "}, "task is ' ': must be a Gymnasium id"),
    ],
)
def test_bad_fields_are_named_in_one_line(changes, message):
    with pytest.raises(InputError, match=message) as caught:
        make_logs(**changes)
    assert "\n" not in str(caught.value)


def test_infinite_action_bounds_are_allowed():
    assert make_logs(action_low=np.full(2, -np.inf), action_high=np.full(2, np.inf)).action_high[0] == np.inf


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda logs: logs.select([]), "at least one integer"),
        (lambda logs: logs.select([3]), "episode_indices has 3: must lie in 0 to 2"),
        (lambda logs: logs.select([-1]), "episode_indices has -1"),
        (lambda logs: logs.select([True, False, True]), "at least one integer"),
        (lambda logs: logs.split(0.0), "validation_fraction is 0.0"),
        (lambda logs: logs.split(1.0), "validation_fraction is 1.0"),
        (lambda logs: logs.split(float("nan")), "validation_fraction is nan"),
        (lambda logs: logs.returns_to_go(1.1), "gamma is 1.1: must lie in"),
        (lambda logs: Logs(np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1)).split(), "1 row cannot be split"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call(make_logs())
