"""Minari datasets, read straight from their folder: nothing is downloaded and no environment is made."""

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.hdf5 import find_array, find_item, open_hdf5
from ppo_dap.logs.reading import assemble, read_json, reading, row_pieces
from ppo_dap.logs.sampling import Budget, Rows
from ppo_dap.logs.tables import read_ipc, read_parquet_whole

MAIN_FILE = "main_data.hdf5"
METADATA_FILE = "metadata.json"
EPISODE = re.compile(r"episode_\d{1,18}")
NAMES = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminations": "terminated",
    "truncations": "truncated",
}
DATASET_ID = re.compile(r"(?:[\w-]+/)*[\w-]+-v\d+")


def minari_root() -> Path:
    """Minari's local root: `MINARI_DATASETS_PATH`, else ~/.minari/datasets (it need not exist)."""
    # Not minari.storage's own function: that one creates the folder, and importing minari takes a second.
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def is_dataset_folder(folder: Path) -> bool:
    """Whether `folder` is a Minari dataset or its `data` folder."""
    return any((place / name).is_file() for place in (folder, folder / "data") for name in (MAIN_FILE, METADATA_FILE))


def read_minari_id(dataset_id: str, budget: Budget) -> Logs:
    """Read the dataset of that id from the local root; if absent, the `InputError` says how to download it."""
    folder = minari_root() / dataset_id
    if not is_dataset_folder(folder):
        raise InputError(f"Minari dataset {dataset_id!r} is not in {minari_root()}: run `minari download {dataset_id}`")
    return read_minari(folder, budget)


def read_minari(folder: Path, budget: Budget) -> Logs:
    """Read a Minari dataset folder, hdf5, arrow or parquet. Each episode's T+1 observations lose the last one.

    Raises `InputError` in one line, naming the episode, for Dict or Tuple spaces, discrete actions and damaged files.
    """
    with reading(folder):
        data = folder / "data" if (folder / "data").is_dir() else folder
        metadata = _metadata(data)
        low, high = _action_bounds(metadata)
        layout = metadata.get("data_format", "hdf5")
        if layout == "hdf5":
            pieces = _hdf5_pieces(data / MAIN_FILE)
        elif layout in ("arrow", "parquet"):
            pieces = _arrow_pieces(data, layout)
        else:
            raise InputError(f"data_format is {layout!r}: must be hdf5, arrow or parquet")
        return assemble(folder, pieces, budget, task=_task(metadata), action_low=low, action_high=high)


def _metadata(data: Path) -> dict[str, Any]:
    if (data / METADATA_FILE).is_file():
        return read_json(data / METADATA_FILE)
    with open_hdf5(data / MAIN_FILE) as file:  # Minari below 0.5 kept the metadata as attributes
        return {key: value for key, value in file.attrs.items() if isinstance(value, str)}


def _task(metadata: dict[str, Any]) -> str | None:
    spec = metadata.get("env_spec")
    # Without an environment of Gymnasium's, our own datasets name their task beside the data.
    task = json.loads(spec)["id"] if spec else metadata.get("task")
    if task is not None and not isinstance(task, str):
        raise InputError(f"the dataset's task is {task!r}: must be an id such as Hopper-v5")
    return task


def _action_bounds(metadata: dict[str, Any]) -> tuple[np.ndarray | None, np.ndarray | None]:
    for name in ("observation_space", "action_space"):
        space = json.loads(metadata[name]) if name in metadata else {"type": "Box"}
        if space["type"] != "Box":
            raise InputError(f"{name} is {space['type']}: must be Box, one flat array of real numbers")
        if len(space.get("shape", [0])) != 1:
            raise InputError(f"{name} has shape {space['shape']}: must be one flat array of real numbers")
        if name == "action_space" and "low" in space:
            return np.asarray(space["low"], np.float32), np.asarray(space["high"], np.float32)
    return None, None


def _hdf5_pieces(path: Path) -> Iterator[Rows]:
    with open_hdf5(path) as file:
        size = path.stat().st_size
        numbers = sorted(int(name.removeprefix("episode_")) for name in file if EPISODE.fullmatch(name))
        if not numbers:
            raise InputError("has no episodes: must have at least one")
        for number in numbers:
            name = f"episode_{number}"
            group = find_item(file, name)
            missing = [key for key in ("observations", "actions") if key not in group]
            if missing:
                raise InputError(f"{name} has no {', '.join(missing)}: must have observations and actions")
            yield from _episode(number, {key: find_array(group, key, size) for key in NAMES if key in group})


def _arrow_pieces(data: Path, layout: str) -> Iterator[Rows]:
    """Episodes that lie in folders of their own, as arrow or parquet files of T+1 rows."""
    # Not minari's own reader: it would make the environment that a file names, which runs code of the file's choice.
    numbers = sorted(int(place.name) for place in data.iterdir() if place.name.isdecimal() and place.is_dir())
    if not numbers:
        raise InputError("has no episodes: must have at least one")
    read = {"arrow": read_ipc, "parquet": read_parquet_whole}[layout]
    for number in numbers:
        files = sorted((data / str(number)).glob(f"*.{layout}"))
        if len(files) != 1:
            raise InputError(f"episode {number} has {len(files)} .{layout} files: must have one")
        stored = read(files[0], NAMES)
        missing = [key for key in ("observations", "actions") if key not in stored]
        if missing:
            raise InputError(f"episode_{number} has no {', '.join(missing)}: must have observations and actions")
        # The last row holds the final observation; its action and flags only fill the table up.
        yield from _episode(number, {k: array if k == "observations" else array[:-1] for k, array in stored.items()})


def _episode(number: int, stored: dict[str, Any]) -> Iterator[Rows]:
    """Pieces of one episode's arrays, which have shape, dtype and slices."""
    shapes = {key: array.shape[:1] for key, array in stored.items()}
    (rows, *_), (observed, *_) = shapes["actions"] or (0,), shapes["observations"] or (0,)
    if rows == 0 or observed != rows + 1:
        found = f"{rows} actions and {observed} observations"
        raise InputError(f"episode_{number} has {found}: must have T actions and T+1 observations, T at least 1")
    for key, shape in shapes.items():
        if key != "observations" and shape != (rows,):
            raise InputError(f"episode_{number} has {shape[0] if shape else 0} {key} and {rows} actions: must be equal")
    arrays = {field: stored[key] for key, field in NAMES.items() if key in stored}
    for piece in row_pieces({**arrays, "observations": WithoutLast(arrays["observations"])}):
        count = len(piece["observations"])
        yield {**piece, "episode": np.full(count, number)}


class WithoutLast:
    """An array of rows, less the last one, that is not read before it is sliced."""

    def __init__(self, array: Any):
        self.array, self.dtype = array, array.dtype
        self.shape = (array.shape[0] - 1, *array.shape[1:])

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.array[rows]
