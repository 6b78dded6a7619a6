"""The tables of Section 5 from what studies measured, with the paper's numbers beside ours.

A table is a function of (results, study) that takes what is finished: what is not there is empty, how many runs a
number rests on stands beside it, and nothing is told that so few cannot tell.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import DAP, PPO, VARIANTS
from ppo_dap.study.tables.cost import fig8, table6, table7
from ppo_dap.study.tables.effects import Effects, View, made_by, view
from ppo_dap.study.tables.figures import fig6, fig7, fig9, fig10, fig11
from ppo_dap.study.tables.mixed import mixed
from ppo_dap.study.tables.paper import CLAIMS, printed, printed_change
from ppo_dap.study.tables.sections import ablation, audit, coverage, fig12, reliability
from ppo_dap.study.tables.table import (
    OTHER_LOGS,
    READ,
    TESTED,
    TESTS,
    Columns,
    Row,
    Table,
    better_text,
    change_text,
    iqm_text,
    listed,
    mean_text,
    number,
    printed_text,
)

FIVE = (PPO.name, *(arm.name for arm in VARIANTS))
"""What PPO-DAP is held against in Table 4."""


def table4(results: Results, study: Study) -> Table:
    """Final return on eight tasks; its change over PPO; and over the tasks."""
    runs = view(results, study, "table4", "full")
    found = runs.effects(PPO.name, ["last_return"])
    rows, lines = [], []
    for task, logs in runs.settings:
        paper, ours = [task, "the paper"], [task, "ours"]
        for arm, labels in runs.arms.items():
            of, own = printed("Table 4", "last_return", task, arm), found["last_return", task, arm]
            paper.append(printed_text(*of, ",.1f"))
            ours.append(mean_text(own))
            given = {"task": task, "logs": logs, "method": arm, "preset": labels["preset"]}
            rows.append(own | given | _paper(*of))
        lines += [paper, ours]
    title = f"Table 4: return after {runs.steps:,} steps"
    columns = ["task", "whose", *runs.arms]
    if not runs.rows:
        return Table(title, columns, [], [], made=made_by(study, runs))
    notes = [READ, OTHER_LOGS, "PPO-GC, PPO-ARC and ABPPO are reconstructions."]
    more = [_changes(runs, found), _late(runs, "Table 4"), _over_tasks(runs, found)]
    return Table(title, columns, lines, rows, notes, 2, made_by(study, runs), more)


def _paper(value: float, spread: float, **more: float) -> Row:
    return {"paper": value, "paper_half_width": spread} | {f"paper_{name}": number for name, number in more.items()}


def _changes(runs: View, found: Effects) -> Table:
    rows = []
    for arm in runs.arms:
        for task in runs.tasks:
            own, of = found["last_return", task, arm], printed_change(task, runs.base(arm))
            if arm != PPO.name and own["pairs"]:
                rows.append(own | {"paper_change": of})
    columns: Columns = {
        "method": lambda row: row["method"],
        "task": lambda row: row["task"],
        "the paper": lambda row: number(row["paper_change"], "+.1%"),
        "ours": lambda row: change_text(row, row["pairs"]),
        **TESTS,
    }
    notes = ["Over |PPO|; the paper's are those of the means that it prints.", TESTED]
    return listed("Table 4: change over PPO", rows, columns, notes, words=2)


def _over_tasks(runs: View, found: Effects) -> Table:
    over, rows = runs.over(PPO.name, ["last_return"]), []
    for arm in runs.arms:
        own = over["last_return", arm]
        if own["tasks"]:
            best, of = _best(found, runs.tasks, arm) if runs.base(arm) == DAP.name else (0, 0)
            rows.append(own | {"best": best, "best_of": of})
    columns: Columns = {
        "method": lambda row: row["method"],
        "tasks": lambda row: str(row["tasks"]),
        "pairs": lambda row: str(row["pairs"]),
        "P(better)": better_text,
        "IQM": iqm_text,
        "IQM of PPO": lambda row: iqm_text(row, "iqm_baseline"),
        "best on": lambda row: f"{row['best']} of {row['best_of']}" if row["best_of"] else "",
    }
    notes = [
        "IQM: interquartile mean of normalised returns, over the pairs on tasks whose two ends D4RL publishes.",
        "Best on: of the tasks where all five methods of the paper have runs, those where none has a higher mean. The "
        f"paper's is {CLAIMS['best'].words} ({CLAIMS['best'].place}).",
    ]
    return listed("Table 4: against PPO, over the tasks", rows, columns, notes)


def _best(found: Effects, tasks: Sequence[str], arm: str) -> tuple[int, int]:
    """On how many tasks no other method has a higher mean, of how many on which all have runs."""
    means = [[found["last_return", task, each]["mean"] for each in (arm, *FIVE)] for task in tasks]
    whole = [own for own in means if all(value == value for value in own)]
    return sum(own[0] >= max(own) for own in whole), len(whole)


def table5(results: Results, study: Study) -> Table:
    """Early efficiency and final return on four settings, against PPO."""
    early, full = (view(results, study, "table5", part) for part in ("early", "full"))
    area = f"ALC@{study.epochs:g}"
    first = _against_ppo(early, "alc", "Table 5(a)", f"{area}, runs of {early.steps:,} steps", area)
    more = [
        _against_ppo(early, "last_return", "Table 5", f"return after {early.steps:,} steps", "return"),
        _against_ppo(full, "alc", "Table 5(a)", f"{area}, runs of {full.steps:,} steps", area),
        _against_ppo(full, "last_return", "Table 5(b)", f"return after {full.steps:,} steps", "return"),
        _late(full, "Table 5(b)"),
    ]
    notes = [
        READ,
        TESTED,
        OTHER_LOGS,
        "The paper has 3 to 5 seeds; of so few this test gives no p below 0.0625. Its p are shown and not compared.",
        "Learning rates and weights go down over a run's length, so the beginning of a long run is not a short run. "
        "The paper's areas are of long runs.",
    ]
    return dataclasses.replace(first, notes=notes, made=made_by(study, early, full), more=more)


def _against_ppo(runs: View, metric: str, place: str, what: str, head: str) -> Table:
    found, rows = runs.effects(PPO.name, [metric]), []
    for task, logs in runs.settings:
        for arm, labels in runs.arms.items():
            of, change, p = (printed(place, name, task, runs.base(arm)) for name in (metric, "change", "p"))
            if found[metric, task, arm]["n"]:
                given: dict[str, Any] = {"task": task, "logs": logs, "method": arm, "preset": labels["preset"]}
                given |= _paper(*of, change=change.value, p=p.value)
                rows.append(given | found[metric, task, arm])
    columns: Columns = {
        "setting": lambda row: f"{row['task']}, {row['logs']}",
        "method": lambda row: row["method"],
        **(_OF_THE_PAPER if any(row["paper"] == row["paper"] for row in rows) else {}),
        head: mean_text,
        "change over PPO": lambda row: change_text(row, row["pairs"]),
        **TESTS,
    }
    return listed(f"{place}: {what}", rows, columns, words=2)


_OF_THE_PAPER: Columns = {
    "the paper": lambda row: printed_text(row["paper"], row["paper_half_width"]),
    "its change, p": lambda row: _with_p(row["paper_change"], row["paper_p"]),
}


def _late(runs: View, place: str) -> Table:
    """The paper has none: a last evaluation is of five episodes, and what they return may be far apart."""
    return _against_ppo(runs, "late_return", place, f"mean return in the last tenth of {runs.steps:,} steps", "return")


def _with_p(change: float, p: float) -> str:
    return f"{change:+.1%}, {p:g}" if change == change else ""


TABLES: dict[str, Callable[[Results, Study], Table]] = {
    "table4": table4,
    "table5": table5,
    "table6": table6,
    "table7": table7,
    "fig6": fig6,
    "fig7": fig7,
    "fig8": fig8,
    "fig9": fig9,
    "fig10": fig10,
    "fig11": fig11,
    "fig12": fig12,
    "ablation": ablation,
    "coverage": coverage,
    "reliability": reliability,
    "audit": audit,
    "mixed": mixed,
}
"""Name of a study -> its table. The study may hold several, as `all` and `smoke` do."""
