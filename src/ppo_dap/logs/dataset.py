"""`Logs`: the logged trajectories D_off as flat arrays with whole episodes."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int

from ppo_dap.errors import InputError

ARRAY_FIELDS = ("observations", "actions", "episode_ends", "rewards", "terminated", "action_low", "action_high")
LATER_FIELDS = ("next_observations", "times")
"""Hashed only where they are there, so that the hash of logs without them stays what it was."""
FLAGS = ("episode_ends", "terminated", "truncated", "done")


class LogsWarning(UserWarning):
    """Logs that can be used but that the user should look at."""


def require_numbers(name: str, dtype: np.dtype, shape: tuple[int, ...], axes: tuple[str, ...]) -> None:
    """Raise `InputError` unless an array of this dtype and shape holds numbers along the given axes."""
    if dtype.kind not in "fiub":
        right = "bool" if name in FLAGS else "numbers, float or integer"
        raise InputError(f"{name} has dtype {dtype}: must be {right}")
    if len(shape) != len(axes):
        right = f"({', '.join(axes)}{',' if len(axes) == 1 else ''})"
        hint = f", so ({shape[0]}, 1) if it is a single column" if len(shape) == 1 else ""
        raise InputError(f"{name} has shape {shape}: must be {right}{hint}")


def as_float32(name: str, value: object, axes: tuple[str, ...], finite: bool = True, first_row: int = 0) -> np.ndarray:
    """`as_numbers` in float32, the dtype of all that is learned from."""
    return as_numbers(name, value, axes, np.float32, finite, first_row)


def as_numbers(
    name: str, value: object, axes: tuple[str, ...], dtype: type, finite: bool = True, first_row: int = 0
) -> np.ndarray:
    """`value` as an array of `dtype` with the given axes; integers and other floats are converted.

    Raises `InputError` for another kind of dtype or number of axes, and for the first entry that is not finite in
    `dtype` (`finite=False` lets infinities pass, as bounds may be infinite, but never NaN). `first_row` is the number
    that messages give to the first row.
    """
    array = np.asarray(value)
    require_numbers(name, array.dtype, array.shape, axes)
    with np.errstate(over="ignore"):  # an overflow becomes inf and is reported below with its place
        converted = np.ascontiguousarray(array, dtype=dtype)
    bad = ~np.isfinite(converted) if finite else np.isnan(converted)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        places = (index[0] + first_row, *index[1:])
        place = ", ".join(f"{axis} {i}" for axis, i in zip(("row", "column"), places, strict=False))
        found = f"{name} is {array[index]} at {place} ({bad.sum()} such values)"
        raise InputError(f"{found}: must be finite in {np.dtype(dtype)}")
    return converted


def as_flags(name: str, value: object, first_row: int = 0) -> np.ndarray:
    """`value` as bool (rows,). Raises `InputError` unless it is one-dimensional and holds only 0 and 1."""
    array = np.asarray(value)
    require_numbers(name, array.dtype, array.shape, ("rows",))
    bad = np.flatnonzero((array != 0) & (array != 1))
    if bad.size:
        raise InputError(f"{name} is {array[bad[0]]} at row {bad[0] + first_row}: must be 0 or 1")
    return array.astype(bool)


def require_rows(name: str, count: int, rows: int) -> None:
    """Raise `InputError` unless an array of `count` rows has as many as the observations."""
    if count != rows:
        raise InputError(f"{name} has {count} rows but observations has {rows}: both must have the same number")


def require_some(name: str, shape: tuple[int, ...]) -> None:
    """Raise `InputError` for observations or actions without a row or without a column."""
    if 0 in shape:
        raise InputError(f"{name} has shape {shape}: must have at least one row and one column")


# The fields are annotated np.ndarray and not with jaxtyping: __post_init__ converts and checks them in every run, and
# its errors name the row and the column.
@dataclass(frozen=True, eq=False, repr=False)
class Logs:
    """Logged trajectories: row t holds s_t and a_t, and rows of one episode are contiguous and in time order.

    The arrays are converted to the dtypes below, checked and made read-only. `InputError` names the field, the row and
    the column of what is wrong. Two logs are equal when their `hash()` is.
    """

    observations: np.ndarray
    """float32 (rows, obs), finite."""
    actions: np.ndarray
    """float32 (rows, act), in the environment's units (unscaled), finite."""
    episode_ends: np.ndarray
    """bool (rows,), True at the last row of each episode, so always at the last row of all."""
    rewards: np.ndarray | None = None
    """float32 (rows,), finite."""
    terminated: np.ndarray | None = None
    """bool (rows,), True only where the task really ended, never for a timeout; implies `episode_ends`."""
    task: str | None = None
    """Gymnasium id such as "Hopper-v5"; None if unknown."""
    action_low: np.ndarray | None = None
    """float32 (act,), lower bounds of the action space, may be -inf; given with `action_high` or not at all."""
    action_high: np.ndarray | None = None
    """float32 (act,), upper bounds of the action space, above `action_low`; may be inf."""
    source: str = "memory"
    """Where the logs came from, for messages; no part of the hash."""
    next_observations: np.ndarray | None = None
    """float32 (rows, obs), the true successor of each observation, finite; used by `check_logs` alone."""
    times: np.ndarray | None = None
    """float64 (rows,), time stamps in seconds, finite; used by `check_logs` alone."""
    drawn: Mapping[str, int] | None = None
    """None where these are all rows of the source. Else what `load_logs` drew from it, above its `max_bytes`: `rows` of
    `of_rows`, `episodes` of `of_episodes`, by `seed` within `max_bytes`; no part of the hash."""

    def __post_init__(self):
        values = {
            "observations": as_float32("observations", self.observations, ("rows", "obs")),
            "actions": as_float32("actions", self.actions, ("rows", "act")),
            "episode_ends": as_flags("episode_ends", self.episode_ends),
        }
        if self.rewards is not None:
            values["rewards"] = as_float32("rewards", self.rewards, ("rows",))
        if self.terminated is not None:
            values["terminated"] = as_flags("terminated", self.terminated)
        if self.next_observations is not None:
            values["next_observations"] = as_float32("next_observations", self.next_observations, ("rows", "obs"))
        if self.times is not None:
            values["times"] = as_numbers("times", self.times, ("rows",), np.float64)
        rows = len(values["observations"])
        for name in ("observations", "actions"):
            require_some(name, values[name].shape)
        for name, array in values.items():
            require_rows(name, len(array), rows)
        following = values.get("next_observations")
        if following is not None and following.shape != values["observations"].shape:
            found = f"{following.shape[1]} columns but observations has {values['observations'].shape[1]}"
            raise InputError(f"next_observations has {found}: must be equal")
        _check_ends(values["episode_ends"], values.get("terminated"))
        values.update(_bounds(self.action_low, self.action_high, values["actions"].shape[1]))
        if self.task is not None and not (isinstance(self.task, str) and self.task.strip()):
            raise InputError(f'task is {self.task!r}: must be a Gymnasium id such as "Hopper-v5", or None')
        for name, array in values.items():
            view = array.view()  # freeze the view, so that the caller's own array stays writable
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    def __repr__(self) -> str:
        return (
            f"Logs({self.source!r}: {self.num_rows} rows, {self.num_episodes} episodes, {self.observation_size} "
            f"observations, {self.action_size} actions, task {self.task!r})"
        )

    @property
    def num_rows(self) -> int:
        """Number of (s, a) rows."""
        return len(self.observations)

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return int(self.episode_ends.sum())

    @property
    def observation_size(self) -> int:
        """Number of observation columns."""
        return self.observations.shape[1]

    @property
    def action_size(self) -> int:
        """Number of action columns."""
        return self.actions.shape[1]

    def episode_slices(self) -> list[slice]:
        """The rows of each episode, in order."""
        stops = np.flatnonzero(self.episode_ends) + 1
        starts = np.concatenate([[0], stops[:-1]])
        return [slice(int(start), int(stop)) for start, stop in zip(starts, stops, strict=True)]

    def episode_lengths(self) -> Int[np.ndarray, "episodes"]:
        """Rows in each episode."""
        return np.diff(np.flatnonzero(self.episode_ends), prepend=-1)

    def episode_returns(self) -> Float32[np.ndarray, "episodes"] | None:
        """Undiscounted sum of rewards of each episode (summed in float64); None without rewards."""
        if self.rewards is None:
            return None
        starts = [rows.start for rows in self.episode_slices()]
        return np.add.reduceat(self.rewards.astype(np.float64), starts).astype(np.float32)

    def returns_to_go(self, gamma: float) -> Float32[np.ndarray, "rows"] | None:
        """R_t = r_t + gamma R_{t+1} within each episode (summed in float64); None without rewards.

        A timeout counts like an end: nothing is bootstrapped beyond the last logged row.
        Raises `InputError` unless 0 <= gamma <= 1.
        """
        if not 0.0 <= gamma <= 1.0:
            raise InputError(f"gamma is {gamma}: must lie in [0, 1]")
        if self.rewards is None:
            return None
        result = np.empty(self.num_rows, np.float32)
        tail = 0.0
        rows = zip(self.rewards.tolist()[::-1], self.episode_ends.tolist()[::-1], strict=True)
        for back, (reward, end) in enumerate(rows, start=1):
            tail = reward + (0.0 if end else gamma * tail)
            result[-back] = tail
        return result

    def select(self, episode_indices: Sequence[int] | Int[np.ndarray, "chosen"]) -> "Logs":
        """The given episodes, whole and in the given order. Raises `InputError` if there is none or one is unknown."""
        indices = np.asarray(episode_indices)
        if indices.ndim != 1 or indices.size == 0 or indices.dtype.kind not in "iu":
            raise InputError(f"episode_indices is {episode_indices!r}: must be at least one integer")
        outside = indices[(indices < 0) | (indices >= self.num_episodes)]
        if outside.size:
            raise InputError(f"episode_indices has {outside[0]}: must lie in 0 to {self.num_episodes - 1}")
        slices = self.episode_slices()
        return self.take(np.concatenate([np.arange(slices[i].start, slices[i].stop) for i in indices]))

    def split(self, validation_fraction: float = 0.1, seed: int = 0) -> tuple["Logs", "Logs"]:
        """(train, validation): about `validation_fraction` of the episodes, drawn by `seed`, go to validation.

        Episodes are never shared (rows of one episode are nearly copies of each other), and each side has at least
        one. A single episode is cut instead: its last `validation_fraction` of rows, one block, is the validation.
        Raises `InputError` unless 0 < validation_fraction < 1 and there are at least two rows.
        """
        if not 0.0 < validation_fraction < 1.0:
            raise InputError(f"validation_fraction is {validation_fraction}: must lie between 0 and 1")
        if self.num_rows < 2:
            raise InputError(f"{self.source}: 1 row cannot be split in train and validation: must have at least 2")
        units = self.num_episodes if self.num_episodes > 1 else self.num_rows
        held_out = min(max(round(validation_fraction * units), 1), units - 1)
        if self.num_episodes == 1:
            cut = self.num_rows - held_out
            return self.take(np.arange(cut)), self.take(np.arange(cut, self.num_rows))
        order = np.random.default_rng(seed).permutation(units)
        return self.select(np.sort(order[held_out:])), self.select(np.sort(order[:held_out]))

    def hash(self) -> str:
        """Sha256 (hex) over names, shapes, dtypes and bytes of the arrays and over the task; `source` is left out."""
        digest = hashlib.sha256()
        for name in (*ARRAY_FIELDS, *(name for name in LATER_FIELDS if getattr(self, name) is not None)):
            array = getattr(self, name)
            if array is None:
                digest.update(f"{name}:none;".encode())
                continue
            array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))  # same hash on every machine
            digest.update(f"{name}:{array.shape}:{array.dtype.str}:".encode())
            digest.update(array.data)
        digest.update(f"task:{self.task!r}".encode())
        return digest.hexdigest()

    def take(self, rows: Int[np.ndarray, "taken"]) -> "Logs":
        """The given rows; the last of them ends an episode even where a cut made it the last."""
        ends = self.episode_ends[rows].copy()
        ends[-1] = True
        optional = {name: getattr(self, name) for name in ("rewards", "terminated", *LATER_FIELDS)}
        taken = {name: None if array is None else array[rows] for name, array in optional.items()}
        return replace(
            self, observations=self.observations[rows], actions=self.actions[rows], episode_ends=ends, **taken
        )


def _check_ends(episode_ends: np.ndarray, terminated: np.ndarray | None) -> None:
    if not episode_ends[-1]:
        raise InputError(f"episode_ends is False at row {len(episode_ends) - 1}: must be True at the last row")
    if terminated is not None and (terminated & ~episode_ends).any():
        row = np.flatnonzero(terminated & ~episode_ends)[0]
        raise InputError(f"terminated is True at row {row} where episode_ends is False: must imply episode_ends")


def _bounds(low: np.ndarray | None, high: np.ndarray | None, action_size: int) -> dict[str, np.ndarray]:
    if low is None and high is None:
        return {}
    if low is None or high is None:
        missing = "action_low" if low is None else "action_high"
        raise InputError(f"{missing} is None: must be given when the other bound is")
    bounds = {
        "action_low": as_float32("action_low", low, ("act",), finite=False),
        "action_high": as_float32("action_high", high, ("act",), finite=False),
    }
    for name, array in bounds.items():
        if array.shape != (action_size,):
            raise InputError(f"{name} has {array.size} entries but actions has {action_size} columns: must be equal")
    wrong = np.flatnonzero(bounds["action_low"] >= bounds["action_high"])
    if wrong.size:
        column = wrong[0]
        values = f"{bounds['action_low'][column]} and action_high {bounds['action_high'][column]}"
        raise InputError(f"action_low is {values} in column {column}: action_low must be below action_high")
    return bounds


def require_logs(logs: object) -> None:
    """Raise `InputError` for what is not `Logs`, such as the path of some."""
    if not isinstance(logs, Logs):
        raise InputError(f"logs must be Logs, as ppo_dap.load_logs reads them, not a {type(logs).__name__}")
