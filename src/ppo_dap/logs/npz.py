"""The `.npz` layout: reading without pickle, and writing the same bytes for the same logs."""

import io
import math
import os
import zipfile
from pathlib import Path

import numpy as np

from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.dataset import LATER_FIELDS, Logs
from ppo_dap.logs.reading import assemble, reading, refuse_large
from ppo_dap.storage import write_atomically

ALIASES = {"terminals": "terminated", "timeouts": "truncated"}
KEYS = (
    *("observations", "actions", "rewards", "terminated", "truncated", "episode_id", "next_observations", "times"),
    *("task", "action_low", "action_high", *ALIASES),
)
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip can hold; a real one would change the bytes


def read_npz(path: Path) -> Logs:
    """Read the `.npz` layout: `observations` and `actions`, and whichever of `KEYS` are there.

    Raises `InputError` in one line for damaged, pickled or oversized files, unknown keys and wrong contents.
    """
    with reading(path):
        if path.stat().st_size == 0:
            raise InputError("the file is empty: must be an .npz with observations and actions")
        arrays = _read_members(path)
        for alias, name in ALIASES.items():
            if alias in arrays:
                if name in arrays:
                    raise InputError(f"has both {name} and {alias}, which mean the same: must have one")
                arrays[name] = arrays.pop(alias)
        missing = [name for name in ("observations", "actions") if name not in arrays]
        if missing:
            raise InputError(f"has no {' and no '.join(missing)}: must have observations and actions")
        task = arrays.pop("task", None)
        if task is not None and (task.ndim != 0 or task.dtype.kind != "U"):
            raise InputError(f"task has shape {task.shape} and dtype {task.dtype}: must be one string")
        return assemble(path, task=None if task is None else str(task), **arrays)


def _read_members(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        refuse_large("the archive", sum(member.file_size for member in members))
        arrays = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name == member.filename or "/" in name or "\\" in name:
                raise InputError(f"member {member.filename!r} is not an array: must be KEY.npy")
            if name not in KEYS:
                raise unknown("key", name, KEYS)
            if name in arrays:
                raise InputError(f"key {name} is there twice: must be there once")
            arrays[name] = _read_member(archive, member, name)
    return arrays


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> np.ndarray:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"{name} has zip compression {member.compress_type}: must be stored or deflated")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)  # type: ignore[arg-type]
        readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in readers:
            raise InputError(f"{name} has .npy version {version}: must be (1, 0) or (2, 0)")
        shape, _, dtype = readers[version](stream)  # type: ignore[arg-type]
        if dtype.hasobject:
            raise InputError(f"{name} holds pickled Python objects, which are never loaded: must be a numeric array")
        declared = math.prod(shape) * dtype.itemsize
        refuse_large(name, declared)
        held = member.file_size - stream.tell()
        if declared != held:
            raise InputError(f"{name} declares {declared} bytes but holds {held}: both must be equal")
    with archive.open(member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)  # type: ignore[arg-type]
        stream.read()  # reaching the end of the member is what makes zipfile compare the checksum
    return array


def save_npz(logs: Logs, path: str | os.PathLike) -> None:
    """Write `logs` as `.npz`: the same logs give the same bytes, and `load_logs(path)` gives the same `hash()`.

    Atomic: the file is either there in full or not touched. Raises `InputError` when `path` does not end in .npz or
    cannot be written.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: must end in .npz")
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
