"""What to look at before a prior is fitted on logs: one finding a check, and an exit code."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.check_columns import check_actions, check_constant, check_duplicated_columns, check_duplicated_rows
from ppo_dap.logs.check_episodes import (
    check_jumps,
    check_lengths,
    check_next_observations,
    check_returns,
    check_terminations,
    check_time_step,
)
from ppo_dap.logs.dataset import Logs, LogsWarning, require_logs
from ppo_dap.logs.finding import Finding, Report
from ppo_dap.logs.jumps import find_jumps
from ppo_dap.logs.neighbours import Mixture, Neighbours, find_mixture, find_neighbours

P_VALUE, SHARE = 0.001, 0.005
"""A mixture is reported at the permutation test's smallest p-value, which one policy's logs reach once in a thousand,
and where the episode accounts for at least this share of the action's variance at a state."""
SPREAD = 0.95
NEAR = 0.5
"""Neighbours further apart than this, over the distance of any two rows, say nothing about one state's actions."""

Bound = np.ndarray | Sequence[int | float] | int | float
"""Of every action, or one for each."""


def check_logs(
    logs: Logs,
    observation_size: int | None = None,
    action_low: Bound | None = None,
    action_high: Bound | None = None,
    task: str | None = None,
) -> Report:
    """Check `logs` against a task (its id, sizes and action bounds, in environment units) and for bad logging.

    A bound is a number, or one for each action; what is not given is taken from the logs, if those know it. No logs
    are refused: other dimensions than the task's are a finding of level "error". What would cost too much on large
    logs is done on rows drawn by a fixed seed, and the message says on how many. docs/check-logs.md says what each
    finding means.
    """
    require_logs(logs)
    low, high = _bound("action_low", action_low, logs), _bound("action_high", action_high, logs)
    findings = [_task(logs, task), _dimensions(logs, observation_size, None if low is None else len(low))]
    if low is None or high is None:
        low, high = logs.action_low, logs.action_high
    findings += check_actions(logs, low, high)
    findings += [check_constant("observations", logs.observations), check_constant("actions", logs.actions)]
    findings += [check_duplicated_columns(logs), check_duplicated_rows(logs)]
    jumps, neighbours = find_jumps(logs), find_neighbours(logs)
    mixture = find_mixture(logs, neighbours)
    findings += [check_lengths(logs), check_terminations(logs), check_jumps(logs, jumps)]
    findings += [check_next_observations(logs), check_time_step(logs), check_returns(logs)]
    findings += [_spread(neighbours), _mixture(mixture)]
    return Report(tuple(findings), jumps, neighbours, mixture)


def _bound(name: str, value: Bound | None, logs: Logs) -> np.ndarray | None:
    if value is None:
        return None
    try:
        bound = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{name} {value!r} must be a number, or one for each action") from None
    return np.full(logs.action_size, bound) if bound.ndim == 0 else bound.ravel()


def require_compatible(logs: Logs, *, task: str, observation_size: int, action_size: int) -> None:
    """Raise `InputError` when `logs` are of another task: other dimensions, or another name before "-v".

    Warns with `LogsWarning` when only the version differs, as "Hopper-v2" and "Hopper-v5".
    """
    if logs.task is not None and family(logs.task) != family(task):
        right = f"logs of {family(task)}, or --task {logs.task}"
        raise InputError(f"{logs.source}: the logs are of task {logs.task!r}, not {task!r}: must be {right}")
    finding = _dimensions(logs, observation_size, action_size)
    if finding.level == "error":
        raise InputError(f"{logs.source}: the logs do not fit {task!r}: {finding.message}")
    if logs.task is not None and logs.task != task:
        message = f"the logs are of {logs.task}, the task is {task}: versions differ in physics and rewards"
        warnings.warn(f"{logs.source}: {message}", LogsWarning, stacklevel=2)


def family(task: str) -> str:
    """The task's id without its version."""
    name, version, number = task.rpartition("-v")
    return name if version and number.isdigit() else task


def _task(logs: Logs, task: str | None) -> Finding:
    if task is None or logs.task is None or task == logs.task:
        known = task or logs.task
        return Finding("ok", "task", known or "unknown: give --task to check dimensions and action bounds")
    message = f"the logs are of {logs.task}, checked against {task}"
    if family(task) == family(logs.task):
        return Finding("warning", "task", f"{message}: versions differ in physics and rewards")
    return Finding("error", "task", f"{message}: use logs of {family(task)}, or --task {logs.task}")


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


def _spread(neighbours: Neighbours) -> Finding:
    name = "neighbour spread"
    if not len(neighbours.rows):
        return Finding("ok", name, "not checked: too few rows, or a single episode")
    spread, distance = float(neighbours.spread.mean()), float(np.median(neighbours.distance))
    rows = f"{len(neighbours.rows)} rows compared, {distance:.2f} as far apart as any two"
    message = f"near states' actions have {spread:.0%} of the variance of all actions ({rows})"
    if spread <= SPREAD or distance > NEAR:
        return Finding("ok", name, message)
    advice = "the state hardly settles the action: random actions, or actions that are not in step with their states?"
    return Finding("warning", name, f"{message}: {advice}")


def _mixture(mixture: Mixture | None) -> Finding:
    if mixture is None:
        return Finding("ok", "mixture", "not checked: fewer than 8 episodes with rows enough")
    message = (
        f"the episode accounts for {mixture.share:.1%} of the action's variance at a state (p {mixture.p_value:.3f})"
    )
    if mixture.p_value > P_VALUE or mixture.share < SHARE:
        return Finding("ok", "mixture", f"no sign of several policies: {message}")
    advice = "several policies, or one with a memory; the prior can hold both, but split the logs if one of them is bad"
    return Finding("warning", "mixture", f"{message}: {advice}")
