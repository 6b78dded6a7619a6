"""One file for a prior: safetensors, with everything that is not an array as JSON in its header. No pickle."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy

from ppo_dap.errors import InputError

KEY = "ppo-dap prior"
VERSION = 1


def write(path: str | Path, tensors: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """Write exactly `path`, all of it or nothing: a reader never sees half a file."""
    path = Path(path)
    # One entry: safetensors writes several in random order, and the same prior must give the same bytes.
    metadata = {KEY: json.dumps({"version": VERSION, **header}, sort_keys=True)}
    # np.asarray, since np.ascontiguousarray gives a scalar an axis.
    data = safetensors.numpy.save({name: np.asarray(t, order="C") for name, t in tensors.items()}, metadata)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise InputError(f"cannot write prior {path}: {error.strerror}") from error


def read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and header of a file that `write` made; raises `InputError` that says what else it is."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no prior at {path}: " + ("it is a folder" if path.is_dir() else "no such file"))
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged or not a prior file ({_one_line(error)})") from error
    if KEY not in metadata:
        raise InputError(f"{path} is a safetensors file but not a prior: write one with `ppo-dap pretrain`")
    try:
        header = json.loads(metadata[KEY])
        version = int(header["version"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged: its header cannot be read ({_one_line(error)})") from error
    if version > VERSION:
        raise InputError(
            f"{path} has prior format {version}, this version of ppo-dap reads up to {VERSION}: upgrade ppo-dap"
        )
    return tensors, header


def to_tensors(tree: Any, prefix: str) -> dict[str, np.ndarray]:
    """The arrays of a pytree by name."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {prefix + jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def from_tensors(like: Any, tensors: dict[str, np.ndarray], prefix: str, source: object) -> Any:
    """`like` with its arrays replaced by those of `to_tensors`; names and shapes must agree."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    loaded = []
    for path, leaf in leaves:
        name = prefix + jax.tree_util.keystr(path)
        if name not in tensors or tensors[name].shape != leaf.shape:
            found = tensors[name].shape if name in tensors else "nothing"
            raise InputError(f"{source} is damaged: {name} should have shape {leaf.shape}, found {found}")
        loaded.append(jax.numpy.asarray(tensors[name]))
    return jax.tree_util.tree_unflatten(structure, loaded)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
