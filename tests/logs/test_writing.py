"""Minari datasets of ours, opened by Minari."""

import json

import numpy as np
import pytest

from logs.logs_made import make_logs
from ppo_dap.errors import InputError
from ppo_dap.logs import load_logs, save_minari

BOUNDS = {"action_low": np.full(2, -1.0, np.float32), "action_high": np.full(2, 2.0, np.float32)}
CARD = {"algorithm_name": "ppo-dap", "author": "somebody", "description": "made by hand", "seeds": [0, 1]}


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "root"))
    return tmp_path / "root"


def test_minari_itself_opens_what_we_write(root):
    import minari

    logs = make_logs(task="Pendulum-v1", **BOUNDS)
    final = np.arange(9, dtype=np.float32).reshape(3, 3)
    assert save_minari(logs, "hand/made-v1", CARD, final_observations=final) == root / "hand" / "made-v1"
    dataset = minari.load_dataset("hand/made-v1")
    assert (dataset.total_episodes, dataset.total_steps, dataset.env_spec.id) == (3, 12, "Pendulum-v1")
    assert dataset.storage.metadata["seeds"] == [0, 1]
    assert dataset.storage.metadata["author"] == {"somebody"}
    assert dataset.action_space.high.tolist() == [2, 2]
    for episode, rows, last in zip(dataset.iterate_episodes(), logs.episode_slices(), final, strict=True):
        np.testing.assert_array_equal(episode.observations[:-1], logs.observations[rows])
        np.testing.assert_array_equal(episode.observations[-1], last)
        np.testing.assert_array_equal(episode.actions, logs.actions[rows])
        np.testing.assert_array_equal(episode.terminations, logs.terminated[rows])
        np.testing.assert_array_equal(episode.truncations, logs.episode_ends[rows] & ~logs.terminated[rows])


@pytest.mark.parametrize("options", [{}, {"env_spec": False}])
def test_what_we_write_loads_to_the_same_hash(root, options):
    import minari

    logs = make_logs(task="Pendulum-v1", **BOUNDS)
    folder = save_minari(logs, "made-v0", {}, root=root, **options)
    loaded = load_logs(folder, task="Pendulum-v1")
    assert loaded.hash() == logs.hash() == load_logs("made-v0", task="Pendulum-v1").hash()
    assert load_logs(folder).task == (None if options else "Pendulum-v1")
    assert (minari.load_dataset("made-v0").env_spec is None) == bool(options)


def test_a_relative_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    logs = make_logs(task="Pendulum-v1", **BOUNDS)
    assert save_minari(logs, "hand/made-v1", CARD, root="logs") == tmp_path / "logs" / "hand" / "made-v1"
    assert load_logs("logs/hand/made-v1").hash() == logs.hash()


def test_unbounded_actions_and_no_task(root):
    save_minari(make_logs(), "made-v0", {})
    assert json.loads((root / "made-v0" / "data" / "metadata.json").read_text()).get("env_spec") is None
    loaded = load_logs("made-v0")
    np.testing.assert_array_equal(loaded.observations, make_logs().observations)
    assert np.isinf(loaded.action_high).all()


@pytest.mark.parametrize(
    ("changes", "arguments", "options", "match"),
    [
        ({"rewards": None}, ("made-v0", {}), {}, "the logs have no rewards: must have them"),
        ({"terminated": None}, ("made-v0", {}), {}, "the logs have no terminated"),
        ({}, ("../made-v0", {}), {}, "dataset_id is '../made-v0': must be such as"),
        ({}, ("made-v0", {"env_spec": "x"}), {}, "card has env_spec: must be left out"),
        ({}, ("made-v0", {"seed": np.zeros(1)}), {}, "card has seed .*: must be what JSON can hold"),
        ({"task": "Never-v0"}, ("made-v0", {}), {}, "task 'Never-v0' is not known to Gymnasium"),
        ({}, ("made-v0", {}), {"final_observations": np.zeros((3, 2), np.float32)}, r"\(3, 2\): must be \(3, 3\)"),
    ],
)
def test_what_cannot_be_a_dataset(root, changes, arguments, options, match):
    with pytest.raises(InputError, match=match):
        save_minari(make_logs(**changes), *arguments, **options)
    assert not root.exists() or list(root.iterdir()) == []


def test_nothing_is_written_over_or_left_behind(root, monkeypatch):
    save_minari(make_logs(), "made-v0", {})
    with pytest.raises(InputError, match="is there already: must be a new dataset"):
        save_minari(make_logs(), "made-v0", {})
    from minari.dataset._storages.hdf5_storage import HDF5Storage

    def full_disk(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(HDF5Storage, "update_episodes", full_disk)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\)"):
        save_minari(make_logs(), "made-v1", {})
    assert [path.name for path in root.iterdir()] == ["made-v0"]
