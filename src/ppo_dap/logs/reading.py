"""What every reader shares: errors in one line that name the file, and episode ends from whatever marks them."""

import json
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs, LogsWarning, as_flags, require_rows

MAX_BYTES = 8 * 2**30
"""No file may declare more than this: a few hostile or damaged header bytes must not fill the memory."""

DAMAGE = (
    *(OSError, EOFError, ValueError, TypeError, LookupError, RuntimeError, ArithmeticError, SyntaxError),
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
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: must be an existing file") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: metadata is not JSON ({error}): must be as its writer wrote it") from None
    except DAMAGE as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: damaged or not of this format ({what}): must be a complete, readable file") from None


def refuse_large(name: str, num_bytes: int) -> None:
    """Raise `InputError` when an array declares more bytes than `MAX_BYTES`."""
    if num_bytes > MAX_BYTES:
        raise InputError(f"{name} declares {num_bytes} bytes: must be at most {MAX_BYTES}")


def assemble(
    path: str | os.PathLike,
    *,
    observations: np.ndarray,
    actions: np.ndarray,
    rewards: np.ndarray | None = None,
    terminated: np.ndarray | None = None,
    truncated: np.ndarray | None = None,
    episode_id: np.ndarray | None = None,
    task: str | None = None,
    action_low: np.ndarray | None = None,
    action_high: np.ndarray | None = None,
    next_observations: np.ndarray | None = None,
    times: np.ndarray | None = None,
) -> Logs:
    """Build `Logs`; an episode ends at terminated | truncated | a change of `episode_id` | the last row.

    Warns with `LogsWarning` when nothing marks an end, so that the whole file counts as one episode.
    Raises `InputError` for whatever `Logs` refuses, and for flags of another shape than (rows,).
    """
    if observations.ndim != 2 or len(observations) == 0:  # flags cannot be compared with these; Logs says why
        return Logs(observations, actions, np.zeros(0, bool))
    rows = len(observations)
    ends = np.zeros(rows, bool)
    for name, flags in (("terminated", terminated), ("truncated", truncated)):
        if flags is not None:
            flags = as_flags(name, flags)
            require_rows(name, flags, rows)
            ends |= flags
    if episode_id is not None:
        if episode_id.ndim != 1 or episode_id.dtype.kind not in "iu":
            found = f"shape {episode_id.shape} and dtype {episode_id.dtype}"
            raise InputError(f"episode_id has {found}: must be integers (rows,)")
        require_rows("episode_id", episode_id, rows)
        ends[:-1] |= episode_id[1:] != episode_id[:-1]
    elif not ends.any() and rows > 1:
        message = "nothing marks an episode's end, so all rows count as one episode; add truncated or episode_id"
        warnings.warn(f"{path}: {message}", LogsWarning, stacklevel=4)
    ends[-1] = True
    fields = (rewards, terminated, task, action_low, action_high, str(path), next_observations, times)
    return Logs(observations, actions, ends, *fields)
