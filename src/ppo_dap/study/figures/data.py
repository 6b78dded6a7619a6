"""What is drawn, as numbers: curves of several seeds, changes against a baseline, cost, and what no other point beats.

Statistics are those of `statistics` and `pairing`, so that a figure shows what the tables say.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ppo_dap.study.results import Results
from ppo_dap.study.stats.measures import (
    REPS,
    mean_interval,
    mean_relative_change,
    median_ratio,
    relative_change,
    stratified_bootstrap,
)
from ppo_dap.study.stats.pairing import paired
from ppo_dap.study.store.grids import Study

Row = dict[str, Any]
BANDED = 3
"""Runs from which a Student-t interval is drawn; of fewer, every run is."""


class Band(NamedTuple):
    """Curves of n seeds at the same steps."""

    steps: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " m"]
    half_width: Float[np.ndarray, " m"]
    """Of the 95% Student-t interval; NaN for one seed."""
    each: Float[np.ndarray, "n m"]


class Dot(NamedTuple):
    """A figure with its interval, and what it is made of."""

    value: float
    low: float
    high: float
    each: Mapping[str, Sequence[float]]
    """Figures of runs (or of tasks), by the mark that they get."""
    n: int
    """Runs, or pairs of runs."""


def band(curves: Iterable[Sequence[Mapping[str, Any]]], column: str) -> Band:
    """`column` of evaluations, at every step at which a seed was evaluated up to where the first of them ends; between
    its own evaluations a seed's curve is a straight line.
    """
    lines = [np.array([(row["env_steps"], row[column]) for row in curve], float).T for curve in curves]
    end = min(steps[-1] for steps, _ in lines)
    steps = np.unique(np.concatenate([steps[steps <= end] for steps, _ in lines]))
    each = np.stack([np.interp(steps, *line) for line in lines])
    mean, half_width = np.array([mean_interval(values) for values in each.T]).T
    return Band(steps, mean, half_width, each)


def arms(study: Study, **wanted: Any) -> dict[str, Row]:
    """Labels of an entry of each arm, in the study's order."""
    found: dict[str, Row] = {}
    for entry in study.entries:
        if all(entry.labels.get(key) == value for key, value in wanted.items()):
            found.setdefault(entry.labels["arm"], entry.labels)
    return found


def absent(study: Study, rows: Iterable[Row], **wanted: Any) -> list[str]:
    """Arms of the study that no row is of."""
    there = {row["label"] for row in rows}
    return [name for name in arms(study, **wanted) if name not in there]


def tasks(study: Study) -> dict[str, Row]:
    """Labels of an entry of each task, in the study's order."""
    found: dict[str, Row] = {}
    for entry in study.entries:
        found.setdefault(entry.labels["task"], entry.labels)
    return found


def rows_with_cost(results: Results, study: Study, **wanted: Any) -> list[Row]:
    """`Results.rows`, with `seconds_per_step`: of training, start-up and compilation left out; None if unknown."""
    rows = results.rows(study, **wanted)
    for row in rows:
        row["seconds_per_step"] = row["seconds_iteration"] / row["env_steps"] if row["env_steps"] else None
    return rows


def changes(rows: Sequence[Row], arm: str, baseline: str, metric: str) -> dict[str, Dot]:
    """Task -> relative change over |baseline| with the interval of `compare`; a pair's own is its difference over the
    same |mean of the baseline|. Tasks without a pair, or whose baseline is 0 on average, are left out.
    """
    found = {}
    for task, pairs in paired(rows, arm, baseline, metric).values.items():
        x, y = pairs.T
        change = relative_change(x, y, REPS)
        if math.isfinite(change.value):
            found[task] = Dot(*change, each={"": ((x - y) / abs(y.mean())).tolist()}, n=len(x))
    return found


def cost_ratios(rows: Sequence[Row], arm: str, baseline: str) -> dict[str, Dot]:
    """Task -> seconds of training over those of the baseline on the same seeds; the median of the pairs'."""
    found = {}
    for task, pairs in paired(rows, arm, baseline, "seconds_per_step").values.items():
        x, y = pairs.T
        found[task] = Dot(median_ratio(x, y).value, math.nan, math.nan, {"": (x / y).tolist()}, len(x))
    return found


def of_runs(values: Iterable[float | None]) -> Dot | None:
    """Mean of runs with its Student-t interval; None for no number at all. Of fewer than `BANDED` runs there is no
    interval: that of two is 12.7 times their standard error to each side.
    """
    known = [value for value in values if value is not None and math.isfinite(value)]
    if not known:
        return None
    mean, half_width = mean_interval(known)
    half_width = half_width if len(known) >= BANDED else math.nan
    return Dot(mean, mean - half_width, mean + half_width, {"": known}, len(known))


def seeds_in_words(dots: Iterable[Dot]) -> str:
    """`n = 3`, or `n = 2 to 8`."""
    counts = {dot.n for dot in dots}
    few, many = min(counts), max(counts)
    return f"n = {few}" if few == many else f"n = {few} to {many}"


def pareto(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points (cost, gain) that none beats, cheapest first: another costs no more and gains no less, and is
    better in one of them. Of equal points all are kept.
    """
    kept: list[str] = []
    best, best_cost = -math.inf, math.nan
    for name, (cost, gain) in sorted(points.items(), key=lambda point: (point[1][0], -point[1][1])):
        if gain > best or (gain == best and cost == best_cost):
            kept.append(name)
            best, best_cost = gain, cost
    return kept


def mean_over_tasks(rows: Sequence[Row], names: Sequence[str], metric: str, baseline: str | None) -> dict[str, Dot]:
    """Arm -> mean over tasks with its stratified bootstrap interval: of the change over `baseline`, or without one of
    the tasks' means. `each` is by task.

    Means are over the tasks that all of these arms have, so that they are of the same tasks; arms with none of their
    own are left out.
    """
    per_arm = {}
    for name in names:
        if baseline is not None:
            found = dict(paired(rows, name, baseline, metric).values)
            found = {task: pairs for task, pairs in found.items() if pairs[:, 1].mean()}
        else:
            found = _by_task(rows, name, metric)
        if found:
            per_arm[name] = found
    order = dict.fromkeys(row["task"] for row in rows)
    common = [task for task in order if all(task in own for own in per_arm.values())]
    dots = {}
    for name, found in per_arm.items() if common else ():
        strata = {task: found[task] for task in common}
        interval = mean_relative_change(strata, REPS) if baseline else stratified_bootstrap(strata, _mean, REPS)
        each = {
            task: [relative_change(*pairs.T, reps=1).value] if baseline else [float(pairs.mean())]
            for task, pairs in strata.items()
        }
        dots[name] = Dot(*interval, each=each, n=sum(map(len, strata.values())))
    return dots


def _by_task(rows: Sequence[Row], arm: str, metric: str) -> dict[str, Float[np.ndarray, " n"]]:
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["label"] == arm and row[metric] is not None:
            found.setdefault(row["task"], []).append(row[metric])
    return {task: np.array(values, float) for task, values in found.items()}


def _mean(scores: Mapping[Any, Float[np.ndarray, " n"]]) -> float:
    return float(np.mean([values.mean() for values in scores.values()]))
