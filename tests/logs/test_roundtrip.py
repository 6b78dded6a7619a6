"""The same episodes, written in every layout by the libraries that own it, load to the same bits."""

import shutil

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from logs.logs_made import fails, make_arrays, make_logs, write_d4rl, write_minari, write_npz
from logs.tables_made import make_columns, write_csv, write_lerobot, write_parquet
from ppo_dap.logs import LogsWarning, check_logs, load_logs

ALWAYS = ("observations", "actions", "episode_ends", "rewards")


def is_same(source, fields=(*ALWAYS, "terminated"), expected=None, **options):
    logs, expected = load_logs(source, **options), expected or make_logs()
    for name in fields:
        found = getattr(logs, name)
        assert found.dtype == getattr(expected, name).dtype
        np.testing.assert_array_equal(found, getattr(expected, name), err_msg=f"{source} {name}")
    return logs


def test_every_layout_loads_to_the_same_bits(tmp_path, monkeypatch):
    is_same(write_npz(tmp_path / "a.npz"))
    is_same(write_d4rl(tmp_path / "a.hdf5"))
    is_same(write_csv(tmp_path / "a.csv"))
    is_same(write_parquet(tmp_path / "a.parquet"))
    for layout in ("hdf5", "arrow", "parquet"):
        root = tmp_path / layout
        is_same(write_minari(root, monkeypatch, data_format=layout))
        assert is_same("hand/made-v0").action_high.tolist() == [2, 2]
    for version in ("v2.1", "v3.0"):
        logs = is_same(write_lerobot(tmp_path / version, version), ALWAYS)
        assert logs.terminated is None  # next.done does not say why an episode ended


def test_all_of_float32_survives_a_csv(tmp_path):
    bits = np.random.default_rng(0).integers(0, 2**32, 6000, dtype=np.uint32).view(np.float32)
    values = bits[np.isfinite(bits)][:5000]
    write_csv(tmp_path / "a.csv", {"episode": np.zeros(5000, int), "obs": values, "act": -values})
    logs = load_logs(tmp_path / "a.csv")
    np.testing.assert_array_equal(logs.observations[:, 0].view(np.uint32), values.view(np.uint32))


def test_rewards_and_flags_are_optional(tmp_path, monkeypatch):
    less = dict.fromkeys(("reward", "terminated", "truncated"))
    folder = write_minari(tmp_path / "root", monkeypatch)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        for name in ("rewards", "terminations", "truncations"):
            for episode in range(3):
                del file[f"episode_{episode}/{name}"]
    for source in (write_csv(tmp_path / "a.csv", **less), write_parquet(tmp_path / "a.parquet", **less), folder):
        logs = is_same(source, ("observations", "actions", "episode_ends"))
        assert (logs.rewards, logs.terminated) == (None, None)


def test_a_lerobot_dataset_as_a_hub_cache_holds_it(tmp_path):
    """The cache's folder holds links to files that are named by their hashes."""
    folder = write_lerobot(tmp_path / "snapshots" / "a", "v3.0")
    (tmp_path / "blobs").mkdir()
    for number, path in enumerate(folder.glob("data/*/*.parquet")):
        blob = tmp_path / "blobs" / str(number)
        shutil.move(path, blob)
        path.symlink_to(blob)
    is_same(folder, ALWAYS)


def test_a_single_file_of_a_lerobot_dataset_is_a_table(tmp_path):
    folder = write_lerobot(tmp_path / "a", "v3.0", lengths=(4, 8))
    logs = load_logs(folder / "data" / "chunk-000" / "file-000.parquet")
    assert logs.episode_lengths().tolist() == [4, 8]
    np.testing.assert_array_equal(logs.actions, make_logs((4, 8)).actions)


def test_lerobot_versions_places_and_holes(tmp_path):
    fails(write_lerobot(tmp_path / "a", codebase_version="v4.0"), "codebase_version 'v4.0': must be v2.x or v3.x")
    fails(write_lerobot(tmp_path / "b", codebase_version=None), "codebase_version None")
    fails(write_lerobot(tmp_path / "c", data_path="../../x.parquet"), "data_path '../../x.parquet': must begin with")
    folder = write_lerobot(tmp_path / "d")
    (folder / "data" / "chunk-000" / "episode_000001.parquet").unlink()
    with pytest.warns(LogsWarning, match="says 12 frames, but 9 are there: was the dataset downloaded in full"):
        assert load_logs(folder).episode_lengths().tolist() == [4, 5]
    shutil.rmtree(folder / "data")
    fails(folder, "has no files: must have Parquet files in data/chunk-")
    fails(write_lerobot(tmp_path / "e"), "must be names or prefixes of 'observation.state'", columns={"actions": "tau"})
    table = pq.read_table(tmp_path / "e" / "data" / "chunk-000" / "episode_000001.parquet")
    odd = table.set_column(0, "observation.state", pa.array([[1.0], [1.0, 2.0], [1.0]]))
    pq.write_table(odd, tmp_path / "e" / "data" / "chunk-000" / "episode_000001.parquet")
    fails(tmp_path / "e", "observation.state holds lists of 1 to 2 numbers: must be equally long")


def test_a_d4rl_file_with_unmarked_timeouts_is_flagged(tmp_path):
    """A slow state that moves as its velocity says, reset every 50 rows; D4RL files often lack the timeouts."""
    rng = np.random.default_rng(0)
    starts = rng.normal(0, 3, (20, 2))
    speeds = np.sin(np.arange(50) / 8)[None, :, None] * rng.uniform(0.5, 1.5, (20, 1, 2))
    moves = 0.05 * (speeds[:, 1:] + speeds[:, :-1]) / 2
    places = starts[:, None] + np.concatenate([np.zeros((20, 1, 2)), np.cumsum(moves, axis=1)], axis=1)
    ends = np.tile(np.arange(50) == 49, 20)
    arrays = {"observations": np.concatenate([places, speeds], axis=2).reshape(1000, 4)}
    arrays |= {"actions": rng.uniform(-1, 1, (1000, 2)), "rewards": np.zeros(1000), "terminals": np.zeros(1000, bool)}
    marked = check_logs(load_logs(write_d4rl(tmp_path / "a.hdf5", **arrays, timeouts=ends)))
    assert _level(marked, "unmarked ends") == "ok"
    ends[[249, 499]] = False
    missed = check_logs(load_logs(write_d4rl(tmp_path / "b.hdf5", **arrays, timeouts=ends)))
    assert _level(missed, "unmarked ends") == "warning"
    assert missed.exit_code == 1


def _level(report, name):
    return next(line.level for line in report.lines if line.name == name)


@pytest.mark.parametrize(
    "names",
    [
        ("observation.{}", "action.{}", "episode_index"),
        ("state_{}", "action_{}", "episode_id"),
        ("observations[{}]", "actions[{}]", "episode"),
        ("obs/{}", "act/{}", "episode"),
    ],
)
def test_prefixes_that_robots_use(tmp_path, names):
    arrays = make_arrays()
    columns = {names[0].format(i): column for i, column in enumerate(arrays["observations"].T)}
    columns |= {names[1].format(i): column for i, column in enumerate(arrays["actions"].T)}
    columns[names[2]] = np.repeat(["a", "b", "c"], [4, 3, 5])
    for write in (write_csv, write_parquet):
        is_same(write(tmp_path / f"a.{write.__name__[6:]}", columns), ("observations", "actions", "episode_ends"))


def test_columns_by_names_and_prefixes(tmp_path):
    arrays = make_arrays()
    made = make_columns()
    columns = {"tau": made["act_1"], "q_knee": made["obs_1"], "q_hip": made["obs_0"], "dq": made["obs_2"]}
    columns |= {"push": made["act_0"], "run": made["episode"], "r": made["reward"]}
    path = write_parquet(tmp_path / "a.parquet", columns)
    said = {"observations": ["q_", "dq"], "actions": ["push", "tau"], "episode": "run", "rewards": "r"}
    logs = is_same(path, ("actions", "episode_ends", "rewards"), columns=said)
    np.testing.assert_array_equal(logs.observations, arrays["observations"][:, [1, 0, 2]])  # q_ in the file's order
    fails(path, "has no observations .found 'tau', 'q_knee'.*must have columns such as obs_0")
    fails(path, "columns has actions .'pull'.: must be names or prefixes of", columns={**said, "actions": ["pull"]})
    fails(path, "columns has episode 'ruin': must be one of", columns={**said, "episode": "ruin"})
    fails(path, "column 'dq' is of observations and of actions", columns={**said, "actions": ["tau", "dq"]})
    fails(path, "unknown role in columns 'acts': did you mean 'actions'", columns={"acts": "tau"})
    fails(write_npz(tmp_path / "a.npz"), "columns is given: must be left out", columns={"actions": "tau"})
    with pytest.warns(LogsWarning, match="nothing marks an episode's end"):
        load_logs(write_csv(tmp_path / "a.csv", terminated=None, truncated=None), columns={"episode": None})


def test_numbered_columns_are_in_the_order_of_their_numbers(tmp_path):
    """As numbers and not as text, wherever in the file; a number that is missing is told."""
    columns = {f"obs_{i}": np.full(3, i) for i in sorted(range(12), key=str)} | {
        "act": np.arange(3),
        "episode": [0] * 3,
    }
    logs = load_logs(write_csv(tmp_path / "a.csv", columns))
    assert logs.observations[0].tolist() == list(range(12))
    del columns["obs_7"]
    fails(write_csv(tmp_path / "b.csv", columns), "obs_6, obs_8, .* are numbered with gaps")


def test_times_are_seconds_whatever_they_are_stored_as(tmp_path):
    """Time stamps are kept for check-logs, which finds the gap that the file has."""
    seconds = np.tile([0.0, 0.1, 0.2, 0.7], 3)
    dates = np.datetime64("2026-01-01T00:00:00.000") + (seconds * 1000).astype("timedelta64[ms]")
    for name, path in {
        "seconds": write_csv(tmp_path / "a.csv", timestamp=seconds),
        "dates": write_csv(tmp_path / "b.csv", time=[str(date).replace("T", " ") for date in dates]),
        "arrow": write_parquet(tmp_path / "a.parquet", time=dates),
    }.items():
        logs = load_logs(path)
        np.testing.assert_allclose(logs.times - logs.times[0], seconds, atol=1e-6, err_msg=name)
        (finding,) = [line for line in check_logs(logs).lines if line.name == "time step"]
        assert finding.level == "warning", name


@pytest.mark.parametrize("write", [write_csv, write_parquet])
@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"obs_1": None}, "obs_0, obs_2 are numbered with gaps"),
        ({"act_0": None, "act_1": None}, "has no actions"),
        ({"state_0": np.zeros(12)}, "has columns of obs and of state, both observations"),
        ({"step": [0, 1, 2, 3, 0, 1, 1, 0, 1, 2, 3, 4]}, "step is 1 at row 6 after 1 in the same episode: must incr"),
        ({"time": [0.5, float("nan")] + [9] * 10}, "time is not finite at row 1|time is empty at row 1"),
        ({"terminated": [0.5] + [0] * 11}, "terminated is 0.5 at row 0: must be 0 or 1|invalid value '0.5'"),
        ({"reward": ["much"] * 12}, "reward holds .*string: must hold numbers|invalid value 'much'"),
        ({"obs_2": [None, *range(11)]}, "obs_2 is empty at row 0: must have a value in every row"),
        ({"obs_2": [*range(11), float("inf")]}, "observations is inf at row 11, column 2"),
    ],
)
def test_bad_tables(tmp_path, write, changes, match):
    path = write(tmp_path / f"a.{write.__name__[6:]}", **changes)
    assert fails(path, match).startswith(str(path))


def test_rows_that_are_not_sorted_by_episode_are_told(tmp_path):
    path = write_csv(tmp_path / "a.csv", episode=[0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1], terminated=None, truncated=None)
    with pytest.warns(LogsWarning, match="episode 0 comes back at row 4 and counts as another") as caught:
        load_logs(path)
    assert len(caught) == 1
    with pytest.warns(LogsWarning, match="ignored columns rewrad: their names say no role"):
        load_logs(write_csv(tmp_path / "b.csv", rewrad=np.zeros(12)))


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    sources = [write_csv(tmp_path / "a.csv"), write_parquet(tmp_path / "a.parquet"), write_lerobot(tmp_path / "le")]
    sources.append(write_minari(tmp_path / "root", monkeypatch, data_format="arrow"))
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    for source in sources:
        fails(source, r"needs pyarrow: run `pip install ppo-dap\[tables\]`")


def test_what_numpy_savetxt_writes_is_read(tmp_path):
    arrays = make_arrays()
    columns = np.column_stack([*make_columns().values()])
    np.savetxt(tmp_path / "a.csv", columns, delimiter=",", header=", ".join(make_columns()))
    logs = load_logs(tmp_path / "a.csv")
    np.testing.assert_array_equal(logs.observations, arrays["observations"])
    np.testing.assert_array_equal(logs.terminated, arrays["terminated"])
