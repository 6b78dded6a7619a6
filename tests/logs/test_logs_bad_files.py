import shutil
import zipfile

import h5py
import numpy as np
import pytest

from logs.logs_made import edit_metadata, fails, write_d4rl, write_minari, write_npz
from ppo_dap.errors import InputError
from ppo_dap.logs import LogsWarning, load_logs, reading


@pytest.fixture
def minari_folder(tmp_path, monkeypatch):
    return write_minari(tmp_path / "root", monkeypatch)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"observation": np.zeros(1)}, "unknown key 'observation': did you mean 'observations'.*known are.*episode_id"),
        ({"actions": None}, "has no actions: must have observations and actions"),
        ({"actions": None, "observations": None}, "has no observations and no actions"),
        ({"actions": np.zeros(12)}, r"actions has shape \(12,\): must be \(rows, act\), so \(12, 1\)"),
        ({"actions": np.array([["x"] * 2] * 12)}, "actions has dtype <U1"),
        ({"actions": np.array([[{}] * 2] * 12)}, "actions holds pickled Python objects, which are never loaded"),
        ({"observations": np.full((12, 3), np.nan)}, r"observations is nan at row 0, column 0 \(36 such"),
        ({"observations": np.zeros((0, 3))}, r"observations has shape \(0, 3\): must have at least one row"),
        ({"observations": np.zeros(12)}, r"observations has shape \(12,\)"),
        ({"truncated": np.zeros(11)}, "truncated has 11 rows but observations has 12"),
        ({"truncated": np.full(12, 0.5)}, "truncated is 0.5 at row 0: must be 0 or 1"),
        ({"timeouts": np.zeros(12)}, "has both truncated and timeouts"),
        ({"episode_id": np.zeros(12)}, "episode_id has shape .* dtype float64: must be integers"),
        ({"episode_id": np.zeros(9, int)}, "episode_id has 9 rows"),
        ({"task": np.array(3)}, "task has shape .* int64: must be one string"),
        ({"task": np.array(["a", "b"])}, r"task has shape \(2,\)"),
        ({"action_low": np.zeros(2)}, "action_high is None"),
    ],
)
def test_bad_npz(tmp_path, changes, match):
    path = write_npz(tmp_path / "bad.npz", **changes)
    assert fails(path, match).startswith(str(path))


def test_damaged_npz(tmp_path):
    path = tmp_path / "a.npz"
    whole = write_npz(path).read_bytes()
    for content, match in [
        (b"", "the file is empty"),
        (whole[: len(whole) // 2], "damaged or not of this format"),
        (b"hello" * 100, "damaged or not of this format"),
    ]:
        path.write_bytes(content)
        assert fails(path, match).startswith(str(path))
    np.save(tmp_path / "b.npy", np.zeros(3))
    (tmp_path / "b.npy").rename(path)
    fails(path, "damaged or not of this format")


def test_npz_members_are_checked_before_they_are_loaded(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"

    def write(name, content, compression=zipfile.ZIP_STORED):
        with zipfile.ZipFile(path, "w", compression) as archive:
            archive.writestr(name, content)
            archive.writestr("actions.npy", npy((5, 1), bytes(20)))

    def npy(shape, data=b"", version=1):
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
        return b"\x93NUMPY" + bytes([version, 0]) + len(header).to_bytes(2, "little") + header.encode() + data

    write("observations.npy", npy((2**40, 3)))
    fails(path, "observations declares 13194139533312 bytes .* but holds 0: both must be equal")
    write("observations.npy", npy((5, 3), bytes(59)))
    fails(path, "observations declares 60 bytes .* but holds 59")
    write("observations.npy", npy((5, 3), bytes(60), version=9))
    fails(path, r"observations has .npy version \(9, 0\)|damaged")
    write("observations.npy", npy((5, 3), bytes(60)), zipfile.ZIP_BZIP2)
    fails(path, "observations has zip compression 12")
    write("observations.npy", npy((-5, -3), bytes(60)))
    fails(path, r"observations declares 60 bytes \(\(-5, -3\)\) but holds 60")
    for name in ("../observations.npy", "observations.txt", "a/observations.npy"):
        write(name, b"")
        fails(path, "is not an array: must be KEY.npy")
    write_npz(path)
    for name, limit in (("SMALL_BYTES", 100), ("EXPANSION", 0.1)):
        monkeypatch.setattr(reading, name, limit)
    fails(path, "the archive declares [0-9]+ bytes in a file of [0-9]+: must be at most")


@pytest.mark.parametrize("writer", [write_npz, write_d4rl])
def test_random_damage_gives_logs_or_one_line(tmp_path, writer):
    path = tmp_path / ("a.npz" if writer is write_npz else "a.hdf5")
    whole = writer(path).read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    for _ in range(150):
        content = bytearray(whole)
        for place in rng.integers(len(whole), size=8):
            content[place] = rng.integers(256)
        path.write_bytes(content)
        try:
            load_logs(path)
        except LogsWarning:
            pass
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > 10
    assert all(message.startswith(str(path)) and "\n" not in message for message in messages)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"observations": None}, r"has no observations \(found actions, rewards, terminals, timeouts\)"),
        ({"observations": None, "observations/image": np.zeros(12)}, "observations is a group .image., so a Dict"),
        ({"rewards": h5py.ExternalLink("other.h5", "rewards")}, "rewards is a link: must be an array in this file"),
        ({"rewards": h5py.SoftLink("/actions")}, "rewards is a link"),
        ({"actions": np.zeros(12)}, r"actions has shape \(12,\)"),
        ({"actions": np.float32(3)}, r"actions has shape \(\)"),
        ({"actions": "text"}, "actions has dtype"),
        ({"timeouts": np.zeros(10, bool)}, "timeouts|truncated has 10 rows"),
        ({"rewards": np.full(12, np.inf)}, "rewards is inf at row 0"),
    ],
)
def test_bad_d4rl(tmp_path, changes, match):
    path = write_d4rl(tmp_path / "bad.hdf5", **changes)
    assert fails(path, match).startswith(str(path))


def test_damaged_hdf5(tmp_path):
    path = tmp_path / "a.hdf5"
    whole = write_d4rl(path).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert fails(path, "damaged or not of this format").startswith(str(path))
    path.write_bytes(b"")
    fails(path, "the file is empty: must hold")
    with h5py.File(path, "w") as file:
        file.create_dataset("observations", shape=(2**40, 3), dtype="f4", chunks=(1024, 3))
        file["actions"] = np.zeros((3, 1))
    fails(path, "observations declares 13194139533312 bytes in a file of")


@pytest.mark.parametrize(
    ("space", "match"),
    [
        ({"observation_space": '{"type": "Dict", "subspaces": {}}'}, "observation_space is Dict: must be Box"),
        ({"action_space": '{"type": "Discrete", "n": 3}'}, "action_space is Discrete: must be Box"),
        ({"action_space": "{"}, "metadata is not JSON"),
        ({"action_space": '{"type": "Box", "low": [0], "high": [1]}'}, "action_low has 1 entries but actions has 2"),
        ({"action_space": '{"type": "Box", "shape": [2, 2]}'}, r"action_space has shape \[2, 2\]: must be one flat"),
        ({"data_format": "arrow"}, "has no episodes: must have at least one"),
        ({"data_format": "tape"}, "data_format is 'tape': must be hdf5, arrow or parquet"),
        ({"env_spec": "{"}, "metadata is not JSON"),
        ({"env_spec": '{"id": 3}'}, "the dataset's task is 3: must be an id"),
    ],
)
def test_bad_minari_metadata(minari_folder, space, match):
    edit_metadata(minari_folder, **space)
    assert fails(minari_folder, match).startswith(str(minari_folder))


def _replace(file, name, value):
    del file[name]
    if value is not None:
        file[name] = value


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("episode_1/observations", np.zeros((3, 3)), "episode_1 has 3 actions and 3 observations: must have T actions"),
        ("episode_1/observations", None, "episode_1 has no observations"),
        ("episode_1/rewards", np.zeros(2), "episode_1 has 2 rewards and 3 actions: must be equal"),
        (
            "episode_1/observations",
            np.zeros((4, 5)),
            "observations has 5 columns from row 4 on and 3 before: must have",
        ),
    ],
)
def test_bad_minari_episodes(minari_folder, name, value, match):
    with h5py.File(minari_folder / "data" / "main_data.hdf5", "a") as file:
        _replace(file, name, value)
    message = fails(minari_folder, match)
    assert message.count(str(minari_folder)) == 1


def test_minari_dict_observations_and_other_faults(minari_folder, tmp_path):
    main = minari_folder / "data" / "main_data.hdf5"
    shutil.copy(main, tmp_path / "renamed.hdf5")
    fails(tmp_path / "renamed.hdf5", "a Minari file by another name: must be main_data.hdf5")
    with h5py.File(main, "a") as file:
        _replace(file, "episode_1/observations", None)
        file["episode_1/observations/goal"] = np.zeros((4, 3))
    fails(minari_folder, r"episode_1/observations is a group \(goal\), so a Dict or Tuple space")
    with h5py.File(main, "w"):
        pass
    fails(minari_folder, "has no episodes")
    main.unlink()
    fails(minari_folder, "no such file")
