"""`load_logs`: one name for every place that logs can come from."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.columns import Columns
from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.hdf5 import is_minari, open_hdf5, read_d4rl
from ppo_dap.logs.lerobot import INFO, is_lerobot_folder, read_lerobot
from ppo_dap.logs.minari_folder import DATASET_ID, MAIN_FILE, is_dataset_folder, read_minari, read_minari_id
from ppo_dap.logs.npz import read_npz
from ppo_dap.logs.sampling import MAX_BYTES, Budget
from ppo_dap.logs.tables import read_csv, read_parquet

SHUFFLED = "shuffled:"
SHUFFLE_STREAM = 5
"""Keeps the permutation apart from other draws by the same seed."""
SAMPLES = Path(__file__).parent / "samples"
HDF5_SUFFIXES = (".hdf5", ".h5")
TABLES = {".csv": read_csv, ".parquet": read_parquet}
SUFFIXES = (".npz", *HDF5_SUFFIXES, *TABLES)
FORMS = (
    "a .npz file, a D4RL-layout .hdf5 or .h5 file, a .csv or .parquet table, a LeRobot or Minari folder, "
    "or a Minari id such as mujoco/hopper/medium-v0"
)


def sample_names() -> list[str]:
    """Names of the logs that the package ships, sorted."""
    return sorted(path.stem for path in SAMPLES.glob("*.npz"))


def load_logs(
    source: str | os.PathLike,
    task: str | None = None,
    *,
    columns: Columns | None = None,
    max_bytes: int = MAX_BYTES,
    seed: int = 0,
) -> Logs:
    """Read logged trajectories; only states and actions are required of them.

    `source` is, in this order: an existing path (a `.npz` file, a `.hdf5` or `.h5` file in D4RL layout, a `.csv` or
    `.parquet` table, the folder of a Minari or LeRobot dataset), `shuffled:` and a source, the name of a shipped
    sample, or a Minari id in the local Minari root (nothing is downloaded). `task`, a Gymnasium id, replaces the task
    that the file names. `columns` says which columns of a table mean what, where their names do not: see
    `ppo_dap.logs.columns`. Nothing is unpickled and no code is run.

    `shuffled:` is a control: the source's rows with their actions permuted among all of them by `seed`, so that a state
    says nothing about its action.

    Files are read in pieces. Rows of more than `max_bytes` (as float32, in memory) are not all kept, but whole
    episodes, drawn uniformly by `seed`; `Logs.drawn` says how many.

    Warns with `LogsWarning` when nothing marks where episodes end, and when rows were left out. Raises `InputError`,
    one line, for all bad input.
    """
    logs = _read(source, columns, Budget(max_bytes, seed))
    return logs if task is None else replace(logs, task=task)


def _read(source: str | os.PathLike, columns: Columns | None, budget: Budget) -> Logs:
    if not isinstance(source, str | os.PathLike):
        raise InputError(f"logs source is a {type(source).__name__}: {_choices()}")
    name = os.fspath(source)
    if not name:
        raise InputError(f"logs source is empty: {_choices()}")
    path = Path(name).expanduser()
    if os.path.exists(path):  # False where Path.exists would raise, as for a name that is too long
        if columns and path.suffix not in TABLES and not is_lerobot_folder(path):
            raise InputError(f"{path}: columns is given: must be left out but for tables and LeRobot datasets")
        return _read_path(path, columns, budget)
    if name.startswith(SHUFFLED):
        return shuffle_actions(_read(name.removeprefix(SHUFFLED), columns, budget), budget.seed)
    if name in sample_names():
        return replace(read_npz(SAMPLES / f"{name}.npz", budget), source=name)
    if path.suffix in SUFFIXES:
        raise InputError(f"{path}: no such file: must be an existing file")
    if DATASET_ID.fullmatch(name):
        return read_minari_id(name, budget)
    raise InputError(f"unknown logs {name!r}: {_choices()}")


def shuffle_actions(logs: Logs, seed: int) -> Logs:
    """The logs with the rows' actions permuted among all rows by `seed`: each column keeps its values, and which state
    they belong to is gone.
    """
    order = np.random.default_rng([seed, SHUFFLE_STREAM]).permutation(logs.num_rows)
    return replace(logs, actions=logs.actions[order], source=f"{SHUFFLED}{logs.source}")


def _choices() -> str:
    samples = ", ".join(sample_names()) or "none"
    return f"must be a shipped sample ({samples}), {FORMS}"


def _read_path(path: Path, columns: Columns | None, budget: Budget) -> Logs:
    if path.is_dir():
        if is_dataset_folder(path):
            return read_minari(path, budget)
        if is_lerobot_folder(path):
            return read_lerobot(path, columns, budget)
        clash = "; the shipped sample of this name is hidden by the folder" if str(path) in sample_names() else ""
        right = "must be a Minari or LeRobot dataset"
        raise InputError(f"{path}: a folder without data/{MAIN_FILE} and without {INFO}: {right}{clash}")
    if path.suffix == ".npz":
        return read_npz(path, budget)
    if path.suffix in TABLES:
        return TABLES[path.suffix](path, columns, budget)
    if path.suffix not in HDF5_SUFFIXES:
        raise InputError(f"{path}: unknown file type {path.suffix!r}: must be {', '.join(SUFFIXES)}")
    with open_hdf5(path) as file:
        minari = is_minari(file)
    if not minari:
        return read_d4rl(path, budget)
    if path.name != MAIN_FILE:
        raise InputError(f"{path}: a Minari file by another name: must be {MAIN_FILE} in its dataset folder")
    return read_minari(path.parent, budget)
