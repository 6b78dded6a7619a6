"""The control `shuffled:SOURCE`: the same rows, whose actions belong to other rows."""

import numpy as np
import pytest
from scipy import stats

from logs.logs_made import LENGTHS, fails, make_arrays, write_d4rl, write_minari, write_npz
from logs.tables_made import write_csv, write_lerobot, write_parquet
from ppo_dap.logs import LogsWarning, load_logs

KEPT = ("observations", "episode_ends", "rewards", "terminated", "next_observations", "times", "action_low")


def sorted_rows(array):
    return array[np.lexsort(array.T)]


def pairs(logs):
    """Each state with its action, in any order."""
    return sorted_rows(np.concatenate([logs.observations, logs.actions], axis=1))


def only_the_pairing_differs(plain, shuffled):
    for name in KEPT:
        np.testing.assert_equal(getattr(shuffled, name), getattr(plain, name))
    np.testing.assert_array_equal(sorted_rows(shuffled.actions), sorted_rows(plain.actions))
    assert np.any(pairs(shuffled) != pairs(plain))


def test_every_kind_of_source_can_be_shuffled(tmp_path, monkeypatch):
    folder = write_minari(tmp_path / "root", monkeypatch)
    sources = [
        write_npz(tmp_path / "a.npz", next_observations=make_arrays(seed=1)["observations"]),
        write_d4rl(tmp_path / "a.hdf5"),
        write_csv(tmp_path / "a.csv"),
        write_parquet(tmp_path / "a.parquet"),
        write_lerobot(tmp_path / "v2"),
        folder,
        "hand/made-v0",
        "hopper-medium",
    ]
    for source in sources:
        plain, shuffled = load_logs(source, task="Toy-v0"), load_logs(f"shuffled:{source}", "Toy-v0", seed=3)
        only_the_pairing_differs(plain, shuffled)
        assert shuffled.source == f"shuffled:{plain.source}"
        assert shuffled.task == "Toy-v0"
        assert shuffled.hash() != plain.hash()


def test_the_seed_is_the_order():
    same, again, other = (load_logs("shuffled:hopper-medium", seed=seed).hash() for seed in (1, 1, 2))
    assert same == again != other


def test_columns_are_those_of_the_source(tmp_path):
    arrays = make_arrays()
    table = {"a": arrays["observations"][:, 0], "b": arrays["actions"][:, 0], "e": np.repeat(np.arange(3), LENGTHS)}
    path = write_csv(tmp_path / "a.csv", table)
    columns = {"observations": "a", "actions": "b", "episode": "e"}
    only_the_pairing_differs(load_logs(path, columns=columns), load_logs(f"shuffled:{path}", columns=columns, seed=1))


def test_what_is_drawn_is_shuffled(tmp_path):
    path = write_npz(tmp_path / "a.npz", **make_arrays([50] * 200))
    drawn = []
    for source in (path, f"shuffled:{path}"):
        with pytest.warns(LogsWarning, match="kept"):
            drawn.append(load_logs(source, max_bytes=100_000, seed=5))
    assert drawn[0].drawn == drawn[1].drawn
    only_the_pairing_differs(*drawn)


def test_states_say_nothing_about_shuffled_actions():
    """Rank correlation of each state column with each action: some in these logs, chance alone once shuffled."""

    def strongest(logs):
        found = stats.spearmanr(logs.observations, logs.actions).statistic
        return np.abs(found[: logs.observation_size, logs.observation_size :]).max()

    plain, shuffled = load_logs("hopper-medium"), load_logs("shuffled:hopper-medium")
    assert strongest(plain) > 0.3
    assert strongest(shuffled) < 4.5 / np.sqrt(plain.num_rows)
    # Nor are neighbouring rows' actions alike, as they would be were episodes' actions moved together.
    actions = shuffled.actions[:, 0]
    assert abs(np.corrcoef(actions[1:], actions[:-1])[0, 1]) < 4.5 / np.sqrt(plain.num_rows)
    assert abs(np.corrcoef(plain.actions[1:, 0], plain.actions[:-1, 0])[0, 1]) > 0.3


def test_rows_moved_whole_would_be_found():
    """The planted fault: states and actions permuted together."""
    plain = load_logs("hopper-medium")
    moved = plain.take(np.random.default_rng(0).permutation(plain.num_rows))
    with pytest.raises(AssertionError):
        only_the_pairing_differs(plain, moved)


def test_an_existing_file_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_npz(tmp_path / "shuffled:a.npz")
    np.testing.assert_array_equal(load_logs("shuffled:a.npz").actions, make_arrays()["actions"])


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("shuffled:", "logs source is empty"),
        ("shuffled:none.npz", "none.npz: no such file"),
        ("shuffled:hopper", "unknown logs 'hopper'"),
    ],
)
def test_sources_that_are_none_are_refused(source, message):
    fails(source, message)
