"""The `.npz` layout: reading without pickle, and writing the same bytes for the same logs."""

import io
import math
import os
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.dataset import LATER_FIELDS, Logs
from ppo_dap.logs.reading import assemble, reading, refuse_large, require_file, row_pieces
from ppo_dap.logs.sampling import Budget
from ppo_dap.storage import require_place, write_atomically

ALIASES = {"terminals": "terminated", "timeouts": "truncated"}
KEYS = (
    *("observations", "actions", "rewards", "terminated", "truncated", "episode_id", "next_observations", "times"),
    *("task", "action_low", "action_high", *ALIASES),
)
SINGLE = ("task", "action_low", "action_high")
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip can hold; a real one would change the bytes
SINGLE_BYTES = 2**20  # most that a member may have that is not one of rows


def read_npz(path: Path, budget: Budget) -> Logs:
    """Read the `.npz` layout: `observations` and `actions`, and whichever of `KEYS` are there.

    Raises `InputError` in one line for damaged, pickled or oversized files, unknown keys and wrong contents.
    """
    with reading(path), ExitStack() as stack:
        size = require_file(path)
        archive = stack.enter_context(zipfile.ZipFile(path))
        refuse_large("the archive", sum(member.file_size for member in archive.infolist()), size)
        members = _members(archive)
        for alias, name in ALIASES.items():
            if alias in members:
                if name in members:
                    raise InputError(f"has both {name} and {alias}, which mean the same: must have one")
                members[name] = members.pop(alias)
        missing = [name for name in ("observations", "actions") if name not in members]
        if missing:
            raise InputError(f"has no {' and no '.join(missing)}: must have observations and actions")
        arrays = {
            name: Member(stack.enter_context(archive.open(member)), member, name) for name, member in members.items()
        }
        known: dict[str, Any] = {name: arrays.pop(name).whole(SINGLE_BYTES) for name in SINGLE if name in arrays}
        if "task" in known:
            task = known["task"]
            if task.ndim != 0 or task.dtype.kind != "U":
                raise InputError(f"task has shape {task.shape} and dtype {task.dtype}: must be one string")
            known["task"] = str(task)
        ids = arrays.get("episode_id")
        if ids is not None and (len(ids.shape) != 1 or ids.dtype.kind not in "iu"):
            found = f"shape {ids.shape} and dtype {ids.dtype}"
            raise InputError(f"episode_id has {found}: must be integers (rows,)")
        rows = {name: array.whole(budget.max_bytes) if array.fortran_order else array for name, array in arrays.items()}
        pieces = ({"episode" if k == "episode_id" else k: v for k, v in p.items()} for p in row_pieces(rows))
        return assemble(path, pieces, budget, **known)


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The archive's members by key. Raises `InputError` for names that are none."""
    members = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name == member.filename or "/" in name or "\\" in name:
            raise InputError(f"member {member.filename!r} is not an array: must be KEY.npy")
        if name not in KEYS:
            raise unknown("key", name, KEYS)
        if name in members:
            raise InputError(f"key {name} is there twice: must be there once")
        members[name] = member
    return members


class Member:
    """An array of the archive that is read from its first row to its last, never unpickled.

    Raises `InputError` when its header is not of a plain array with as many bytes as the archive holds.
    """

    def __init__(self, stream: Any, member: zipfile.ZipInfo, name: str):
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{name} has zip compression {member.compress_type}: must be stored or deflated")
        self.name, self._stream = name, stream
        version = np.lib.format.read_magic(stream)
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in readers:
            raise InputError(f"{name} has .npy version {version}: must be (1, 0) or (2, 0)")
        self.shape, self.fortran_order, self.dtype = readers[version](stream)
        if self.dtype.hasobject:
            raise InputError(f"{name} holds pickled Python objects, which are never loaded: must be a numeric array")
        declared = math.prod(self.shape) * self.dtype.itemsize
        held = member.file_size - stream.tell()
        if declared != held or min(self.shape, default=0) < 0:
            raise InputError(f"{name} declares {declared} bytes ({self.shape}) but holds {held}: both must be equal")
        self._row = 0

    def __getitem__(self, rows: slice) -> np.ndarray:
        """The rows that follow those that were read before."""
        if rows.start != self._row:
            raise ValueError(f"{self.name} is read in order: row {self._row} is next, not {rows.start}")
        shape = (rows.stop - rows.start, *self.shape[1:])
        content = self._stream.read(math.prod(shape) * self.dtype.itemsize)
        self._row = rows.stop
        if self._row == self.shape[0]:
            self._stream.read(1)  # reaching the end of the member is what makes zipfile compare the checksum
        return np.frombuffer(content, self.dtype).reshape(shape)

    def whole(self, most: int) -> np.ndarray:
        """All of it; raises `InputError` for more than `most` bytes."""
        num_bytes = math.prod(self.shape) * self.dtype.itemsize
        if num_bytes > most:
            why = ", whose columns are stored one by one" if self.fortran_order else ""
            raise InputError(f"{self.name} has {num_bytes} bytes{why}: must be at most {most}, or in C order")
        content = np.frombuffer(self._stream.read(num_bytes), self.dtype)
        self._stream.read(1)
        return content.reshape(self.shape, order="F" if self.fortran_order else "C")


def require_npz(path: str | os.PathLike) -> Path:
    """`path` as a Path; raises `InputError` unless it ends in .npz and logs can be written there."""
    if Path(path).suffix != ".npz":
        raise InputError(f"{path}: must end in .npz")
    return require_place("logs", path)


def save_npz(logs: Logs, path: str | os.PathLike) -> None:
    """Write `logs` as `.npz`: the same logs give the same bytes, and `load_logs(path)` gives the same `hash()`.

    Atomic: the file is either there in full or not touched. Raises `InputError` when `path` does not end in .npz or
    cannot be written.
    """
    path = require_npz(path)
    arrays = {"observations": logs.observations, "actions": logs.actions}
    # The episode's number marks ends without a claim about why an episode ended.
    arrays["episode_id"] = np.cumsum(logs.episode_ends, dtype=np.int32) - logs.episode_ends.astype(np.int32)
    for name in ("rewards", "terminated", "action_low", "action_high", *LATER_FIELDS):
        if getattr(logs, name) is not None:
            arrays[name] = getattr(logs, name)
    if logs.task is not None:
        arrays["task"] = np.array(logs.task)
    content = io.BytesIO()
    _write_members(content, arrays)
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): must be in a writable folder") from None


def _write_members(stream, arrays: dict[str, np.ndarray]) -> None:
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", EPOCH)
            info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(array.shape)
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, little, allow_pickle=False)
