"""HDF5 files in D4RL layout (flat arrays), and opening and reading HDF5 with errors that name what is wrong."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import LATER_FIELDS, Logs, LogsWarning
from ppo_dap.logs.reading import assemble, reading, refuse_large, require_file, row_pieces
from ppo_dap.logs.sampling import Budget

D4RL_NAMES = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminals": "terminated",
    "timeouts": "truncated",
    **{name: name for name in LATER_FIELDS},
}
D4RL_UNUSED = ("next_actions", "infos", "metadata")
CHUNK_BYTES = 2**26
"""Chunks of up to this size are unpacked once; larger ones again for each piece of rows."""
LARGEST_CHUNK = 2**30


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """The open h5py file. Raises `InputError` when `path` is missing, empty, no file or damaged."""
    import h5py

    with reading(path):
        require_file(path)
        with h5py.File(path, "r", rdcc_nbytes=CHUNK_BYTES) as file:
            yield file


def find_item(group: Any, name: str) -> Any:
    """What lies at `group[name]`. Raises `InputError` for links, which could read what the user did not name."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise InputError(f"{_place(group, name)} is a link: must be an array in this file")
    return group[name]


def find_array(group: Any, name: str, file_bytes: int) -> Any:
    """The h5py dataset `group[name]`, to be read by slices of rows.

    Raises `InputError` for groups, links to other files and arrays larger than a file of `file_bytes` can hold.
    """
    import h5py

    where, item = _place(group, name), find_item(group, name)
    if not isinstance(item, h5py.Dataset):
        inside = ", ".join(sorted(item)) if isinstance(item, h5py.Group) else type(item).__name__
        raise InputError(f"{where} is a group ({inside}), so a Dict or Tuple space: must be one flat array")
    if item.external or item.is_virtual:
        raise InputError(f"{where} is stored in another file: must be an array in this file")
    if item.shape is None:
        raise InputError(f"{where} has no shape: must be an array")
    refuse_large(where, math.prod(item.shape) * item.dtype.itemsize, file_bytes)
    chunk_bytes = math.prod(item.chunks or ()) * item.dtype.itemsize
    if chunk_bytes > LARGEST_CHUNK:
        raise InputError(f"{where} has chunks of {chunk_bytes} bytes: must be at most {LARGEST_CHUNK}")
    return item


def _place(group: Any, name: str) -> str:
    return f"{group.name.strip('/')}/{name}".lstrip("/")


def is_minari(file: Any) -> bool:
    """Whether an open HDF5 file holds Minari's groups `episode_N` rather than D4RL's flat arrays."""
    return "observations" not in file and any(name.startswith("episode_") for name in file)


def read_d4rl(path: Path, budget: Budget) -> Logs:
    """Read D4RL's flat arrays: `observations`, `actions`, and `rewards`, `terminals`, `timeouts` if there.

    `next_observations` and `times` (seconds) are kept too.

    Warns with `LogsWarning` about keys that are not of the layout. Raises `InputError` in one line.
    """
    with open_hdf5(path) as file:
        missing = [name for name in ("observations", "actions") if name not in file]
        if missing:
            found = ", ".join(sorted(file)) or "nothing"
            raise InputError(f"has no {' and no '.join(missing)} (found {found}): must have observations and actions")
        known = (*D4RL_NAMES, *D4RL_UNUSED)
        strange = sorted(set(file) - set(known))
        if strange:
            message = f"ignored {', '.join(strange)}, not of the D4RL layout ({', '.join(known)})"
            warnings.warn(f"{path}: {message}", LogsWarning, stacklevel=2)
        size = path.stat().st_size
        arrays = {field: find_array(file, name, size) for name, field in D4RL_NAMES.items() if name in file}
        return assemble(path, row_pieces(arrays), budget)
