"""What to look at before a prior is fitted on logs: one finding a check, and an exit code."""

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs, LogsWarning
from ppo_dap.logs.jumps import find_jumps

SATURATED_SHARE = 0.5
DUPLICATE_SHARE = 0.01
SMALL_ACTION = 0.1
"""Actions that never reach this share of the action space are probably in other units."""


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    level: Literal["ok", "warning", "error"]
    name: str
    message: str


@dataclass(frozen=True)
class Report:
    """The findings of `check_logs`; `str(report)` is a table for a terminal."""

    lines: tuple[Finding, ...]

    @property
    def exit_code(self) -> int:
        """0 all ok, 1 a warning, 2 an error."""
        return max(({"ok": 0, "warning": 1, "error": 2}[line.level] for line in self.lines), default=0)

    def __str__(self) -> str:
        width = max((len(line.name) for line in self.lines), default=0)
        return "\n".join(f"{line.level:<7}  {line.name:<{width}}  {line.message}" for line in self.lines)


def check_logs(
    logs: Logs,
    observation_size: int | None = None,
    action_low: Float32[np.ndarray, "task_act"] | None = None,
    action_high: Float32[np.ndarray, "task_act"] | None = None,
) -> Report:
    """Check `logs` against a task (its sizes and action bounds, in environment units) and for signs of bad logging.

    Bounds that are not given are taken from the logs, if those know them. Nothing is raised: other dimensions than the
    task's are a finding of level "error".
    """
    action_size = None if action_low is None else len(action_low)
    dimensions = _dimensions(logs, observation_size, action_size)
    findings = [dimensions]
    if action_low is None or action_high is None:
        action_low, action_high = logs.action_low, logs.action_high
    if action_low is None or action_high is None:
        findings.append(Finding("ok", "action bounds", "unknown: give the task to check them"))
    elif len(action_low) == logs.action_size:
        findings += [_bounds(logs, action_low, action_high), _saturation(logs, action_low, action_high)]
        findings.append(_scale(logs, action_low, action_high))
    findings += [_constant("observations", logs.observations), _constant("actions", logs.actions)]
    findings += [_duplicates(logs), _episodes(logs), _returns(logs), _jumps(logs)]
    return Report(tuple(findings))


def require_compatible(logs: Logs, *, task: str, observation_size: int, action_size: int) -> None:
    """Raise `InputError` when `logs` are of another task: other dimensions, or another name before "-v".

    Warns with `LogsWarning` when only the version differs, as "Hopper-v2" and "Hopper-v5".
    """
    if logs.task is not None and _family(logs.task) != _family(task):
        right = f"logs of {_family(task)}, or --task {logs.task}"
        raise InputError(f"{logs.source}: the logs are of task {logs.task!r}, not {task!r}: must be {right}")
    finding = _dimensions(logs, observation_size, action_size)
    if finding.level == "error":
        raise InputError(f"{logs.source}: the logs do not fit {task!r}: {finding.message}")
    if logs.task is not None and logs.task != task:
        message = f"the logs are of {logs.task}, the task is {task}: versions differ in physics and rewards"
        warnings.warn(f"{logs.source}: {message}", LogsWarning, stacklevel=2)


def _family(task: str) -> str:
    family, version, number = task.rpartition("-v")
    return family if version and number.isdigit() else task


def _columns(mask: np.ndarray) -> str:
    return ", ".join(str(column) for column in np.flatnonzero(mask))


def _dimensions(logs: Logs, observation_size: int | None, action_size: int | None) -> Finding:
    found = {"observations": logs.observation_size, "actions": logs.action_size}
    wanted = {"observations": observation_size, "actions": action_size}
    wrong = [
        f"{name} has {found[name]} columns but the task has {size}: must be equal"
        for name, size in wanted.items()
        if size is not None and size != found[name]
    ]
    if wrong:
        return Finding("error", "dimensions", "; ".join(wrong))
    return Finding("ok", "dimensions", f"{logs.num_rows} rows, {' and '.join(f'{n} {k}' for k, n in found.items())}")


def _bounds(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    excess = np.maximum(low - logs.actions, logs.actions - high)
    # One float32 rounding step of the bound is not an action outside.
    outside = excess > 1e-6 * np.maximum(1.0, np.where(np.isfinite(high), np.abs(high), 1.0))
    if not outside.any():
        return Finding("ok", "action bounds", "all actions inside the action space")
    worst = int(excess.max(0).argmax())
    where = f"worst in column {worst}, {excess[:, worst].max():.3g} beyond [{low[worst]:g}, {high[worst]:g}]"
    return Finding("warning", "action bounds", f"{outside.any(1).sum()} of {logs.num_rows} rows outside; {where}")


def _saturation(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    share = ((logs.actions == low) | (logs.actions == high)).mean(0)
    worst = int(share.argmax())
    message = f"exactly at a bound: mean {share.mean():.1%}, most in column {worst} with {share[worst]:.1%}"
    if share[worst] <= SATURATED_SHARE:
        return Finding("ok", "saturation", message)
    return Finding("warning", "saturation", f"{message}; above {SATURATED_SHARE:.0%}: {_columns(share > 0.5)}")


def _scale(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    bounded = np.isfinite(low) & np.isfinite(high)
    if not bounded.any():
        return Finding("ok", "action scale", "the action space has no bounds")
    bound = np.maximum(np.abs(low), np.abs(high))[bounded]
    reach = float((np.abs(logs.actions[:, bounded]).max(0) / bound).max())
    message = f"the largest action reaches {reach:.3g} of its bound"
    if reach >= SMALL_ACTION:
        return Finding("ok", "action scale", message)
    return Finding("warning", "action scale", f"{message}: are the actions in the environment's units?")


def _constant(name: str, values: np.ndarray) -> Finding:
    constant = values.max(0) == values.min(0)
    if constant.any() and len(values) > 1:
        return Finding("warning", f"constant {name}", f"{constant.sum()} columns never change: {_columns(constant)}")
    return Finding("ok", f"constant {name}", "every column changes" if len(values) > 1 else "one row only")


def _duplicates(logs: Logs) -> Finding:
    # Rows compared as bytes; + 0.0 makes -0.0 and 0.0 the same.
    rows = np.ascontiguousarray(np.concatenate([logs.observations, logs.actions], axis=1) + np.float32(0.0))
    distinct = len(np.unique(rows.view(np.dtype((np.void, rows.shape[1] * rows.itemsize)))))
    share = 1.0 - distinct / logs.num_rows
    level = "warning" if share > DUPLICATE_SHARE else "ok"
    return Finding(level, "duplicates", f"{share:.1%} of rows repeat another row's observation and action")


def _quantiles(values: np.ndarray) -> str:
    return f"min {values.min():g}, median {np.median(values):g}, max {values.max():g}"


def _episodes(logs: Logs) -> Finding:
    return Finding("ok", "episodes", f"{logs.num_episodes}, length {_quantiles(logs.episode_lengths())}")


def _returns(logs: Logs) -> Finding:
    returns = logs.episode_returns()
    return Finding("ok", "returns", "no rewards logged" if returns is None else _quantiles(returns))


def _jumps(logs: Logs) -> Finding:
    jumps = find_jumps(logs)
    checked = f"checked with {jumps.num_pairs} position-velocity pairs"
    if not jumps.num_pairs:
        checked = "no position-velocity pairs found, so only jumps of the whole state were looked for"
    if not len(jumps.rows):
        return Finding("ok", "unmarked ends", f"none found ({checked})")
    where = f"the state jumps inside an episode after {len(jumps.rows)} rows, first after row {jumps.rows[0]}"
    return Finding("warning", "unmarked ends", f"{where}: are episode ends missing? ({checked})")
