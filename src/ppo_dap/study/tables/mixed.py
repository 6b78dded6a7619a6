"""Logs of several gaits: every arm, the whole against clones, what a part is worth, and the paper's settings."""

from __future__ import annotations

from collections.abc import Sequence

from ppo_dap.methods import get_method
from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import PPO, TUNED_WARM
from ppo_dap.study.tables.effects import View, made_by, verdict, view
from ppo_dap.study.tables.table import (
    READ,
    TESTED,
    TESTS,
    WALL,
    Columns,
    Row,
    Table,
    change_text,
    difference_text,
    listed,
    mean_text,
    ratio_text,
)

WHOLE = TUNED_WARM.name
PAPER = get_method("ppo-dap").row
"""PPO-DAP with the paper's settings: no start from logs."""


def mixed(results: Results, study: Study) -> Table:
    """All arms; `tuned-warm` against each clone; and its difference to itself without each part."""
    title, runs = "Logs of several gaits", view(results, study, "mixed", "early")
    views = [runs]
    records = _records(runs)
    more = [_clones(runs, study.epochs), _parts(runs, study.epochs), *_others(runs, study.epochs)] if records else []
    if any((entry.labels["study"], entry.labels["part"]) == ("mixed", "full") for entry in study.entries):
        long = view(results, study, "mixed", "full")
        views.append(long)
        which = f", runs of {long.steps:,} steps"
        more += [listed(title + which, _records(long), _columns(long, study.epochs), words=3)]
        more += [_clones(long, study.epochs, which)]
    notes = [READ, WALL, "The paper has no such logs."]
    return listed(title, records, _columns(runs, study.epochs), notes, 3, made_by(study, *views), more)


def _records(runs: View) -> list[Row]:
    """Each arm on each task, as far as it has been run."""
    metrics = ["alc", "last_return", "seconds_per_step"]
    found, records = runs.effects(PPO.name, metrics), []
    for task, logs in runs.settings:
        for arm, labels in runs.arms.items():
            if own := runs.runs(arm, task):
                record = {"task": task, "logs": logs, "method": arm, "preset": labels["preset"], "n": len(own)}
                record |= {metric: found[metric, task, arm] for metric in metrics}
                records.append(record | {"audit": verdict(own)})
    return records


def _columns(runs: View, epochs: float) -> Columns:
    ppo: Columns = {"wall-clock x PPO": lambda row: ratio_text(row["seconds_per_step"], row["n"])}
    return {
        "task": lambda row: row["task"],
        "method": lambda row: row["method"],
        "preset": lambda row: row["preset"],
        "n": lambda row: str(row["n"]),
        f"ALC@{epochs:g}": lambda row: mean_text(row["alc"], of=row["n"]),
        f"return after {runs.steps:,} steps": lambda row: mean_text(row["last_return"], of=row["n"]),
        **(ppo if PPO.name in runs.arms else {}),
        "audit": lambda row: row["audit"],
    }


def _clones(runs: View, epochs: float, which: str = "") -> Table:
    """The whole against what has only its start, and against PPO."""
    baselines = [arm for arm, labels in runs.arms.items() if labels["method"] in ("ppo-bc", PPO.method)]
    measures = {"alc": f"ALC@{epochs:g}", "last_return": f"return after {runs.steps:,} steps"}
    return _against(runs, WHOLE, baselines, measures, f"{WHOLE} against clones and PPO{which}")


def _others(runs: View, epochs: float) -> list[Table]:
    """PPO-DAP as the paper has it against every other method without a start from logs."""
    if PAPER not in runs.arms:
        return []
    baselines = [a for a, own in runs.arms.items() if own["preset"] == PPO.preset and own["method"] != "ppo-bc"]
    baselines.remove(PAPER)
    title = f"{PAPER} with the paper's settings against every other method"
    return [_against(runs, PAPER, baselines, {"alc": f"ALC@{epochs:g}"}, title)]


def _against(runs: View, whole: str, baselines: Sequence[str], measures: dict[str, str], title: str) -> Table:
    rows = []
    for baseline in baselines:
        found = runs.effects(baseline, list(measures), [whole, baseline])
        for metric, measure in measures.items():
            for task in runs.tasks:
                own = found[metric, task, whole]
                if own["pairs"]:
                    rows.append({"against": baseline, "measure": measure, **own})
    columns: Columns = {
        "against": lambda row: row["against"],
        "measure": lambda row: row["measure"],
        "task": lambda row: row["task"],
        "change": lambda row: change_text(row, row["pairs"]),
        **TESTS,
    }
    return listed(title, rows, columns, [TESTED], words=3)


def _parts(runs: View, epochs: float) -> Table:
    """Each arm that leaves one part out, or has one more, against the whole."""
    parts = [arm for arm in runs.arms if arm.startswith(f"{WHOLE}: ")]
    metrics = ["alc", "last_return"]
    found, records = runs.effects(WHOLE, metrics, [WHOLE, *parts]), []
    for task in runs.tasks:
        for arm in parts:
            record: Row = {"task": task, "method": arm} | {metric: found[metric, task, arm] for metric in metrics}
            if any(record[metric]["pairs"] for metric in metrics):
                records.append(record)

    def p(metric: str):
        return lambda row: TESTS["p"](row[metric])

    columns: Columns = {
        "task": lambda row: row["task"],
        "with": lambda row: row["method"].removeprefix(f"{WHOLE}: "),
        f"ALC@{epochs:g}": lambda row: difference_text(row["alc"]),
        f"p of ALC@{epochs:g}": p("alc"),
        f"return after {runs.steps:,} steps": lambda row: difference_text(row["last_return"]),
        "p of return": p("last_return"),
    }
    notes = [
        "Mean paired difference to the whole, ± 95% (Student's t): below 0 where the change costs something. p as "
        "above, not corrected over the parts."
    ]
    return listed(f"What each part of {WHOLE} is worth", records, columns, notes, words=2)
