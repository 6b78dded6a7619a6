"""What tables and figures read off a study's runs: its arms and settings, and `compare`'s rows by what they are of."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.study.results import Results
from ppo_dap.study.stats.compare import compare, overall
from ppo_dap.study.stats.summary import AUDIT
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import make_study
from ppo_dap.study.tables.table import Row

COSTS = ("steps_per_second", "seconds_per_step", "peak_mib")
"""Of settled iterations; the largest peak of all attempts at the run."""
SHARES = ("proposals_share", "pet_share")
"""Seconds of the device over those of the iterations; what goes by beside the rollout costs less than this."""
_TOLD = (
    "mean", "half_width", "ratio", "ratio_low", "ratio_high", "difference", "difference_half_width", "change",
    "change_low", "change_high", "effect", "p", "smallest_p", "p_holm", "improvement", "improvement_low",
    "improvement_high",
)  # fmt: skip
_OVERALL = ("iqm", "iqm_low", "iqm_high", "iqm_baseline", "iqm_baseline_low", "iqm_baseline_high")
NOTHING: Row = {"n": 0, "pairs": 0, "tasks": 0} | dict.fromkeys((*_TOLD, *_OVERALL), math.nan)
"""A row of `compare` or of `overall` about runs that are not there."""


class Effects(dict[tuple[str, ...], Row]):
    """Rows of `compare` by (metric, task, arm), or of `overall` by (metric, arm); `NOTHING` for what is not there."""

    def __missing__(self, key: tuple[str, ...]) -> Row:
        return NOTHING


@dataclass(frozen=True)
class View:
    """The runs of one study, or of a part of it, that are declared, and those that are finished."""

    study: Study
    rows: list[Row]
    """A row a finished run: `Results.rows`, and its costs."""

    @cached_property
    def settings(self) -> list[tuple[str, str]]:
        """(task, logs), as they are declared."""
        return list(dict.fromkeys((e.labels["task"], e.labels["logs"]) for e in self.study.entries))

    @cached_property
    def tasks(self) -> list[str]:
        """Of the settings."""
        return list(dict.fromkeys(task for task, _ in self.settings))

    @cached_property
    def arms(self) -> dict[str, Row]:
        """Arm -> the labels of one of its entries."""
        found: dict[str, Row] = {}
        for entry in self.study.entries:
            found.setdefault(entry.labels["arm"], entry.labels)
        return found

    @cached_property
    def steps(self) -> int:
        """Of a run of this part."""
        return max(entry.labels["steps"] for entry in self.study.entries)

    def effects(self, baseline: str, metrics: Sequence[str], arms: Iterable[str] | None = None) -> Effects:
        """What `compare` says of these arms (default: all), and of their means alone where no run has the baseline."""
        rows = self._of(arms, metrics)
        labels = list(dict.fromkeys(row["label"] for row in rows))
        if baseline in labels:
            found = compare(rows, baseline, metrics)
        else:
            own = ([row for row in rows if row["label"] == label] for label in labels)
            found = [row for label, each in zip(labels, own, strict=True) for row in compare(each, label, metrics)]
        return Effects({(row["metric"], row["task"], row["method"]): row for row in found})

    def over(self, baseline: str, metrics: Sequence[str], arms: Iterable[str] | None = None) -> Effects:
        """What `overall` says of these arms."""
        rows = self._of(arms, metrics)
        if baseline not in {row["label"] for row in rows}:
            return Effects()
        return Effects({(row["metric"], row["method"]): row for row in overall(rows, baseline, metrics)})

    def base(self, arm: str) -> str:
        """What the arm is called in the preset `paper`, and in the paper."""
        return arm.removesuffix(f" ({self.arms[arm]['preset']})")

    def named(self, base: str, preset: str) -> str:
        """The arm of that name and preset, or no arm's name."""
        return next((a for a in self.arms if self.base(a) == base and self.arms[a]["preset"] == preset), "")

    def runs(self, arm: str, task: str | None = None) -> list[Row]:
        """The finished runs of an arm."""
        return [row for row in self.rows if row["label"] == arm and task in (None, row["task"])]

    def _of(self, arms: Iterable[str] | None, metrics: Sequence[str]) -> list[Row]:
        wanted, unknown = None if arms is None else set(arms), dict.fromkeys(metrics, None)
        return [{**unknown, **row} for row in self.rows if wanted is None or row["label"] in wanted]


def view(results: Results, study: Study, name: str, part: str | None = None) -> View:
    """Study `name` of `study`, which may hold several; raises `InputError` where it does not have it."""
    wanted = {"study": name} | ({} if part is None else {"part": part})
    entries = [e for e in study.entries if all(e.labels.get(key) == value for key, value in wanted.items())]
    runs = tuple(entry for entry in entries if entry.cell.kind == "run")
    if not runs:
        what = " part ".join(wanted.values())
        raise InputError(f"study {study.name} has no runs of {what}: take study {name}, or all")
    own = dataclasses.replace(study, entries=runs)
    return View(own, [_measured(row) for row in results.rows(own)])


def _measured(row: Row) -> Row:
    """The row with its costs and the ratio of its KLs; what is not known is None."""
    row = {name: finite_or_none(value) for name, value in row.items()}
    seconds, steps = row.get("seconds_iteration") or 0.0, row.get("env_steps") or 0
    settled = bool(seconds and steps)
    row["steps_per_second"] = steps / seconds if settled else None
    row["seconds_per_step"] = seconds / steps if settled else None
    row["peak_mib"] = row.get("peak_mib") or None  # 0: it was not measured
    policy, prior = row.get("policy_kl"), row.get("prior_kl")
    row["kl_ratio"] = prior / policy if policy and prior is not None else None
    for name in SHARES:
        spent = row.get(f"seconds_{name.removesuffix('_share')}")
        row[name] = spent / seconds if settled and spent is not None else None
    return row


def finite_or_none(value: Any) -> Any:
    """The value, None for NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def across(values: Iterable[float]) -> tuple[float, float, int]:
    """Mean and standard deviation over tasks, and how many there are; NaN is left out."""
    found = [value for value in values if not math.isnan(value)]
    if not found:
        return math.nan, math.nan, 0
    return float(np.mean(found)), float(np.std(found, ddof=1)) if len(found) > 1 else math.nan, len(found)


def verdict(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the audit says of these runs, the worst of it first; a violation is never outvoted."""
    counts = Counter(AUDIT[row["strictly_on_policy"], row["as_declared"]] for row in rows)
    for words in reversed(AUDIT.values()):
        if counts[words]:
            return words if counts[words] == len(rows) else f"{words}: {counts[words]} of {len(rows)}"
    return ""


def command(study: Study) -> str:
    """What makes the study's runs."""
    declared = make_study(study.name)
    seeds, steps = ({entry.labels[label] for entry in study.entries} for label in ("seed", "steps"))
    usual = ({entry.labels[label] for entry in declared.entries} for label in ("seed", "steps"))
    told = f"ppo-dap study {study.name}"
    if seeds != next(usual):
        told += f" --seeds {spelled(sorted(seeds))}"
    if not steps <= next(usual):
        told += f" --steps {max(steps)}"
    return told


def spelled(numbers: Sequence[int]) -> str:
    """0-7, or 0,2,5."""
    if len(numbers) > 1 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]}-{numbers[-1]}"
    return ",".join(map(str, numbers))


def made_by(study: Study, *views: View) -> list[str]:
    """How the runs of a table are made, how many there are, and whether their logs and processors are the same."""
    cells = {entry.cell.name for each in views for entry in each.study.entries}
    done = {row["run"]: row for each in views for row in each.rows}
    parts, lacking = [], []
    for each in views:
        seeds = spelled(sorted({entry.labels["seed"] for entry in each.study.entries}))
        parts.append(f"{each.steps:,} steps, seeds {seeds}")
        arms = [arm for arm in each.arms if not each.runs(arm)]
        if arms:
            names = "all" if len(arms) == len(each.arms) else "; ".join(arms)
            lacking.append(names + (f" (of {each.steps:,} steps)" if len(views) > 1 else ""))
    what = " and ".join(dict.fromkeys(parts))
    notes = [f"`{command(study)}`: {what}; {len(done)} of {len(cells)} runs are finished."]
    if lacking and done:
        notes.append(f"No finished run yet: {'; '.join(lacking)}.")
    return notes + _origins(done.values())


def _origins(rows: Iterable[Row]) -> list[str]:
    """What is to be said of runs that were not all made from the same logs, or on the same processor."""
    notes, logs, processors = [], defaultdict(set), Counter()
    for row in rows:
        if row.get("logs_hash"):
            logs[f"{row['label']} on {row['task']}", row["logs"]].add(row["logs_hash"])
        processors[row.get("processor") or "not recorded"] += 1
    if apart := [f"{arm} ({len(hashes)} of tier {tier})" for (arm, tier), hashes in logs.items() if len(hashes) > 1]:
        notes.append(
            f"**Seeds of an arm had different logs**, so they are no sample of one experiment: {'; '.join(apart)}."
        )
    if len(processors) > 1:
        told = ", ".join(f"{name} ({n} runs)" for name, n in sorted(processors.items()))
        notes.append(f"Made on several processors, on which a prior has other bits: {told}.")
    return notes
