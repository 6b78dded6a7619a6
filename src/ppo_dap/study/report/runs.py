"""What `ppo-dap report` says about runs, before it is a page: who is in, who leads, what differs, what it cost."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ppo_dap.dap.audit import Claim
from ppo_dap.errors import InputError
from ppo_dap.study.plots.curves import on_common_steps
from ppo_dap.study.stats.compare import mean_text
from ppo_dap.study.stats.measures import mean_interval
from ppo_dap.study.stats.pairing import paired, paired_wilcoxon, smallest_p
from ppo_dap.study.stats.summary import beside_ppo, run_row
from ppo_dap.training.clock import Line, profile
from ppo_dap.training.recording import TABLES, read_table
from ppo_dap.training.run import Run, load_run

LEVEL = 0.05
"""A lead with a paired p below this is called one."""
ENOUGH = next(n for n in itertools.count(1) if smallest_p(n) < LEVEL)
"""Fewest pairs whose exact test can give a p below `LEVEL`."""
SURROUNDINGS = ("prior_hash", "logs_hash", "python", "machine", "processor", "cpu_flags", "NPROC")
"""What config.json says beside the settings and the packages' versions."""
BROKEN = (InputError, OSError, ValueError, LookupError, TypeError, AttributeError)
"""What reading a damaged run folder can raise."""


@dataclass(frozen=True)
class Entry:
    """A run that could be read."""

    run: Run
    row: dict[str, Any]
    """As `summary.summarise` has it."""
    claims: list[Claim]
    evaluations: list[dict[str, Any]]
    metrics: list[dict[str, Any]]

    @property
    def label(self) -> str:
        """What the run is called beside others."""
        return self.row["label"]


class Found(NamedTuple):
    """The folders of a report."""

    entries: list[Entry]
    unreadable: dict[str, str]
    """Folder -> why."""


def read_runs(folders: Iterable[str | Path], epochs: float) -> Found:
    """The runs of these folders, each once, and the folders that hold none or a damaged one.

    Raises `InputError` for a path at which there is nothing, and where no folder can be read.
    """
    entries, unreadable, named = [], {}, {}
    for folder in folders:
        named.setdefault(Path(folder).resolve(), Path(folder))
    for folder in named.values():
        if not folder.exists():
            raise InputError(f"RUN {folder} does not exist: name run folders")
        try:
            entries.append(_read(folder, epochs))
        except BROKEN as error:
            unreadable[str(folder)] = _reason(error)
    if not entries:
        first = next(iter(unreadable.values()), "none was named")
        raise InputError(f"no RUN of {len(unreadable)} can be read: {first}")
    beside_ppo([entry.row for entry in entries])
    return Found(entries, unreadable)


def _read(folder: Path, epochs: float) -> Entry:
    run = load_run(folder)
    evaluations, metrics = (_whole(folder, table) for table in reversed(TABLES))
    for line, row in enumerate(evaluations, 1):
        if not (math.isfinite(row["return_mean"]) and math.isfinite(row["env_steps"])):
            raise InputError(f"line {line} of its evaluations.jsonl has a return that is no number")
    return Entry(run, run_row(run, epochs), run.audit(), evaluations, metrics)


def _whole(folder: Path, table: str) -> list[dict[str, Any]]:
    """A table of a run; `read_table` leaves out all that follows a broken line, which only the last may be."""
    path = folder / f"{table}.jsonl"
    rows = read_table(folder, table)
    lines = len(path.read_text().splitlines()) if path.is_file() else 0
    if lines - len(rows) > 1:
        raise InputError(f"line {len(rows) + 1} of its {table}.jsonl is damaged")
    return rows


def _reason(error: Exception) -> str:
    text = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
    return " ".join(text.split()) or type(error).__name__


def by(entries: Iterable[Entry], *names: str) -> dict[Any, list[Entry]]:
    """The entries by columns of their rows, in the order in which they come."""
    groups: dict[Hashable, list[Entry]] = {}
    for entry in entries:
        key = tuple(entry.row[name] for name in names)
        groups.setdefault(key if len(names) > 1 else key[0], []).append(entry)
    return groups


def finished(entries: Iterable[Entry]) -> list[Entry]:
    """Those that count for means, intervals and tests."""
    return [entry for entry in entries if entry.row["finished"]]


def values(entries: Iterable[Entry], metric: str) -> list[float]:
    """A column of the rows, without those that have no figure."""
    return [entry.row[metric] for entry in entries if entry.row[metric] is not None]


def interval_text(entries: Sequence[Entry], metric: str) -> str:
    """Mean +- half-width over runs, with their number where some have no figure."""
    own = values(entries, metric)
    if not own:
        return "-"
    text = mean_text(*mean_interval(own))
    return text if len(own) == len(entries) else f"{text} (n = {len(own)})"


def best_first(groups: Mapping[str, Sequence[Entry]]) -> list[str]:
    """The labels, that of the highest mean ALC first; where there is none, the last return counts."""

    def height(label: str) -> tuple[float, float]:
        own = [values(groups[label], metric) for metric in ("alc", "last_return")]
        return tuple(-sum(each) / len(each) if each else math.inf for each in own)  # type: ignore[return-value]

    return sorted(groups, key=height)


class Lead(NamedTuple):
    """The two methods of the highest means of a metric, on one task and budget."""

    first: str
    figure: str
    """Of the first, with its interval and number of runs."""
    second: str | None
    """None where no other method has the metric."""
    figure_of_second: str
    ranked: int
    """Methods that could come first."""
    few: int
    """Methods that could not: they have fewer than `ENOUGH` runs, and two others have more."""
    verdict: str
    """Whether the runs allow to say that the first leads."""


def leader(entries: Sequence[Entry], metric: str) -> Lead | None:
    """Which method has the highest mean, and whether that can be called a lead; None if no finished run has the metric.

    Where two methods have `ENOUGH` runs, those alone are ranked: a single lucky run would be first else.
    """
    groups = {label: values(own, metric) for label, own in by(finished(entries), "label").items()}
    groups = {label: own for label, own in groups.items() if own}
    if not groups:
        return None
    many = {label: own for label, own in groups.items() if len(own) >= ENOUGH}
    ranked = many if len(many) > 1 else groups
    figures = {label: f"{mean_text(*mean_interval(own))} (n = {len(own)})" for label, own in ranked.items()}
    first, *others = sorted(ranked, key=lambda label: -sum(ranked[label]) / len(ranked[label]))
    counts = len(ranked), len(groups) - len(ranked)
    if not others:
        return Lead(first, figures[first], None, "", *counts, "There is no other method to compare with.")
    verdict = _tested(entries, first, others[0], metric)
    return Lead(first, figures[first], others[0], figures[others[0]], *counts, verdict)


def _tested(entries: Sequence[Entry], first: str, second: str, metric: str) -> str:
    """Of two methods on one task and budget."""
    pairs = list(paired([entry.row for entry in single(finished(entries))], first, second, metric).values.values())
    if not pairs:
        return "No claim can be made: the two have no seed in common."
    x, y = pairs[0].T
    seeds, p = f"{len(x)} paired seed{'s' * (len(x) > 1)}", paired_wilcoxon(x, y)
    if len(x) < ENOUGH:
        return f"No claim can be made: {seeds} can give no p below {smallest_p(len(x)):.2g}."
    if p < LEVEL and x.mean() > y.mean():
        return f"The lead holds on {seeds}: p = {p:.2g}."
    return f"The two are not told apart on {seeds}: p = {p:.2g}."


def doubled(entries: Iterable[Entry]) -> list[list[Entry]]:
    """Runs of the same method, task, budget and seed: which of them makes a pair is not ours to say."""
    return [own for own in by(entries, "label", "task", "steps", "seed").values() if len(own) > 1]


def single(entries: Sequence[Entry]) -> list[Entry]:
    """The entries without those that are `doubled`."""
    twice = {id(entry) for own in doubled(entries) for entry in own}
    return [entry for entry in entries if id(entry) not in twice]


def curve(entries: Sequence[Entry]) -> dict[str, list[float] | None]:
    """Mean return of the runs of one method against environment steps, and its 95% interval (None for one run)."""
    evaluated = [entry.evaluations for entry in entries if entry.evaluations]
    if not evaluated:
        return {"steps": [], "mean": [], "half_width": None}
    steps, returns = on_common_steps(evaluated)
    found = [mean_interval(column) for column in returns.T]
    half_width = [each[1] for each in found] if len(evaluated) > 1 else None
    return {"steps": steps.tolist(), "mean": [each[0] for each in found], "half_width": half_width}


class Difference(NamedTuple):
    """A setting that is not the same in all runs."""

    name: str
    values: dict[str, dict[str, int]]
    """Value in words -> the methods that have it, and the number of their runs."""


def differences(entries: Sequence[Entry]) -> list[Difference]:
    """The settings, hashes and versions that differ, seeds aside."""
    described = [_described(entry.run.config) for entry in entries]
    found = []
    for name in dict.fromkeys(name for each in described for name in each):
        groups: dict[str, list[Entry]] = {}
        for entry, each in zip(entries, described, strict=True):
            groups.setdefault(each.get(name, "not recorded"), []).append(entry)
        if len(groups) > 1:
            counts = {value: {m: len(of) for m, of in by(own, "label").items()} for value, own in groups.items()}
            found.append(Difference(name, counts))
    return found


def _described(stored: Mapping[str, Any]) -> dict[str, str]:
    """Setting -> value in words."""
    settings = {name: value for name, value in stored["config"].items() if name != "seed"}
    around = {name: stored[name] for name in SURROUNDINGS if name in stored}
    versions = {f"version of {name}": value for name, value in stored.get("versions", {}).items()}
    return {name: _words(value) for name, value in (settings | around | versions).items()}


def _words(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    text = "none" if value is None else str(value)
    return text[:12] if len(text) == 64 else text  # a hash


class Cost(NamedTuple):
    """What the iterations of some runs took; the first of each run, which compiles, is left out."""

    seconds: float
    """Of one iteration."""
    lines: list[Line]
    """`clock.profile` of all of them together."""


def cost(entries: Sequence[Entry]) -> Cost | None:
    """Of the runs of one method; None where none has recorded what an iteration took."""
    profiles = {id(entry): found for entry in entries if (found := profile(entry.metrics))}
    if not profiles:
        return None
    measured = [entry.metrics[1:] for entry in entries if id(entry) in profiles]
    count = sum("seconds_iteration" in row for rows in measured for row in rows)
    total = sum(line.seconds for lines in profiles.values() for line in lines if not line.beside)
    together = []
    for lines in zip(*profiles.values(), strict=True):
        seconds = sum(line.seconds for line in lines)
        together.append(Line(lines[0].name, lines[0].beside, seconds, seconds / total))
    return Cost(total / count, together)


def seeds_text(entries: Iterable[Entry]) -> str:
    """`0-7`, `3`, or `0, 2, 5-6`; a seed that is there twice is followed by `x2`."""
    counts = Counter(entry.row["seed"] for entry in entries)
    rows: list[list[int]] = []
    for seed in sorted(counts):
        if rows and counts[seed] == counts[rows[-1][-1]] and seed == rows[-1][-1] + 1:
            rows[-1].append(seed)
        else:
            rows.append([seed])
    texts = (f"{row[0]}-{row[-1]}" if len(row) > 1 else str(row[0]) for row in rows)
    times = (f" x{counts[row[0]]}" if counts[row[0]] > 1 else "" for row in rows)
    return ", ".join(map("".join, zip(texts, times, strict=True)))
