"""Logs above the budget: which episodes are kept, and how much memory it takes."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from logs.logs_made import fails, make_arrays, make_logs, write_d4rl, write_minari, write_npz
from logs.tables_made import make_columns, write_csv, write_lerobot, write_parquet
from ppo_dap.errors import InputError
from ppo_dap.logs import LogsWarning, load_logs, reading, sampling
from ppo_dap.logs.sampling import Budget, EpisodeSample

LENGTHS = tuple(20 + 7 * i % 31 for i in range(60))
ROW_BYTES = 4 * (3 + 2 + 1) + 2


@pytest.fixture
def small_parts(monkeypatch):
    """Pieces of a few rows, and no episodes drawn together."""
    monkeypatch.setattr(reading, "PIECE_BYTES", 700)
    monkeypatch.setattr(sampling, "GROUP_BYTES", 1)


def write_all(folder, monkeypatch, lengths=LENGTHS):
    """The episodes in every layout."""
    arrays = make_arrays(lengths)
    flags = {"terminals": arrays["terminated"], "timeouts": arrays["truncated"]}
    rows = {name: arrays[name] for name in ("observations", "actions", "rewards")}
    return [
        write_npz(folder / "a.npz", next_observations=None, **arrays),  # these count for the budget, and few have them
        write_d4rl(folder / "a.hdf5", terminated=None, truncated=None, next_observations=None, **rows, **flags),
        write_csv(folder / "a.csv", make_columns(arrays, lengths)),
        write_parquet(folder / "a.parquet", make_columns(arrays, lengths)),
        write_minari(folder / "hdf5", monkeypatch, lengths=lengths),
        write_minari(folder / "arrow", monkeypatch, lengths=lengths, data_format="arrow"),
        write_lerobot(folder / "v2", lengths=lengths),
        write_lerobot(folder / "v3", "v3.0", lengths=lengths),
    ]


def drawn_from(source, max_bytes, seed=0):
    with pytest.warns(LogsWarning, match=r"kept [\d,]+ of [\d,]+ rows .* drawn uniformly by seed"):
        return load_logs(source, max_bytes=max_bytes, seed=seed)


def test_whole_episodes_are_kept_the_same_from_every_layout(tmp_path, monkeypatch, small_parts):
    """By brute force: which episodes these are is found by their first rows, in a random order drawn by the seed."""
    full = make_logs(LENGTHS)
    slices = full.episode_slices()
    order = np.argsort(np.random.default_rng(3).random(len(slices)))
    fitting = np.cumsum(np.array(LENGTHS)[order]) <= 16 * 51
    expected = full.select(np.sort(order[fitting]))
    assert 10 < expected.num_episodes < 30
    for source in write_all(tmp_path, monkeypatch):
        whole = load_logs(source)
        assert whole.drawn is None
        np.testing.assert_array_equal(whole.observations, full.observations)
        # A LeRobot row has a time, and no termination.
        budget = 16 * 51 * (ROW_BYTES if whole.times is None else ROW_BYTES - 1 + 8)
        logs = drawn_from(source, budget, seed=3)
        assert logs.drawn["of_rows"] == sum(LENGTHS)
        assert (logs.drawn["of_episodes"], logs.drawn["seed"], logs.drawn["max_bytes"]) == (60, 3, budget)
        for name in ("observations", "actions", "rewards", "terminated", "episode_ends"):
            if getattr(whole, name) is not None:
                np.testing.assert_array_equal(getattr(logs, name), getattr(expected, name), err_msg=str(source))
        assert logs.select([0]).drawn == logs.drawn


def test_each_episode_is_as_likely_as_any_other(small_parts):
    """Over 200 seeds; a share has a standard deviation of at most 0.0354, and 4.5 of them are allowed."""
    lengths = np.tile([3, 3, 3, 3], 10)
    counts, total = np.zeros(40), 0
    for seed in range(200):
        sample = EpisodeSample(Budget(400, seed))
        ends = np.zeros(120, bool)
        ends[np.cumsum(lengths) - 1] = True
        for start in range(0, 120, 7):
            stop = min(start + 7, 120)
            sample.add({"x": np.arange(start, stop, dtype=np.float32), "episode_ends": ends[start:stop].copy()})
        rows, drawn = sample.result()
        kept = np.unique(rows["x"] // 3).astype(int)
        assert len(rows["x"]) == 3 * len(kept) == drawn["rows"]
        counts[kept] += 1
        total += len(kept)
    assert np.abs(counts / 200 - total / 200 / 40).max() < 4.5 * 0.0354


def test_an_episode_longer_than_the_budget_is_drawn_in_stretches(tmp_path, small_parts):
    """Its rows are in order and end where the next are missing; neighbouring stretches are one."""
    arrays = {**make_arrays((4000,)), "observations": np.arange(12000, dtype=np.float32).reshape(4000, 3)}
    path = write_npz(tmp_path / "a.npz", **arrays)
    logs = drawn_from(path, 20_000)
    assert 15_000 < logs.num_rows * ROW_BYTES <= 20_000
    steps = np.diff(logs.observations[:, 0])
    assert (steps > 0).all()
    np.testing.assert_array_equal(steps != 3, logs.episode_ends[:-1])
    assert not logs.terminated[:-1].any()


def test_short_episodes_are_drawn_with_their_neighbours(tmp_path):
    """64 KiB at a time, so that their book-keeping costs no more than their rows."""
    lengths = (2,) * 200_000
    path = write_npz(tmp_path / "a.npz", **make_arrays(lengths))
    logs = drawn_from(path, 3_000_000)
    assert set(logs.episode_lengths()) == {2}
    assert logs.num_rows * ROW_BYTES > 2_700_000


@pytest.mark.parametrize("max_bytes", [0, -1, 1.5, "many"])
def test_bad_budgets(tmp_path, max_bytes):
    with pytest.raises(InputError, match=r"max_bytes is .*: must be a whole number of bytes above 0"):
        EpisodeSample(Budget(max_bytes))
    fails(write_npz(tmp_path / "a.npz"), "max_bytes is 20: must hold a few rows", max_bytes=20)


def test_the_prior_says_what_was_drawn(tmp_path):
    import ppo_dap

    path = write_npz(tmp_path / "a.npz", **make_arrays(LENGTHS))
    quick = {"width": 8, "batch_size": 32, "max_steps": 4, "chunk_steps": 2, "action_low": -1.0, "action_high": 1.0}
    drawn = ppo_dap.fit_prior(drawn_from(path, 20_000, seed=5), **quick).training["drawn"]
    assert (drawn["of_rows"], drawn["seed"], drawn["max_bytes"]) == (sum(LENGTHS), 5, 20_000)
    assert "drawn" not in ppo_dap.fit_prior(load_logs(path), **quick).training


MEASURED = """
import sys, warnings
from ppo_dap.logs import load_logs
import h5py, pyarrow.csv, pyarrow.parquet
warnings.simplefilter("ignore")
load_logs("hopper-medium")
def peak():  # in KiB; getrusage's would be that of the process that started this one, if it was larger
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0])

before = peak()
logs = load_logs(sys.argv[1], max_bytes=int(sys.argv[2]))
print(logs.num_rows, (logs.drawn or {}).get("of_rows"), (peak() - before) // 1024)
"""
MOST_MIB = 120  # 4 for the rows, as much again while they are joined, and the libraries' own buffers


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux says what the most memory was")
@pytest.mark.parametrize("layout", ["hdf5", "gzip.hdf5", "npz", "parquet", "csv"])
def test_memory_is_bounded_by_the_budget_and_not_by_the_file(tmp_path, layout):
    """100 MB of rows (20 or 30 where they are slow to make) against a budget of 4 MiB."""
    count = {"csv": 250_000, "gzip.hdf5": 400_000}.get(layout, 1_200_000)
    block = np.random.default_rng(0).standard_normal((count // 100, 20), dtype=np.float32)
    rows = np.tile(np.round(block, 3) if layout == "csv" else block, (100, 1))
    ends = np.arange(count) % 500 == 499
    path = tmp_path / f"a.{layout}"
    if layout == "npz":
        np.savez(path, observations=rows[:, :15], actions=np.ascontiguousarray(rows[:, 15:]), truncated=ends)
    elif "hdf5" in layout:
        packed = {"compression": "gzip", "compression_opts": 1, "chunks": (2**14, 5)} if "gzip" in layout else {}
        with h5py.File(path, "w") as file:
            file.create_dataset("observations", data=rows[:, :15], **packed)
            file.create_dataset("actions", data=rows[:, 15:], **packed)
            file["timeouts"] = ends
    else:
        import pyarrow as pa
        from pyarrow import csv, parquet

        columns = {f"{'obs' if i < 15 else 'act'}_{i}": column for i, column in enumerate(rows.T)}
        table = pa.table({**columns, "episode": np.arange(count) // 500})
        csv.write_csv(table, path) if layout == "csv" else parquet.write_table(table, path, row_group_size=count)
    kept, of_rows, mebibytes = _measured(path, 2**22)
    assert of_rows == count
    assert 0.8 * 2**22 < kept * 81 <= 2**22
    assert mebibytes < MOST_MIB, f"{mebibytes} MiB"
    if layout == "hdf5":  # what is measured is no constant
        assert _measured(path, 2**30)[2] > 1.5 * MOST_MIB


def _measured(path, max_bytes):
    command = [sys.executable, "-c", MEASURED, str(path), str(max_bytes)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [int(word) if word != "None" else None for word in done.stdout.split()]
