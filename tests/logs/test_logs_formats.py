import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest

from logs.logs_made import edit_metadata, fails, make_arrays, make_logs, write_d4rl, write_minari, write_npz
from ppo_dap.errors import InputError
from ppo_dap.logs import LogsWarning, formats, load_logs, sample_names, save_npz


@pytest.fixture
def minari_folder(tmp_path, monkeypatch):
    return write_minari(tmp_path / "root", monkeypatch)


def test_the_same_episodes_load_the_same_from_every_format(tmp_path, minari_folder):
    sources = [
        write_npz(tmp_path / "a.npz"),
        write_npz(tmp_path / "b.npz", truncated=None, episode_id=np.repeat([7, 3, 5], [4, 3, 5])),
        write_d4rl(tmp_path / "a.hdf5", next_observations=np.zeros((12, 3)), **{"infos/qpos": np.zeros((12, 6))}),
        minari_folder,
        minari_folder / "data",
        minari_folder / "data" / "main_data.hdf5",
        "hand/made-v0",
    ]
    expected = make_logs()
    for source in sources:
        logs = load_logs(source)
        for name in ("observations", "actions", "episode_ends", "rewards", "terminated"):
            np.testing.assert_array_equal(getattr(logs, name), getattr(expected, name), err_msg=f"{source} {name}")
    minari = load_logs("hand/made-v0")
    assert minari.action_low.tolist() == [-1, -1]
    assert minari.action_high.tolist() == [2, 2]


def test_minari_without_metadata_and_with_an_environment(minari_folder):
    edit_metadata(minari_folder, env_spec='{"id": "Hopper-v5", "entry_point": "never:imported"}')
    assert load_logs(minari_folder).task == "Hopper-v5"
    assert load_logs(minari_folder, task="Walker2d-v5").task == "Walker2d-v5"
    (minari_folder / "data" / "metadata.json").unlink()
    with h5py.File(minari_folder / "data" / "main_data.hdf5", "a") as file:  # as Minari 0.4 wrote it
        file.attrs["env_spec"] = '{"id": "Ant-v4"}'
        file.attrs["action_space"] = '{"type": "Box", "low": [-3, -3], "high": [3, 3]}'
    logs = load_logs(minari_folder)
    assert logs.task == "Ant-v4"
    assert logs.action_high.tolist() == [3, 3]


def test_minari_episodes_are_in_numeric_order(minari_folder):
    with h5py.File(minari_folder / "data" / "main_data.hdf5", "a") as file:
        file.move("episode_0", "episode_10")
    assert load_logs(minari_folder).episode_lengths().tolist() == [3, 5, 4]


@pytest.mark.parametrize(("terminated", "truncated"), [("terminated", "truncated"), ("terminals", "timeouts")])
def test_npz_aliases_and_conversions(tmp_path, terminated, truncated):
    arrays = make_arrays()
    saved = {
        "observations": np.arange(36).reshape(12, 3),
        "actions": np.asfortranarray(arrays["actions"].astype(np.float64)),
        terminated: arrays["terminated"].astype(np.float32),
        truncated: arrays["truncated"].astype(np.int8),
        "task": "Hopper-v5",
    }
    np.savez_compressed(tmp_path / "a.npz", **saved)
    logs = load_logs(str(tmp_path / "a.npz"))
    assert logs.observations.dtype == logs.actions.dtype == np.float32
    np.testing.assert_array_equal(logs.actions, arrays["actions"])
    assert logs.task == "Hopper-v5"
    assert logs.rewards is None
    np.testing.assert_array_equal(logs.terminated, arrays["terminated"])


def test_timeouts_never_become_terminations(tmp_path):
    assert load_logs(write_d4rl(tmp_path / "a.h5", terminals=None)).terminated is None
    logs = load_logs(write_d4rl(tmp_path / "b.h5"))
    assert (logs.episode_ends & ~logs.terminated).sum() == 2


def test_nothing_marks_ends_warns_and_gives_one_episode(tmp_path):
    path = write_npz(tmp_path / "a.npz", terminated=None, truncated=None)
    with pytest.warns(LogsWarning, match="nothing marks an episode's end"):
        logs = load_logs(path)
    assert logs.num_episodes == 1
    load_logs(write_npz(path, terminated=None, truncated=None, episode_id=np.zeros(12, int)))  # said so: no warning


def test_d4rl_says_what_it_ignores(tmp_path):
    with pytest.warns(LogsWarning, match="ignored terminal, not of the D4RL layout"):
        load_logs(write_d4rl(tmp_path / "a.hdf5", terminal=np.zeros(12)))


@pytest.mark.parametrize("full", [True, False])
def test_save_npz_round_trips_with_the_same_bytes(tmp_path, full):
    bounds = {"task": "Hopper-v5", "action_low": np.full(2, -1.0), "action_high": np.ones(2)}
    logs = make_logs(**(bounds if full else {"rewards": None, "terminated": None}))
    save_npz(logs, tmp_path / "a.npz")
    save_npz(load_logs(tmp_path / "a.npz"), tmp_path / "b.npz")
    assert load_logs(tmp_path / "a.npz").hash() == logs.hash()
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["a.npz", "b.npz"]
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:  # numpy itself reads it too
        np.testing.assert_array_equal(arrays["actions"], logs.actions)


def test_save_npz_of_one_episode_loads_without_a_warning(tmp_path):
    logs = make_logs((12,), rewards=None, terminated=None)
    save_npz(logs, tmp_path / "a.npz")
    assert load_logs(tmp_path / "a.npz").hash() == logs.hash()


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    save_npz(make_logs(), path)
    before = path.read_bytes()

    def full_disk(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(InputError, match=r"a\.npz: cannot be written \(No space left"):
        save_npz(make_logs(rewards=None), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.parametrize(("path", "match"), [("file/a.npz", "cannot be written"), ("a.npy", "must end in .npz")])
def test_save_npz_refuses_bad_paths(tmp_path, path, match):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=match):
        save_npz(make_logs(), tmp_path / path)


def test_an_existing_path_wins_over_a_sample_and_a_sample_over_a_minari_id(tmp_path, minari_folder, monkeypatch):
    samples = tmp_path / "samples"
    samples.mkdir()
    monkeypatch.setattr(formats, "SAMPLES", samples)
    monkeypatch.chdir(tmp_path)
    save_npz(make_logs((6, 6)), samples / "made-v0.npz")
    shutil.copytree(minari_folder, minari_folder.parents[1] / "made-v0")
    assert sample_names() == ["made-v0"]
    sample = load_logs("made-v0")
    assert (sample.num_episodes, sample.source) == (2, "made-v0")
    fails("hand/other", r"unknown logs 'hand/other': must be a shipped sample \(made-v0\), a .npz")
    shutil.copytree(minari_folder, tmp_path / "made-v0")
    assert load_logs("made-v0").num_episodes == 3
    shutil.rmtree(tmp_path / "made-v0")
    (tmp_path / "made-v0").mkdir()
    fails("made-v0", "a folder without data/main_data.hdf5.*sample of this name is hidden")
    (samples / "made-v0.npz").unlink()
    (tmp_path / "made-v0").rmdir()
    assert load_logs("made-v0").num_episodes == 3


def test_sources_that_match_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "root"))
    fails("no/such-v3", "'no/such-v3' is not in .*root: run `minari download no/such-v3`")
    assert not (tmp_path / "root").exists()
    fails("", "logs source is empty: must be")
    fails("../x-v0", "unknown logs")
    fails("x" * 5000, "unknown logs")
    fails("hopper-medium", "seed is -1: must be a whole number of 0 or more", seed=-1)
    fails(tmp_path / "a.npz", "a.npz: no such file")
    fails(str(tmp_path / "a.h5"), "a.h5: no such file")
    (tmp_path / "a.txt").touch()
    fails(tmp_path / "a.txt", "unknown file type '.txt': must be .npz, .hdf5, .h5, .csv, .parquet")


def test_import_costs_no_heavy_library():
    heavy = "'h5py', 'minari', 'gymnasium', 'jax', 'pandas', 'pyarrow'"
    code = f"import sys, ppo_dap.logs; print([name for name in ({heavy}) if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
