"""`load_logs`: one name for every place that logs can come from."""

import os
from dataclasses import replace
from pathlib import Path

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.hdf5 import is_minari, open_hdf5, read_d4rl
from ppo_dap.logs.minari_folder import DATASET_ID, MAIN_FILE, is_dataset_folder, read_minari, read_minari_id
from ppo_dap.logs.npz import read_npz

SAMPLES = Path(__file__).parent / "samples"
HDF5_SUFFIXES = (".hdf5", ".h5")
FORMS = "a .npz file, a D4RL-layout .hdf5 or .h5 file, a Minari folder or a Minari id such as mujoco/hopper/medium-v0"


def sample_names() -> list[str]:
    """Names of the logs that the package ships, sorted."""
    return sorted(path.stem for path in SAMPLES.glob("*.npz"))


def load_logs(source: str | os.PathLike, task: str | None = None) -> Logs:
    """Read logged trajectories; only states and actions are required of them.

    `source` is, in this order: an existing path (a `.npz` file, a `.hdf5` or `.h5` file in D4RL layout, a Minari
    dataset folder), the name of a shipped sample, or a Minari id in the local Minari root (nothing is downloaded).
    `task`, a Gymnasium id, replaces the task that the file names. Nothing is unpickled and no code is run.

    Warns with `LogsWarning` when nothing marks where episodes end. Raises `InputError`, one line, for all bad input.
    """
    logs = _read(source)
    return logs if task is None else replace(logs, task=task)


def _read(source: str | os.PathLike) -> Logs:
    if not os.fspath(source):
        raise InputError(f"logs source is empty: {_choices()}")
    path = Path(source).expanduser()
    name = str(source)
    if path.exists():
        return _read_path(path)
    if name in sample_names():
        return replace(read_npz(SAMPLES / f"{name}.npz"), source=name)
    if path.suffix in (".npz", *HDF5_SUFFIXES):
        raise InputError(f"{path}: no such file: must be an existing file")
    if DATASET_ID.fullmatch(name):
        return read_minari_id(name)
    raise InputError(f"unknown logs {name!r}: {_choices()}")


def _choices() -> str:
    samples = ", ".join(sample_names()) or "none"
    return f"must be a shipped sample ({samples}), {FORMS}"


def _read_path(path: Path) -> Logs:
    if path.is_dir():
        if is_dataset_folder(path):
            return read_minari(path)
        clash = "; the shipped sample of this name is hidden by the folder" if str(path) in sample_names() else ""
        raise InputError(f"{path}: a folder without data/{MAIN_FILE}: must be a Minari dataset{clash}")
    if path.suffix == ".npz":
        return read_npz(path)
    if path.suffix not in HDF5_SUFFIXES:
        raise InputError(f"{path}: unknown file type {path.suffix!r}: must be .npz, .hdf5 or .h5")
    with open_hdf5(path) as file:
        minari = is_minari(file)
    if not minari:
        return read_d4rl(path)
    if path.name != MAIN_FILE:
        raise InputError(f"{path}: a Minari file by another name: must be {MAIN_FILE} in its dataset folder")
    return read_minari(path.parent)
