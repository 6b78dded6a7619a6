"""What is kept of a store's runs when their folders are gone: small CSV files that every table and figure is made from.

runs.csv         a row a run: what it was, what it cost, what its audit and its proposals measured
evaluations.csv  a row an evaluation: cell, env_steps, return_mean, length_mean
reports.csv      a row a reliability report (5.7)
proposals.csv    a row a candidate of the few runs that Fig. 11 shows (proposal_figure.py)

Rows are named by their cell, so studies share them; labels come from the studies themselves.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppo_dap.errors import InputError
from ppo_dap.storage import write_atomically
from ppo_dap.study.stats.measures import COMPILED_AFTER, EPOCH, alc, late_return

if TYPE_CHECKING:
    from ppo_dap.study.store.cells import Cell
    from ppo_dap.study.store.grids import Study
    from ppo_dap.study.store.store import Store
    from ppo_dap.training.run import Run

Row = dict[str, Any]
MEANS = ("ess", "high_q_rate", "acceptance", "guided_displacement", "q_rank", "policy_kl", "prior_kl", "kl_to_prior")
"""Metrics of which a run's mean over its iterations is kept, NaN left out."""
WORST = {"spr": min, "pgshare": min, "oglr": max, "batch_fresh": min}
"""Measures of the audit (5.8), each by its worst iteration."""
WORDS = ("cell", "of", "task", "logs", "method", "preset", "options", "logs_hash", "processor")
"""Columns whose values are no numbers, whatever they look like."""
COUNTS = ("seed", "steps", "env_steps", "state", "guided", "drawn")
"""Columns of whole numbers."""
PAUSE = 3.0
"""An iteration that took so many times the median is no part of a run's cost: its process or machine was stopped."""


@dataclass
class Results:
    """What was measured, by the name of its cell."""

    runs: dict[str, Row] = field(default_factory=dict)
    curves: dict[str, list[Row]] = field(default_factory=dict)
    """Evaluations: rows of env_steps, return_mean, length_mean."""
    reports: dict[str, Row] = field(default_factory=dict)
    proposals: dict[str, list[Row]] = field(default_factory=dict)
    """Candidates of a run: rows of state, guided, drawn, q, x, y."""

    def rows(self, study: Study, **wanted: Any) -> list[Row]:
        """A row for each entry of the study that is a finished run and has these labels.

        Its labels, `label` (the arm, for `compare`), `run` (the cell), `alc` at the study's T, `late_return` and
        everything that runs.csv says of it; `alc` is None for a run whose evaluations end before T.
        """
        found = []
        for entry in study.entries:
            labels, name = entry.labels, entry.cell.name
            if name not in self.runs or any(labels.get(key) != value for key, value in wanted.items()):
                continue
            curve = self.curves[name]
            reached = bool(curve) and curve[-1]["env_steps"] >= study.epochs * EPOCH
            row = {"run": name, "label": labels["arm"], "finished": True} | self.runs[name] | labels
            area = alc(curve, study.epochs) if reached else None
            found.append(row | {"alc": area, "late_return": late_return(curve) if curve else None})
        return found

    def forget(self, cell: str) -> None:
        """Leave out a run and what was taken of it."""
        for table in (self.runs, self.curves, self.proposals):
            table.pop(cell, None)
        self.reports = {name: row for name, row in self.reports.items() if row["of"] != cell}

    def save(self, folder: Path) -> None:
        """Write the files; rows are in the order of their cells' names, so that a file changes where runs do."""
        for name, rows in (
            ("runs.csv", [{"cell": cell} | self.runs[cell] for cell in sorted(self.runs)]),
            ("evaluations.csv", [{"cell": cell} | row for cell in sorted(self.curves) for row in self.curves[cell]]),
            ("reports.csv", [{"cell": cell} | self.reports[cell] for cell in sorted(self.reports)]),
            (
                "proposals.csv",
                [{"cell": c} | row for c in sorted(self.proposals) for row in self.proposals[c]],
            ),
        ):
            if rows:
                write_atomically(folder / name, _csv(rows).encode())
            else:  # what has been forgotten must not come back
                (folder / name).unlink(missing_ok=True)


def load_results(folder: Path) -> Results:
    """What `Results.save` wrote; empty where there is nothing. Raises `InputError` for a file that is damaged."""
    found = Results()
    for row in _read(folder / "runs.csv"):
        found.runs[row.pop("cell")] = row
    for row in _read(folder / "evaluations.csv"):
        found.curves.setdefault(row.pop("cell"), []).append(row)
    for row in _read(folder / "reports.csv"):
        found.reports[row.pop("cell")] = row
    for row in _read(folder / "proposals.csv"):
        found.proposals.setdefault(row.pop("cell"), []).append(row)
    lacking = found.runs.keys() ^ found.curves.keys()
    if lacking:
        raise InputError(f"{folder}: runs.csv and evaluations.csv must name the same cells; one lacks {min(lacking)}")
    return found


def gather(store: Store, cells: Iterable[Cell], results: Results) -> Results:
    """`results` with what the store has made of these cells since; a run made anew takes the old one's place."""
    from ppo_dap.training.run import load_run

    for cell in cells:
        if not store.done(cell):
            continue
        if cell.kind == "run" and not _is_kept(cell, store, results):
            run = load_run(store.out(cell))
            results.forget(cell.name)
            results.runs[cell.name] = _identity(cell) | _measured(run) | store.cost(cell) | _origin(run)
            results.curves[cell.name] = [
                {name: row[name] for name in ("env_steps", "return_mean", "length_mean")} for row in run.evaluations
            ]
        if cell.kind == "reliability" and cell.name not in results.reports:
            report = json.loads(store.artefact(cell).read_text())
            # Where the run lay is this store's affair: the files are kept where it is not.
            del report["run"]
            results.reports[cell.name] = {"of": cell.needs["run"].name} | dict(_flat(report))
    return results


def _is_kept(cell: Cell, store: Store, results: Results) -> bool:
    """Whether the run in the store is the one whose row there is, which nobody need read again: no two take as long."""
    row = results.runs.get(cell.name)
    return row is not None and all(_cell(row.get(name)) == _cell(value) for name, value in store.cost(cell).items())


def _identity(cell: Cell) -> Row:
    """What a person who reads the file wants to know of a run."""
    call = {name: value for name, value in cell.call.items() if name not in ("seed", "steps", "tensorboard")}
    source = cell.needs.get("prior", cell).needs.get("logs")
    return {
        "task": cell.settings["task"],
        "logs": "" if source is None else source.settings["tier"],
        "method": cell.settings["method"],
        "preset": cell.settings["preset"],
        "options": " ".join(f"{name}={value}" for name, value in call.items()),
        "seed": cell.settings["seed"],
        "steps": cell.settings["steps"],
    }


def _origin(run: Run) -> Row:
    """What decides whether runs may stand beside each other: their logs, and whose floating-point bits they have."""
    config = run.config
    return {
        "logs_hash": config["prior_hash"] or config.get("logs_hash") or "",
        "processor": config.get("processor", ""),
    }


def _measured(run: Run) -> Row:
    """What a run's tables say in all."""
    metrics, evaluations = run.metrics, run.evaluations
    strictly, declared = run.verdict()
    found: Row = {"last_return": evaluations[-1]["return_mean"], "last_length": evaluations[-1]["length_mean"]}
    found["strictly_on_policy"], found["as_declared"] = strictly, declared
    found |= _cost(metrics)
    for name in MEANS:
        values = [row[name] for row in metrics if _number(row.get(name))]
        found[name] = sum(values) / len(values) if values else None
    shares = [row["pgshare"] for row in metrics if _number(row.get("pgshare"))]
    found["pgshare_mean"] = sum(shares) / len(shares) if shares else None  # the paper tells its usual size (5.8)
    for name, worst in WORST.items():
        values = [row[name] for row in metrics if _number(row.get(name))]
        found[name] = worst(values) if values else None
    return found


def _cost(metrics: list[Row]) -> Row:
    """Seconds of the iterations that count, in all and by their parts, and their environment steps."""
    steps = [row["env_steps"] - before["env_steps"] for before, row in itertools.pairwise(metrics)]
    settled = list(zip(metrics[COMPILED_AFTER:], steps[COMPILED_AFTER - 1 :], strict=True))
    usual = statistics.median(row["seconds_iteration"] for row, _ in settled) if settled else 0.0
    counted = [(row, taken) for row, taken in settled if row["seconds_iteration"] <= PAUSE * usual]
    parts = sorted({name for row, _ in counted for name in row if name.startswith("seconds_")})
    spent = {name: sum(row.get(name, 0.0) for row, _ in counted) for name in parts}
    return {"env_steps": sum(taken for _, taken in counted)} | spent


def _number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """The numbers of a nested report, by the path to each."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str) or value is None:
            yield prefix + name, value


def _csv(rows: list[Row]) -> str:
    file = io.StringIO()
    columns = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return file.getvalue()


def _cell(value: Any) -> Any:
    return "" if value is None else f"{value:.7g}" if isinstance(value, float) else value


def _read(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    with open(path, newline="") as file:
        try:
            rows = list(csv.DictReader(file, strict=True))
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{path} is damaged ({error}): make it again with ppo-dap study") from error
    for row in rows:
        if "cell" not in row or None in row or None in row.values():  # a line that is too long, or too short
            raise InputError(f"{path} is damaged at {list(row.values())[:3]}: make it again with ppo-dap study")
    return [{name: _value(name, text) for name, text in row.items()} for row in rows]


def _value(name: str, text: str) -> Any:
    if name in WORDS:
        return text
    if not text or text in ("True", "False"):
        return None if not text else text == "True"
    try:
        return int(text) if name in COUNTS else float(text)
    except ValueError:
        return text
