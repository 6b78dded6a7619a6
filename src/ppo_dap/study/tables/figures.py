"""The numbers behind figures 6, 7, 9, 10 and 11, where a reader wants them."""

from __future__ import annotations

from collections.abc import Callable

from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import DAP, NO_PET, PPO, TUNED, TUNED_WARM
from ppo_dap.study.tables.effects import NOTHING, made_by, view
from ppo_dap.study.tables.paper import CLAIMS, printed, printed_change
from ppo_dap.study.tables.table import (
    READ,
    WALL,
    Columns,
    Row,
    Table,
    change_text,
    difference_text,
    listed,
    mean_text,
    number,
    ratio_text,
)


def fig6(results: Results, study: Study) -> Table:
    """Where the learning curves of Walker2d end, and how long the episodes are there."""
    runs = view(results, study, "fig6")
    found = runs.effects(PPO.name, ["alc", "last_return", "last_length"])
    columns: Columns = {
        "method": lambda row: row["method"],
        f"ALC@{study.epochs:g}": lambda row: mean_text(row["alc"]),
        f"return after {runs.steps:,} steps": lambda row: mean_text(row["last_return"]),
        "episode length": lambda row: mean_text(row["last_length"]),
    }
    records = []
    for task in runs.tasks:
        for arm in runs.arms:
            if runs.runs(arm, task):
                own = {metric: found[metric, task, arm] for metric in ("alc", "last_return", "last_length")}
                records.append({"method": arm, **own})
    title = f"Fig. 6: learning curves, {', '.join(runs.settings[0])}"
    return listed(title, records, columns, [READ], made=made_by(study, runs))


def fig7(results: Results, study: Study) -> Table:
    """Change over PPO: area on Table 5's settings, final return on all tasks."""
    parts = [("early", "alc"), ("full", "last_return")]
    views = [view(results, study, "fig7", part) for part, _ in parts]
    records: list[Row] = []
    names = (DAP.name, TUNED.name, TUNED_WARM.name)
    for runs, (part, metric) in zip(views, parts, strict=True):
        found = runs.effects(PPO.name, [metric])
        name = f"ALC@{study.epochs:g}" if metric == "alc" else f"return after {runs.steps:,} steps"
        for task, logs in runs.settings:
            of = printed("Table 5(a)", "change", task, DAP.name).value if part == "early" else None
            record: Row = {"task": task, "logs": logs, "what": name} | {arm: found[metric, task, arm] for arm in names}
            if any(record[arm]["pairs"] for arm in names):
                records.append(record | {"paper": printed_change(task, DAP.name) if of is None else of})

    def change(arm: str) -> Callable[[Row], str]:
        return lambda row: change_text(row[arm])

    columns: Columns = {
        "measure": lambda row: row["what"],
        "setting": lambda row: f"{row['task']}, {row['logs']}",
        "the paper": lambda row: number(row["paper"], "+.1%"),
        **{arm: change(arm) for arm in names},
    }
    notes = [READ, "The paper's: of Table 5(a), and of Table 4's means. Over |PPO|."]
    return listed("Fig. 7: change over PPO", records, columns, notes, 2, made_by(study, *views))


def fig9(results: Results, study: Study) -> Table:
    """Returns, gains over PPO and cost by the number of proposals, and by the share of states that have some."""
    runs = view(results, study, "fig9")
    found = runs.effects(PPO.name, ["alc", "last_return", "seconds_per_step"])
    axes = {arm: ("share" in labels, labels.get("share", labels.get("K"))) for arm, labels in runs.arms.items()}
    arms = sorted((arm for arm in axes if arm != PPO.name), key=axes.__getitem__)
    records = []
    for task, logs in runs.settings:
        for arm in arms:
            if runs.runs(arm, task):
                own = {metric: found[metric, task, arm] for metric in ("alc", "last_return", "seconds_per_step")}
                labels = {"task": task, "logs": logs, "method": arm, "preset": runs.arms[arm]["preset"]}
                records.append(labels | {"of": runs.base(arm)} | own)
    columns: Columns = {
        "setting": lambda row: f"{row['task']}, {row['logs']}",
        "budget": lambda row: row["of"],
        "preset": lambda row: row["preset"],
        f"ALC@{study.epochs:g}": lambda row: mean_text(row["alc"]),
        f"ALC@{study.epochs:g}: change over PPO": lambda row: change_text(row["alc"]),
        f"return after {runs.steps:,} steps": lambda row: mean_text(row["last_return"]),
        f"return after {runs.steps:,} steps: change over PPO": lambda row: change_text(row["last_return"]),
        "wall-clock x PPO": lambda row: ratio_text(row["seconds_per_step"]),
    }
    paper = "more of either speeds Hopper and Walker2d up and lets HalfCheetah end higher; very large K varies more"
    notes = [READ, WALL, "K=10 and share=0.2 are PPO-DAP itself.", f"The paper (5.5 (1), Fig. 9), no numbers: {paper}."]
    return listed("Fig. 9: proposal budget", records, columns, notes, 3, made_by(study, runs))


def fig10(results: Results, study: Study) -> Table:
    """Returns by PET's frequency, and their difference to those without PET."""
    runs = view(results, study, "fig10")
    by_ppo = runs.effects(PPO.name, ["alc", "last_return"])
    claim, records = CLAIMS["shift"], []
    ((task, logs),) = runs.settings
    for arm in sorted(runs.arms, key=lambda arm: (runs.arms[arm]["preset"], runs.arms[arm].get("f", -1))):
        preset = runs.arms[arm]["preset"]
        frozen = runs.named(NO_PET.name, preset)
        if runs.runs(arm):
            own = {metric: by_ppo[metric, task, arm] for metric in ("alc", "last_return")}
            if arm not in (PPO.name, frozen):
                own["over No-PET"] = runs.effects(frozen, ["last_return"], [arm, frozen])["last_return", task, arm]
            records.append({"method": arm, "of": runs.base(arm), "preset": preset} | own)
    columns: Columns = {
        "setting": lambda row: row["of"],
        "preset": lambda row: row["preset"],
        f"ALC@{study.epochs:g}": lambda row: mean_text(row["alc"]),
        f"return after {runs.steps:,} steps": lambda row: mean_text(row["last_return"]),
        "change over PPO": lambda row: change_text(row["last_return"]),
        "difference to No-PET": lambda row: difference_text(row.get("over No-PET", NOTHING)),
    }
    notes = [READ, "Differences are paired by seed.", f"The paper ({claim.place}): {claim.words}."]
    return listed(f"Fig. 10: PET frequency, {task}, {logs}", records, columns, notes, 2, made_by(study, runs))


def fig11(results: Results, study: Study) -> Table:
    """What proposals are like over the runs that Fig. 11 takes its checkpoint from."""
    runs = view(results, study, "fig11")
    shown = {
        "high-Q rate": ("high_q_rate", ".2f"),
        "ESS": ("ess", ".1f"),
        "acceptance": ("acceptance", ".2f"),
        "guided displacement": ("guided_displacement", ".2f"),
        "rank of Q": ("q_rank", ".2f"),
    }
    found, records = runs.effects("", [name for name, _ in shown.values()]), []
    for arm in runs.arms:
        if runs.runs(arm):
            own = {name: found[name, runs.tasks[0], arm] for name, _ in shown.values()}
            records.append({"method": arm, **own})

    def mean(name: str, form: str) -> Callable[[Row], str]:
        return lambda row: mean_text(row[name], form)

    columns: Columns = {"method": lambda row: row["method"]} | {
        head: mean(name, form) for head, (name, form) in shown.items()
    }
    claim = CLAIMS["high_q"]
    notes = [
        READ,
        "Means over a run's iterations. High-Q rate: share of the proposals at or above the 90th percentile of Q over "
        "their state's candidates, a tenth before they are drawn by weight.",
        f"The paper ({claim.place}): {claim.words}. Study reliability holds guided candidates against unguided ones.",
    ]
    title = f"Fig. 11: proposals, {', '.join(runs.settings[0])}"
    return listed(title, records, columns, notes, made=made_by(study, runs))
