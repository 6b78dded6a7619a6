"""What every reader shares: errors in one line that name the file, rows in pieces, and episode ends."""

import json
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import (
    Logs,
    LogsWarning,
    as_flags,
    as_float32,
    as_numbers,
    require_numbers,
    require_rows,
    require_some,
)
from ppo_dap.logs.sampling import Budget, EpisodeSample, Rows

PIECE_BYTES = 2**22
"""About what is read of a file at a time."""
EXPANSION = 1200
"""No file may declare more than this many times its own size, beyond `SMALL_BYTES`: a few hostile or damaged header
bytes must not keep the reader busy for ever. Deflate, the tightest packing that is read, reaches 1032."""
SMALL_BYTES = 2**26
JSON_BYTES = 2**26
MESSAGE = 1000  # characters at most of what a file makes us say
AXES = {"observations": ("rows", "obs"), "actions": ("rows", "act"), "next_observations": ("rows", "obs")}
"""Axes of what has not just rows."""

DAMAGE = (
    *(OSError, EOFError, ValueError, TypeError, LookupError, RuntimeError, ArithmeticError, SyntaxError, StopIteration),
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError),
)
"""What zipfile, numpy, h5py and json raise on damaged files (a test changes bytes at random)."""


@contextmanager
def reading(path: str | os.PathLike) -> Iterator[None]:
    """Turn whatever goes wrong while `path` is read into an `InputError` of one line that starts with `path`."""
    try:
        yield
    except InputError as error:
        text = str(error)
        text = text if text.startswith(str(path)) else f"{path}: {text}"
        raise InputError(text[: len(str(path)) + MESSAGE]) from None
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: must be an existing file") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: metadata is not JSON ({error}): must be as its writer wrote it") from None
    except MemoryError:
        raise InputError(f"{path}: needs more memory than there is: must declare no more than it holds") from None
    except DAMAGE as error:
        what = " ".join(str(error).split())[:MESSAGE] or type(error).__name__
        raise InputError(f"{path}: damaged or not of this format ({what}): must be a complete, readable file") from None


def require_file(path: Path) -> int:
    """Bytes of the file; raises `InputError` unless it is a regular one with something in it.

    A pipe or a device would keep the reader waiting for ever.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a regular file: must be one")
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"{path}: the file is empty: must hold observations and actions")
    return size


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`. Raises `InputError` for another value, or one larger than metadata ever is."""
    size = require_file(path)
    if size > JSON_BYTES:
        raise InputError(f"{path.name} has {size} bytes: must be metadata, at most {JSON_BYTES} bytes")
    value = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(value, dict):
        raise InputError(f"{path.name} is a {type(value).__name__}: must be a JSON object")
    return value


def refuse_large(name: str, num_bytes: int, file_bytes: int) -> None:
    """Raise `InputError` when a file of `file_bytes` cannot hold the bytes that it declares."""
    limit = max(SMALL_BYTES, EXPANSION * file_bytes)
    if num_bytes > limit:
        raise InputError(f"{name} declares {num_bytes} bytes in a file of {file_bytes}: must be at most {limit}")


def row_pieces(arrays: Mapping[str, Any]) -> Iterator[Rows]:
    """The arrays, of at least observations and actions, a few rows at a time; each needs shape, dtype and slices.

    Raises `InputError`, before anything is read, when they are not numbers of the right shapes with equally many rows.
    """
    for name, array in arrays.items():
        require_numbers(name, array.dtype, array.shape, AXES.get(name, ("rows",)))
    for name in ("observations", "actions"):
        require_some(name, arrays[name].shape)
    rows = arrays["observations"].shape[0]
    for name, array in arrays.items():
        require_rows(name, array.shape[0], rows)
    row_bytes = sum(math.prod(array.shape[1:]) * array.dtype.itemsize for array in arrays.values())
    step = max(PIECE_BYTES // row_bytes, 1)
    for start in range(0, rows, step):
        yield {name: array[start : min(start + step, rows)] for name, array in arrays.items()}


def assemble(path: str | os.PathLike, pieces: Iterable[Rows], budget: Budget, **known: Any) -> Logs:
    """Build `Logs` of pieces of rows, all of them or as many episodes as the budget holds.

    A piece has `observations` and `actions`, and may have `rewards`, `next_observations`, `times`, `terminated`,
    `truncated`, `done`, `episode` (ids of any type, one change an end) and `step`. An episode ends where a flag or a
    change of the id says so, and at the last row. `known` is what else `Logs` takes: `task`, `action_low`,
    `action_high`.

    Warns with `LogsWarning` when nothing marks an end, so that the whole file counts as one episode, when the id of an
    episode comes back, and when rows were left out. Raises `InputError` for whatever `Logs` refuses, for pieces that
    do not fit together, and for a `step` that does not increase within an episode.
    """
    sample, marks = EpisodeSample(budget), Marks(path)
    waiting: Rows | None = None  # whether a piece's last row ends an episode is known when the next piece is there
    for piece in pieces:
        first_row = 0 if waiting is None else sample.of_rows + len(waiting["episode_ends"])
        rows = _checked(piece, first_row, waiting)
        marks.find(piece, rows, waiting, first_row)
        if waiting is not None:
            sample.add(waiting)
        waiting = rows
    if waiting is None:
        raise InputError("has no rows: must have at least one")
    waiting["episode_ends"][-1] = True
    sample.add(waiting)
    del waiting
    if not marks.any and sample.of_rows > 1:
        message = "nothing marks an episode's end, so all rows count as one episode; add truncated or episode_id"
        warnings.warn(f"{path}: {message}", LogsWarning, stacklevel=4)
    rows, drawn = sample.result()
    if drawn is not None:
        kept = f"kept {drawn['rows']:,} of {drawn['of_rows']:,} rows ({drawn['episodes']:,} of {drawn['of_episodes']:,}"
        why = f"drawn uniformly by seed {budget.seed}, as all are more than max_bytes {budget.max_bytes:,}"
        warnings.warn(f"{path}: {kept} episodes), {why}", LogsWarning, stacklevel=4)
    return Logs(**rows, **known, source=str(path), drawn=drawn)


def _checked(piece: Rows, first_row: int, before: Rows | None) -> Rows:
    """A piece as `Logs` has it, with the ends that its own flags mark; it must fit to the piece before."""
    rows = {
        name: as_float32(name, piece[name], AXES.get(name, ("rows",)), first_row=first_row)
        for name in ("observations", "actions", "rewards", "next_observations")
        if name in piece
    }
    if "times" in piece:
        rows["times"] = as_numbers("times", piece["times"], ("rows",), np.float64, first_row=first_row)
    count = len(rows["observations"])
    ends = np.zeros(count, bool)
    for name in ("terminated", "truncated", "done"):
        if name in piece:
            flags = as_flags(name, piece[name], first_row)
            require_rows(name, len(flags), count)
            ends |= flags
            if name == "terminated":
                rows[name] = flags
    rows["episode_ends"] = ends
    if before is None:
        return rows
    for name in (*before, *rows):
        if (name in before) != (name in rows):
            where = f"rows {'before' if name in rows else 'from'} {first_row}{'' if name in rows else ' on'}"
            raise InputError(f"{name} is missing in {where}: must be in all rows or none")
        if before[name].shape[1:] != rows[name].shape[1:]:
            found = f"{rows[name].shape[1]} columns from row {first_row} on and {before[name].shape[1]} before"
            raise InputError(f"{name} has {found}: must have the same in all")
    return rows


MAX_IDS = 1_000_000  # so many ids are remembered, to notice one that comes back


class Marks:
    """What marks the ends of episodes over all pieces, beside flags: changes of the episode's id."""

    def __init__(self, path: str | os.PathLike):
        self.path = path
        self.any = False
        self._seen: set[Any] | None = set()
        self._last_step: Any = None
        self._last_id: Any = None

    def find(self, piece: Rows, rows: Rows, before: Rows | None, first_row: int) -> None:
        """Set `episode_ends` of the piece's rows, and of the last row of the piece before, where the id changes."""
        ends, ids, steps = rows["episode_ends"], piece.get("episode"), piece.get("step")
        if ids is not None:
            require_rows("episode", len(ids), len(ends))
            ends[:-1] |= ids[1:] != ids[:-1]
            if before is not None:
                before["episode_ends"][-1] |= ids[0] != self._last_id
            self._note_ids(ids, first_row)
        self.any = self.any or ids is not None or bool(ends.any())
        if steps is not None:
            self._check_steps(steps, ends, before, first_row)

    def _note_ids(self, ids: np.ndarray, first_row: int) -> None:
        starts = np.flatnonzero(np.concatenate([[first_row == 0 or ids[0] != self._last_id], ids[1:] != ids[:-1]]))
        for start in starts:
            if self._seen is None or len(self._seen) == MAX_IDS:
                break
            if ids[start] in self._seen:
                message = "and counts as another episode: are the rows sorted by episode?"
                text = f"{self.path}: episode {ids[start]} comes back at row {start + first_row} {message}"
                warnings.warn(text, LogsWarning, stacklevel=5)
                self._seen = None  # said once
            else:
                self._seen.add(ids[start])
        self._last_id = ids[-1]

    def _check_steps(self, steps: np.ndarray, ends: np.ndarray, before: Rows | None, first_row: int) -> None:
        falls = np.zeros(len(steps), bool)
        falls[1:] = (steps[1:] <= steps[:-1]) & ~ends[:-1]
        if before is not None and not before["episode_ends"][-1]:
            falls[0] = steps[0] <= self._last_step
        if falls.any():
            row = int(np.flatnonzero(falls)[0])
            earlier = steps[row - 1] if row else self._last_step
            text = f"is {steps[row]} at row {row + first_row} after {earlier} in the same episode: must increase"
            raise InputError(f"step {text} (are the rows in time order, and does a column name the episode?)")
        self._last_step = steps[-1]
