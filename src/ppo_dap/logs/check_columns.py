"""Checks of the values row by row and column by column: bounds, scale, and what repeats."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt64

from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.finding import Finding, columns

SATURATED_SHARE = 0.8
"""A Gaussian policy whose mean lies at a bound is clipped to it in half of the rows (the shipped sample's largest share
is 56 %); far more is a mean far outside, or actions in other units that were clipped."""
DUPLICATE_SHARE = 0.01
SMALL_ACTION = 0.1
"""Actions that never reach this share of the action space are probably in other units."""
OTHER_UNITS = 1.5
"""So are actions that reach this many times a bound."""
CHUNK = 65_536


def check_actions(logs: Logs, low: np.ndarray | None, high: np.ndarray | None) -> list[Finding]:
    """Bounds, saturation and scale against the action space, each of them ok where that is unknown."""
    names = ("action bounds", "saturation", "action scale")
    if low is None or high is None:
        return [Finding("ok", name, "not checked: give --task, the logs do not know their bounds") for name in names]
    if len(low) != logs.action_size:
        return [Finding("ok", name, "not checked: the dimensions differ") for name in names]
    return [_bounds(logs, low, high), _saturation(logs, low, high), _scale(logs, low, high)]


def _bounds(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    excess = np.maximum(low - logs.actions, logs.actions - high)
    # One float32 rounding step of the bound is not an action outside.
    outside = excess > 1e-6 * np.maximum(1.0, np.where(np.isfinite(high), np.abs(high), 1.0))
    if not outside.any():
        return Finding("ok", "action bounds", "all actions inside the action space")
    worst = int(excess.max(0).argmax())
    where = f"worst in column {worst}, {excess[:, worst].max():.3g} beyond [{low[worst]:g}, {high[worst]:g}]"
    advice = "clip them to what was executed, or convert their units"
    return Finding(
        "warning", "action bounds", f"{outside.any(1).sum()} of {logs.num_rows} rows outside; {where}: {advice}"
    )


def _saturation(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    share = ((logs.actions == low) | (logs.actions == high)).mean(0)
    worst = int(share.argmax())
    message = f"exactly at a bound: mean {share.mean():.1%}, most in column {worst} with {share[worst]:.1%}"
    if share[worst] <= SATURATED_SHARE:
        return Finding("ok", "saturation", message)
    above = columns(np.flatnonzero(share > SATURATED_SHARE))
    advice = "were the actions clipped in other units? if not, the prior will propose the bounds alone"
    return Finding("warning", "saturation", f"{message}; above {SATURATED_SHARE:.0%}: {above}: {advice}")


def _scale(logs: Logs, low: np.ndarray, high: np.ndarray) -> Finding:
    bounded = np.isfinite(low) & np.isfinite(high)
    if not bounded.any():
        return Finding("ok", "action scale", "the action space has no bounds")
    bound = np.maximum(np.abs(low), np.abs(high))[bounded]
    largest = np.abs(logs.actions[:, bounded]).max(0)
    reach = float((largest / bound).max())
    message = f"the largest action reaches {reach:.3g} of its bound"
    advice = "are the actions in the environment's units? multiply them by the bounds if they were scaled to [-1, 1]"
    scaled = (largest == 1.0).all() and (bound != 1.0).all()
    if scaled and logs.num_rows > 1:
        return Finding("warning", "action scale", f"{message}, exactly 1 in every column: {advice}")
    if SMALL_ACTION <= reach <= OTHER_UNITS:
        return Finding("ok", "action scale", message)
    return Finding("warning", "action scale", f"{message}: {advice}")


def check_constant(name: str, values: Float32[np.ndarray, "rows columns"]) -> Finding:
    """Columns that never change."""
    constant = values.max(0) == values.min(0)
    if not constant.any() or len(values) == 1:
        return Finding("ok", f"constant {name}", "every column changes" if len(values) > 1 else "one row only")
    advice = {
        "observations": "normal for a task that pads its observation, else a sensor that was not logged",
        "actions": "the prior learns nothing there: was this actuator switched off or not logged?",
    }[name]
    found = f"{constant.sum()} columns never change: {columns(np.flatnonzero(constant))}"
    return Finding("warning", f"constant {name}", f"{found}: {advice}")


def check_duplicated_columns(logs: Logs) -> Finding:
    """Columns that equal another one in every row; constant columns are another finding's."""
    pairs = []
    for letter, values in (("observation", logs.observations), ("action", logs.actions)):
        few = values[:: max(1, len(values) // 1000)]
        seen: dict[bytes, list[int]] = {}
        for column in np.flatnonzero(values.max(0) != values.min(0)):
            seen.setdefault((few[:, column] + np.float32(0.0)).tobytes(), []).append(int(column))
        for first, *others in seen.values():
            pairs += [f"{letter} {o} = {first}" for o in others if np.array_equal(values[:, first], values[:, o])]
    if not pairs:
        return Finding("ok", "duplicated columns", "no column repeats another")
    advice = "drop the copies, or look for the column that should be there"
    return Finding("warning", "duplicated columns", f"{len(pairs)} repeat another: {columns(pairs)}: {advice}")


def check_duplicated_rows(logs: Logs) -> Finding:
    """Rows whose observation and action are another row's."""
    distinct = len(np.unique(_row_keys(logs)))
    share = 1.0 - distinct / logs.num_rows
    message = f"{share:.1%} of rows repeat another row's observation and action"
    if share <= DUPLICATE_SHARE:
        return Finding("ok", "duplicated rows", message)
    advice = "were episodes written twice? copies on both sides of the split make the held-out loss useless"
    return Finding("warning", "duplicated rows", f"{message}: {advice}")


def _row_keys(logs: Logs) -> UInt64[np.ndarray, " rows"]:
    """A 64-bit number a row, the same for the same values: memory does not grow with the columns."""
    width = logs.observation_size + logs.action_size
    odd = np.random.default_rng(0).integers(2**63, size=width, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    keys = np.empty(logs.num_rows, np.uint64)
    for start in range(0, logs.num_rows, CHUNK):
        rows = slice(start, start + CHUNK)
        # + 0.0 makes -0.0 and 0.0 the same; a mixing step keeps high bits of one column from meeting another's.
        bits = (np.concatenate([logs.observations[rows], logs.actions[rows]], 1) + np.float32(0.0)).view(np.uint32)
        mixed = (bits.astype(np.uint64) + np.uint64(1)) * odd
        keys[rows] = ((mixed ^ (mixed >> np.uint64(29))) * odd[::-1]).sum(1, dtype=np.uint64)
    return keys
