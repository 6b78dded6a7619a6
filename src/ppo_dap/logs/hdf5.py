"""HDF5 files in D4RL layout (flat arrays), and opening and reading HDF5 with errors that name what is wrong."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import LATER_FIELDS, Logs, LogsWarning
from ppo_dap.logs.reading import assemble, reading, refuse_large

D4RL_UNUSED = ("next_actions", "infos", "metadata")


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """The open h5py file. Raises `InputError` when `path` is missing, empty or damaged."""
    import h5py

    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty: must be HDF5")
    with reading(path), h5py.File(path, "r") as file:
        yield file


def read_array(group: Any, name: str) -> np.ndarray:
    """The array `group[name]`. Raises `InputError` for groups, links to other files and oversized arrays."""
    import h5py

    where = f"{group.name.strip('/')}/{name}".lstrip("/")
    # A link to another file would read what the user did not name.
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise InputError(f"{where} is a link: must be an array in this file")
    item = group[name]
    if not isinstance(item, h5py.Dataset):
        inside = ", ".join(sorted(item)) if isinstance(item, h5py.Group) else type(item).__name__
        raise InputError(f"{where} is a group ({inside}), so a Dict or Tuple space: must be one flat array")
    if item.external or item.is_virtual:
        raise InputError(f"{where} is stored in another file: must be an array in this file")
    refuse_large(where, item.size * item.dtype.itemsize)
    return np.asarray(item[()])


def is_minari(file: Any) -> bool:
    """Whether an open HDF5 file holds Minari's groups `episode_N` rather than D4RL's flat arrays."""
    return "observations" not in file and any(name.startswith("episode_") for name in file)


def read_d4rl(path: Path) -> Logs:
    """Read D4RL's flat arrays: `observations`, `actions`, and `rewards`, `terminals`, `timeouts` if there.

    `next_observations` and `times` (seconds) are kept too.

    Warns with `LogsWarning` about keys that are not of the layout. Raises `InputError` in one line.
    """
    with open_hdf5(path) as file:
        missing = [name for name in ("observations", "actions") if name not in file]
        if missing:
            found = ", ".join(sorted(file)) or "nothing"
            raise InputError(f"has no {' and no '.join(missing)} (found {found}): must have observations and actions")
        wanted = {"rewards": "rewards", "terminals": "terminated", "timeouts": "truncated"}
        wanted |= {name: name for name in LATER_FIELDS}
        known = ("observations", "actions", *wanted, *D4RL_UNUSED)
        strange = sorted(set(file) - set(known))
        if strange:
            message = f"ignored {', '.join(strange)}, not of the D4RL layout ({', '.join(known)})"
            warnings.warn(f"{path}: {message}", LogsWarning, stacklevel=2)
        arrays: dict[str, Any] = {field: read_array(file, name) for name, field in wanted.items() if name in file}
        observations, actions = read_array(file, "observations"), read_array(file, "actions")
        return assemble(path, observations=observations, actions=actions, **arrays)
