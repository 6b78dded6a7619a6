"""Arrays and JSON in one file: safetensors, written atomically, no pickle anywhere."""

from __future__ import annotations

import json
import math
import os
import secrets
import tempfile
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError

MADE_BY = defaultdict(lambda: "ppo-dap train", {"prior": "ppo-dap pretrain"})
"""The command that writes each kind of file."""


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Write `tensors` and the JSON-able `meta` to `path`: whole or not at all, the file before it stays until then."""
    from safetensors.numpy import save

    header = {"meta": json.dumps(dict(meta), sort_keys=True)}
    contiguous = {name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}
    write_atomically(path, save(contiguous, metadata=header))


def write_atomically(path: Path, content: bytes) -> None:
    """Replace `path` by `content` in one step; missing folders are made. Raises `OSError` with `path` as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with open(partial, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def require_place(what: str, path: str | os.PathLike) -> Path:
    """`path` as a Path; raises `InputError`, before the work is done, unless `write_atomically` can write there."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{what} {path} is a folder: name a file")
    _require_writable(what, path, path.parent)
    return path


def require_folder(what: str, path: str | os.PathLike) -> Path:
    """`path` as a Path; raises `InputError` unless it is a folder that files can be put into, or can be made one."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{what} {path} is a file: name a folder")
    _require_writable(what, path, path)
    return path


def _require_writable(what: str, path: Path, folder: Path) -> None:
    folder = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        why = f"{folder}: {error.strerror}"
        raise InputError(f"{what} {path} cannot be written ({why}): must be in a writable folder") from None


def without_nan(value: Any) -> Any:
    """`value` with None for every number that is none: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {name: without_nan(part) for name, part in value.items()}
    if isinstance(value, list):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def tree_to_tensors(tree: Any, prefix: str) -> dict[str, np.ndarray]:
    """The arrays of a pytree, by their path in it."""
    import jax

    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {prefix + jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def tree_from_tensors(like: Any, tensors: Mapping[str, np.ndarray], prefix: str, source: object) -> Any:
    """`like` (arrays or their shapes) with the arrays that `tree_to_tensors` wrote; raises `InputError` where names or
    shapes differ.
    """
    import jax

    loaded = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(like):
        name = prefix + jax.tree_util.keystr(path)
        if name not in tensors or tensors[name].shape != leaf.shape:
            found = tensors[name].shape if name in tensors else "nothing"
            raise InputError(f"{source} has {found} for {name} where {leaf.shape} is needed: was it another config?")
        loaded.append(jax.device_put(tensors[name]))
    return jax.tree.unflatten(jax.tree.structure(like), loaded)


def kind_of(path: Path) -> str | None:
    """The kind of a file that `write_tensors` wrote, or None for any other."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return json.loads((file.metadata() or {}).get("meta", "{}")).get("kind")
    except (SafetensorError, ValueError, OSError, AttributeError):
        return None


def read_tensors(path: Path, kind: str, newest: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and meta of a file of this `kind`, whose format is at most `newest`; raises `InputError` otherwise."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"no {kind} file at {path}: `{MADE_BY[kind]}` writes one")
    try:
        with safe_open(path, framework="np") as file:
            meta = json.loads((file.metadata() or {}).get("meta", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, ValueError, OSError) as error:
        raise InputError(f"{path} is not a whole {kind} file: {error}") from error
    if not isinstance(meta, dict) or meta.get("kind") != kind or not isinstance(meta.get("format"), int):
        found = meta.get("kind", "foreign safetensors") if isinstance(meta, dict) else "foreign safetensors"
        raise InputError(f"{path} is not a {kind} file but a {found} file: `{MADE_BY[kind]}` writes one")
    if meta["format"] > newest:
        raise InputError(
            f"{path} has {kind} format {meta['format']}, this version of ppo-dap reads up to {newest}: update ppo-dap"
        )
    return tensors, meta
