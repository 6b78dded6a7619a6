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
from ppo_dap.logs.hdf5 import open_hdf5, read_array
from ppo_dap.logs.reading import assemble, reading

MAIN_FILE = "main_data.hdf5"
METADATA_FILE = "metadata.json"
DATASET_ID = re.compile(r"(?:[\w-]+/)*[\w-]+-v\d+")


def minari_root() -> Path:
    """Minari's local root: `MINARI_DATASETS_PATH`, else ~/.minari/datasets (it need not exist)."""
    # Not minari.storage's own function: that one creates the folder, and importing minari takes a second.
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def is_dataset_folder(folder: Path) -> bool:
    """Whether `folder` is a Minari dataset or its `data` folder."""
    return any((place / name).is_file() for place in (folder, folder / "data") for name in (MAIN_FILE, METADATA_FILE))


def read_minari_id(dataset_id: str) -> Logs:
    """Read the dataset of that id from the local root; if absent, the `InputError` says how to download it."""
    folder = minari_root() / dataset_id
    if not is_dataset_folder(folder):
        raise InputError(f"Minari dataset {dataset_id!r} is not in {minari_root()}: run `minari download {dataset_id}`")
    return read_minari(folder)


def read_minari(folder: Path) -> Logs:
    """Read a Minari dataset folder, hdf5 or arrow: T+1 observations become T states and their successors.

    Raises `InputError` in one line, naming the episode, for Dict or Tuple spaces, discrete actions and damaged files.
    """
    with reading(folder):
        data = folder / "data" if (folder / "data").is_dir() else folder
        metadata = _metadata(data)
        low, high = _action_bounds(metadata)
        if metadata.get("data_format", "hdf5") == "hdf5":
            episodes = list(_hdf5_episodes(data / MAIN_FILE))
        else:
            episodes = list(_stored_episodes(data, metadata))
        if not episodes:
            raise InputError("has no episodes: must have at least one")
        columns = {name: _join(name, episodes) for name in episodes[0]}
        lengths = [len(episode["actions"]) for episode in episodes]
        episode_id = np.repeat(np.arange(len(episodes)), lengths)
        task = _task(metadata)
        return assemble(folder, **columns, episode_id=episode_id, task=task, action_low=low, action_high=high)


def _metadata(data: Path) -> dict[str, Any]:
    if (data / METADATA_FILE).is_file():
        metadata = json.loads((data / METADATA_FILE).read_text(encoding="utf-8"))
        if not isinstance(metadata, dict):
            raise InputError(f"{METADATA_FILE} is a {type(metadata).__name__}: must be a JSON object")
        return metadata
    with open_hdf5(data / MAIN_FILE) as file:  # Minari below 0.5 kept the metadata as attributes
        return {key: value for key, value in file.attrs.items() if isinstance(value, str)}


def _task(metadata: dict[str, Any]) -> str | None:
    spec = metadata.get("env_spec")
    return json.loads(spec)["id"] if spec else None


def _action_bounds(metadata: dict[str, Any]) -> tuple[np.ndarray | None, np.ndarray | None]:
    for name in ("observation_space", "action_space"):
        space = json.loads(metadata[name]) if name in metadata else {"type": "Box"}
        if space["type"] != "Box":
            raise InputError(f"{name} is {space['type']}: must be Box, one flat array of real numbers")
        if name == "action_space" and "low" in space:
            return np.asarray(space["low"], np.float32), np.asarray(space["high"], np.float32)
    return None, None


def _hdf5_episodes(path: Path) -> Iterator[dict[str, np.ndarray]]:
    with open_hdf5(path) as file:
        names = [name for name in file if re.fullmatch(r"episode_\d+", name)]
        for name in sorted(names, key=lambda name: int(name.removeprefix("episode_"))):
            group = file[name]
            keys = ("observations", "actions", "rewards", "terminations", "truncations")
            missing = [key for key in keys if key not in group]
            if missing:
                raise InputError(f"{name} has no {', '.join(missing)}: must have {', '.join(keys)}")
            yield _episode(name, {key: read_array(group, key) for key in keys})


def _stored_episodes(data: Path, metadata: dict[str, Any]) -> Iterator[dict[str, np.ndarray]]:
    """Episodes of the layouts that minari itself reads (arrow)."""
    # Without both spaces minari would make the environment that the file names, which runs code the file chooses.
    if not {"observation_space", "action_space"} <= set(metadata):
        raise InputError(f"{METADATA_FILE} lacks observation_space or action_space: must have both")
    layout = metadata["data_format"]
    try:
        from minari.dataset.minari_storage import MinariStorage

        storage = MinariStorage.read(data)
    except ImportError:
        raise InputError(f"data_format is {layout!r}, which needs pyarrow: run `pip install pyarrow`") from None
    for stored in storage.get_episodes(range(storage.total_episodes)):
        columns = {key: np.asarray(value) for key, value in stored.items() if key not in ("id", "infos")}
        yield _episode(f"episode_{stored['id']}", columns)


def _episode(name: str, stored: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    rows = len(stored["actions"])
    if rows == 0 or len(stored["observations"]) != rows + 1:
        found = f"{rows} actions and {len(stored['observations'])} observations"
        raise InputError(f"{name} has {found}: must have T actions and T+1 observations, T at least 1")
    names = {"actions": "actions", "rewards": "rewards", "terminations": "terminated", "truncations": "truncated"}
    for key in names:
        if len(stored[key]) != rows:
            raise InputError(f"{name} has {len(stored[key])} {key} and {rows} actions: both must be equal")
    states = {"observations": stored["observations"][:-1], "next_observations": stored["observations"][1:]}
    return {**states, **{field: stored[key] for key, field in names.items()}}


def _join(name: str, episodes: list[dict[str, np.ndarray]]) -> np.ndarray:
    shapes = {episode[name].shape[1:] for episode in episodes}
    if len(shapes) > 1:
        raise InputError(f"{name} has columns {sorted(shapes)} in different episodes: must have the same in all")
    return np.concatenate([episode[name] for episode in episodes])
