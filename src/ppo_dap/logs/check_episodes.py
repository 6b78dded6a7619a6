"""Checks of the order of rows: episodes, their ends, what follows what, and when."""

from __future__ import annotations

import numpy as np

from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.finding import Finding, columns
from ppo_dap.logs.jumps import Jumps

SHORT_SHARE = 0.05
SENTINEL = 1000.0
"""A reward this many times the 99.9th percentile of rewards is an error value rather than a reward."""
GAP = 1.5
UNEVEN_SHARE = 0.01
MIN_TIMEOUTS = 5
CHUNK = 65_536


def _quantiles(values: np.ndarray) -> str:
    return f"min {values.min():g}, median {np.median(values):g}, max {values.max():g}"


def check_lengths(logs: Logs) -> Finding:
    """How many episodes there are, and how long."""
    lengths = logs.episode_lengths()
    message = f"{logs.num_episodes}, length {_quantiles(lengths)}"
    single = int((lengths == 1).sum())
    if single > SHORT_SHARE * len(lengths) and len(lengths) > 1:
        advice = "are the rows in time order, and does the end flag stand at the last row of its episode?"
        return Finding("warning", "episodes", f"{message}; {single} have a single row: {advice}")
    return Finding("ok", "episodes", message)


def check_terminations(logs: Logs) -> Finding:
    """Terminations that look like timeouts."""
    if logs.terminated is None:
        return Finding("ok", "terminations", "not checked: no terminations logged")
    lengths, ended = logs.episode_lengths(), logs.terminated[logs.episode_ends]
    message = f"{ended.sum()} of {len(lengths)} episodes terminated, the others were cut off"
    longest = lengths == lengths.max()
    if longest.sum() >= MIN_TIMEOUTS and longest.sum() > len(lengths) / 10 and ended[longest].all():
        found = f"{longest.sum()} episodes of exactly {lengths.max()} rows, the longest, are all flagged as terminated"
        advice = "a time limit is no termination: log it as truncated"
        return Finding("warning", "terminations", f"{found}: {advice}")
    return Finding("ok", "terminations", message)


def check_next_observations(logs: Logs) -> Finding:
    """Logged successors against the rows that follow."""
    name, following = "next observations", logs.next_observations
    if following is None:
        return Finding("ok", name, "not checked: none logged")
    ends = logs.episode_ends[:-1]
    same = np.empty(logs.num_rows - 1, bool)
    for start in range(0, len(same), CHUNK):
        rows = slice(start, min(start + CHUNK, len(same)))
        same[rows] = (following[rows] == logs.observations[1:][rows]).all(1)
    crossing, broken = int((same & ends).sum()), int((~same & ~ends).sum())
    if crossing:
        found = f"at {crossing} of {ends.sum()} episode ends the next observation is the next episode's first"
        return Finding("warning", name, f"{found}: log the final observation, or leave next_observations out")
    if broken:
        first = int(np.flatnonzero(~same & ~ends)[0])
        found = f"{broken} of {(~ends).sum()} rows are not followed by their next observation, first row {first}"
        few = "episode ends are missing there, or rows were left out"
        many = "rows are shuffled, or next observations are shifted or scaled in another way"
        return Finding("warning", name, f"{found}: {few if broken < len(ends) / 2 else many}")
    return Finding("ok", name, f"each is the following row's observation, and none of {ends.sum()} crosses an end")


def check_time_step(logs: Logs) -> Finding:
    """Time stamps: do they rise, evenly, without gaps?"""
    name = "time step"
    if logs.times is None:
        return Finding("ok", name, "not checked: no time stamps logged")
    steps = np.diff(logs.times)[~logs.episode_ends[:-1]]
    if not len(steps):
        return Finding("ok", name, "every episode has a single row")
    usual = float(np.median(steps))
    message = f"{usual:.6g} s"
    backward = int((steps <= 0).sum())
    if backward:
        found = f"time stands still or runs back in {backward} of {len(steps)} steps"
        return Finding("warning", name, f"{found}: sort the rows by time, or mark the episode ends")
    gaps = int((steps > GAP * usual).sum())
    if gaps:
        found = f"{message}, but {gaps} of {len(steps)} steps are gaps, the longest {steps.max():.6g} s"
        return Finding("warning", name, f"{found}: rows were dropped, so end an episode at each gap")
    uneven = float((np.abs(steps - usual) > 0.1 * usual).mean())
    if uneven > UNEVEN_SHARE:
        found = f"{message}, but {uneven:.1%} of steps differ by more than 10%"
        return Finding("warning", name, f"{found}: resample the logs to the task's constant step")
    return Finding("ok", name, f"{message}, even ({_quantiles(steps)})")


def check_returns(logs: Logs) -> Finding:
    """Returns, and rewards that are error values."""
    returns = logs.episode_returns()
    if returns is None or logs.rewards is None:
        return Finding("ok", "returns", "not checked: no rewards logged")
    size = np.abs(logs.rewards)
    usual = float(np.quantile(size, 0.999 if len(size) > 2000 else 0.5))
    row = int(size.argmax())
    if usual > 0 and size[row] > SENTINEL * usual:
        found = f"the reward {logs.rewards[row]:g} of row {row} is over {SENTINEL:g} times the usual {usual:g}"
        return Finding("warning", "returns", f"{found}: is it an error value?")
    return Finding("ok", "returns", _quantiles(returns))


def check_jumps(logs: Logs, jumps: Jumps) -> Finding:
    """Episode ends that no flag marks."""
    if not jumps.num_columns:
        return Finding("ok", "unmarked ends", "not checked: fewer than 100 steps, or no column that moves")
    fitted = f"one-step model of {jumps.num_columns} columns, fitted to {jumps.num_fit_rows} steps"
    found = len(jumps.rows)
    if jumps.suspicious:
        what = f"the state jumps inside an episode after {found} rows: {columns(jumps.rows)}"
        advice = "mark these as truncated, or log the timeouts"
        return Finding("warning", "unmarked ends", f"{what}: {advice} ({fitted})")
    said = "none found" if not found else f"{found} of {logs.num_rows} rows, as few as heavy tails have"
    return Finding("ok", "unmarked ends", f"{said} ({fitted})")
