"""Logs as a Minari dataset, written by the minari library itself."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.minari_folder import DATASET_ID, minari_root

SET_BY_US = ("dataset_id", "minari_version", "observation_space", "action_space", "env_spec", "data_format")
SETS = ("author", "author_email")  # minari keeps these as sets


def save_minari(
    logs: Logs,
    dataset_id: str,
    card: Mapping[str, Any],
    *,
    root: str | os.PathLike | None = None,
    final_observations: Float32[np.ndarray, "episodes obs"] | None = None,
    env_spec: bool = True,
) -> Path:
    """Write `logs` as the Minari dataset `dataset_id` below `root` (default: Minari's own root); returns its folder.

    `card` is what the dataset's metadata says beside the data: Minari's own keys (`algorithm_name`, `author`,
    `author_email`, `code_permalink`, `description`, `requirements`) and any other that JSON can hold.
    `final_observations` are what the environment showed after the last action of each episode, which `Logs` do not
    have; without them the last observation is repeated there. With `env_spec` the dataset names the environment of
    `logs.task`, so that Minari can make it again; without, or without a task, it has none.

    The folder is there in full or not at all. Raises `InputError` for logs without rewards or `terminated`, an id that
    is none or is taken, a task that Gymnasium does not know, and a card that cannot be written.
    """
    # Minari looks for its own file below a relative folder twice over.
    folder = (minari_root() if root is None else Path(root).expanduser()).absolute() / dataset_id
    metadata = _metadata(logs, dataset_id, card, final_observations)
    if folder.exists():
        raise InputError(f"{folder} is there already: must be a new dataset, such as the next -v")
    spec = _spec(logs.task) if env_spec and logs.task is not None else None
    partial = folder.with_name(f".{folder.name}.partial")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(partial, ignore_errors=True)
        (partial / "data").mkdir(parents=True)
        _write(logs, partial / "data", metadata, spec, final_observations)
        partial.rename(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}): must be in a writable folder") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def _metadata(
    logs: Logs, dataset_id: str, card: Mapping[str, Any], final_observations: np.ndarray | None
) -> dict[str, Any]:
    """The card with what is ours; raises `InputError` for whatever cannot be written."""
    if not DATASET_ID.fullmatch(dataset_id):
        raise InputError(f"dataset_id is {dataset_id!r}: must be such as hopper/mine-v0")
    for name in ("rewards", "terminated"):
        if getattr(logs, name) is None:
            raise InputError(f"{logs.source}: the logs have no {name}: must have them to be a Minari dataset")
    wanted = (logs.num_episodes, logs.observation_size)
    if final_observations is not None and final_observations.shape != wanted:
        raise InputError(f"final_observations has shape {final_observations.shape}: must be {wanted}")
    for key, value in card.items():
        if key in SET_BY_US:
            raise InputError(f"card has {key}: must be left out, the data say it")
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise InputError(f"card has {key} {value!r}: must be what JSON can hold") from None
    sets = {}
    for key in SETS:
        names = card.get(key, [])
        names = [names] if isinstance(names, str) else names
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise InputError(f"card has {key} {names!r}: must be a name or a list of names")
        sets |= {key: set(names)} if names else {}
    return {**card, **sets, "dataset_id": dataset_id}


def _spec(task: str) -> Any:
    import gymnasium

    try:
        return gymnasium.spec(task)
    except gymnasium.error.Error as error:
        text = " ".join(str(error).split())
        raise InputError(f"task {task!r} is not known to Gymnasium ({text}): must be, or env_spec False") from None


def _write(logs: Logs, data: Path, metadata: dict[str, Any], spec: Any, final: np.ndarray | None) -> None:
    import minari
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    infinite = np.full(logs.action_size, np.inf, np.float32)
    low, high = (logs.action_low, logs.action_high) if logs.action_low is not None else (-infinite, infinite)
    rewards, ended = logs.rewards, logs.terminated
    assert rewards is not None  # _metadata has checked
    assert ended is not None
    storage = MinariStorage.new(
        data,
        observation_space=Box(-np.inf, np.inf, (logs.observation_size,), np.float32),
        action_space=Box(low, high, dtype=np.float32),  # type: ignore[arg-type]
        env_spec=spec,
        data_format="hdf5",
    )
    storage.update_metadata({**metadata, "minari_version": minari.__version__})
    buffers = []
    for number, rows in enumerate(logs.episode_slices()):
        last = logs.observations[rows.stop - 1] if final is None else final[number]
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=np.concatenate([logs.observations[rows], last[None]]),  # type: ignore[arg-type]
                actions=logs.actions[rows],  # type: ignore[arg-type]
                rewards=rewards[rows],  # type: ignore[arg-type]
                terminations=ended[rows],  # type: ignore[arg-type]
                truncations=logs.episode_ends[rows] & ~ended[rows],  # type: ignore[arg-type]
            )
        )
    storage.update_episodes(buffers)
