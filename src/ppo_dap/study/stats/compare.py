"""`ppo-dap summary --compare`: methods against a baseline on the same seeds, by task and over the tasks (5.1.3)."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ppo_dap.errors import InputError, unknown
from ppo_dap.study.stats.measures import (
    REPS,
    interquartile_means,
    mean_interval,
    median_ratio,
    normalised_score,
    normalised_tasks,
    probability_of_improvement,
    relative_change,
    stratified_bootstrap,
)
from ppo_dap.study.stats.pairing import Pairs, cohens_d_paired, holm, paired, paired_wilcoxon, smallest_p

Row = Mapping[str, Any]
METRICS = ("alc", "last_return")
"""Columns of `summary.summarise` that are compared; higher is better."""


def compare(
    rows: Sequence[Row], baseline: str, metrics: Sequence[str] = METRICS, reps: int = REPS
) -> list[dict[str, Any]]:
    """A dict for each metric, task and method (label), the baseline among them; what cannot be told is NaN.

    `n`, `mean` and `half_width` (Student's t, 95%) are over all finished runs that have the metric. Everything else is
    over the `pairs` with the baseline (task, seed and steps agree): `ratio`, the median of the pairs' where the
    baseline's are above 0, and `change` of the mean over the baseline's absolute value, both with their intervals,
    `effect` (d_z), exact Wilcoxon `p` beside the `smallest_p` that so many pairs can give, `p_holm` over the tasks of
    this method and metric, `improvement`, the probability that a run of the method beats one of the baseline, with its
    interval, and `difference`, the mean of the paired differences, with `difference_half_width` (Student's t, 95%).
    `unpaired` names the runs in no pair.

    `reps` is the number of resamples. A run that is not finished is left out with a warning. Raises `InputError` for a
    baseline that no run has, and for runs of several budgets on one task.
    """
    rows = comparable(rows, baseline)
    found: list[dict[str, Any]] = []
    for metric in metrics:
        for method in _methods(rows, baseline):
            pairs = paired(rows, method, baseline, metric)
            tasks = dict.fromkeys(row["task"] for row in rows if row["label"] == method and row[metric] is not None)
            own = [_row(rows, baseline, metric, method, task, pairs, reps) for task in tasks]
            tested = [row for row in own if row["pairs"] and method != baseline]
            for row, p in zip(tested, holm([row["p"] for row in tested]), strict=True):
                row["p_holm"] = float(p)
            found += own
    order = list(dict.fromkeys(row["task"] for row in rows))
    return sorted(found, key=lambda row: (metrics.index(row["metric"]), order.index(row["task"])))


def overall(
    rows: Sequence[Row], baseline: str, metrics: Sequence[str] = METRICS, reps: int = REPS
) -> list[dict[str, Any]]:
    """A dict for each metric and method over all tasks on which it has a pair (Agarwal et al. 2021).

    `improvement` is the probability of improvement, a mean over the tasks; `iqm` and `iqm_baseline` are interquartile
    means of normalised scores over those of the tasks that have one (`normalised_tasks`). Each has its interval by
    stratified bootstrap of `reps` resamples, as `_low` and `_high`; where a task has one pair there is none.
    """
    rows = comparable(rows, baseline)
    found = []
    for metric in metrics:
        for method in _methods(rows, baseline)[1:]:
            pairs = paired(rows, method, baseline, metric).values
            if not pairs:
                continue
            x, y = ({task: values[:, side] for task, values in pairs.items()} for side in (0, 1))
            row: dict[str, Any] = {"metric": metric, "method": method, "baseline": baseline, "tasks": len(pairs)}
            row["pairs"] = sum(map(len, pairs.values()))
            row |= _named("improvement", probability_of_improvement(x, y, reps))
            normalised = [task for task in pairs if task in normalised_tasks()]
            row["normalised_tasks"] = len(normalised)
            for name, side in (("iqm", x), ("iqm_baseline", y)):
                scores = {t: np.array([normalised_score(t, value) for value in side[t]]) for t in normalised}
                told = stratified_bootstrap(scores, _iqm, reps, at_once=True) if scores else (math.nan,) * 3
                row |= _named(name, told)
            found.append(row)
    return found


def comparable(rows: Sequence[Row], baseline: str) -> list[Row]:
    """The finished runs; raises `InputError` where they cannot be compared with `baseline`."""
    for row in rows:
        if not row["finished"]:
            warnings.warn(f"{row['run']} is not finished: it is left out", stacklevel=2)
    rows = [row for row in rows if row["finished"]]
    labels = {row["label"] for row in rows}
    if baseline not in labels:
        raise unknown("method to compare with, of a finished run,", baseline, labels)
    for task in {row["task"] for row in rows}:
        budgets = sorted({row["steps"] for row in rows if row["task"] == task})
        if len(budgets) > 1:
            steps = " and ".join(f"{budget:,}" for budget in budgets)
            raise InputError(f"runs of {task} have {steps} steps: compare runs of one budget")
    return list(rows)


def _methods(rows: Sequence[Row], baseline: str) -> list[str]:
    """The baseline, then the others as they come."""
    return list(dict.fromkeys([baseline, *(row["label"] for row in rows)]))


def _named(name: str, interval: Sequence[float]) -> dict[str, float]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def _iqm(scores: Mapping[str, Any]) -> Any:
    return interquartile_means(np.concatenate(list(scores.values()), axis=-1))


def _row(
    rows: Sequence[Row], baseline: str, metric: str, method: str, task: str, pairs: Pairs, reps: int
) -> dict[str, Any]:
    own = [row[metric] for row in rows if row["task"] == task and row["label"] == method and row[metric] is not None]
    mean, half_width = mean_interval(own)
    row: dict[str, Any] = {"task": task, "method": method, "baseline": baseline, "metric": metric, "n": len(own)}
    row |= {"mean": mean, "half_width": half_width, "pairs": 0, "unpaired": []}
    row |= dict.fromkeys(("change", "change_low", "change_high", "effect"), math.nan)
    row |= dict.fromkeys(("difference", "difference_half_width", "p", "smallest_p", "p_holm"), math.nan)
    row |= _named("improvement", (math.nan,) * 3) | _named("ratio", (math.nan,) * 3)
    if method == baseline:
        return row
    row["unpaired"] = list(pairs.unpaired.get(task, ()))
    if task not in pairs.values:
        return row
    x, y = pairs.values[task].T
    return row | {
        "pairs": len(x),
        **dict(zip(("difference", "difference_half_width"), mean_interval(x - y), strict=True)),
        **_named("ratio", median_ratio(x, y, reps)),
        **_named("change", relative_change(x, y, reps)),
        "effect": cohens_d_paired(x, y),
        "p": paired_wilcoxon(x, y),
        "smallest_p": smallest_p(len(x)),
        **_named("improvement", probability_of_improvement({task: x}, {task: y}, reps)),
    }


class Shown(NamedTuple):
    """The comparison of one metric in words."""

    title: str
    cells: list[list[str]]
    """A row a task and method, under `COLUMNS`."""
    over_tasks: list[str]
    unpaired: list[str]
    """The runs that are in no pair."""


def shown(rows: Sequence[Row], over_tasks: Sequence[Row] = (), epochs: float = 40.0) -> list[Shown]:
    """The rows of `compare` and of `overall` in words, a table a metric."""
    found = []
    for metric in dict.fromkeys(row["metric"] for row in rows):
        own = [row for row in rows if row["metric"] == metric]
        cells = [_cells(row) for row in own]
        found.append(Shown(_title(own[0], epochs), cells, _over_tasks(over_tasks, metric), _left_out(own)))
    return found


def print_comparison(rows: Sequence[Row], over_tasks: Sequence[Row] = (), epochs: float = 40.0) -> None:
    """The rows of `compare` as a table a metric, below it those of `overall` and the runs that are in no pair."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    for part in shown(rows, over_tasks, epochs):
        table = Table(title=part.title)
        for column in COLUMNS[1:]:
            words = column == "method"
            table.add_column(column, justify="left" if words else "right", no_wrap=not words, overflow="fold")
        for task in dict.fromkeys(line[0] for line in part.cells):
            table.add_row(f"[bold]{task}[/bold]")
            for line in part.cells:
                if line[0] == task:
                    table.add_row(*map(escape, line[1:]))
            table.add_section()
        console = Console(width=120)
        console.print(table)
        for note in (*part.over_tasks, *part.unpaired):
            console.print(note, markup=False, highlight=False)


def markdown(rows: Sequence[Row], over_tasks: Sequence[Row] = (), epochs: float = 40.0) -> str:
    """What `print_comparison` prints, as Markdown."""
    parts: list[str] = []
    for part in shown(rows, over_tasks, epochs):
        cells = ([cell.replace("|", r"\|") for cell in line] for line in part.cells)
        lines = [COLUMNS, ["---"] * 2 + ["---:"] * (len(COLUMNS) - 2), *cells]
        parts += [part.title, "\n".join(f"| {' | '.join(line)} |" for line in lines)]
        notes = [f"- {note}" for note in (*part.over_tasks, *part.unpaired)]
        parts += ["\n".join(notes)] if notes else []
    return "\n\n".join(parts)


def save_csv(rows: Sequence[Row], path: str | Path) -> None:
    """Write rows with the same columns to a file; NaN and None become empty cells."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        return "; ".join(value)
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else value


COLUMNS = ["task", "method", "n", "mean +- 95%", "pairs", "change [95%]", "P(better)", "p", "least p", "Holm p"]


def _cells(row: Row) -> list[str]:
    count = f"{row['pairs']}" if row["pairs"] else "-"
    p = (_number(row[name], ".2g") for name in ("p", "smallest_p", "p_holm"))
    change = _with_interval(row, "change", "+.0%")
    mean = mean_text(row["mean"], row["half_width"])
    return [row["task"], row["method"], str(row["n"]), mean, count, change, _number(row["improvement"], ".2f"), *p]


def mean_text(mean: float, half_width: float) -> str:
    """A mean and the half-width of its interval, without it where it is NaN."""
    text = f"{mean:{_digits(mean)}}"
    return text if math.isnan(half_width) else f"{text} +- {half_width:{_digits(mean)}}"


def _digits(value: float) -> str:
    return ",.0f" if abs(value) >= 100 else ",.1f"


def _number(value: float, form: str) -> str:
    return "-" if math.isnan(value) else format(value, form)


def _with_interval(row: Row, name: str, form: str) -> str:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    interval = "" if math.isnan(low) else f" [{low:{form}}, {high:{form}}]"
    return _number(row[name], form) + interval


def _title(row: Row, epochs: float) -> str:
    name = {"alc": f"ALC@{epochs:g}", "last_return": "last return"}.get(row["metric"], row["metric"])
    return f"{name} against {row['baseline']}, paired by seed"


def _over_tasks(rows: Sequence[Row], metric: str) -> list[str]:
    lines = []
    for row in rows:
        if row["metric"] != metric or row["tasks"] < 2:
            continue
        told = f"{row['method']} over {row['tasks']} tasks: P(better) {_with_interval(row, 'improvement', '.2f')}"
        if row["normalised_tasks"]:
            told += (
                f"; IQM of normalised scores ({row['normalised_tasks']} tasks) {_with_interval(row, 'iqm', '.2f')}, "
                f"of {row['baseline']} {_with_interval(row, 'iqm_baseline', '.2f')}"
            )
        lines.append(told)
    return lines


def _left_out(rows: Sequence[Row]) -> list[str]:
    """Each run that is in no pair, once for all methods that it could have been paired with."""
    return [f"{task}: {text}" for task, text in dict.fromkeys((r["task"], t) for r in rows for t in r["unpaired"])]
