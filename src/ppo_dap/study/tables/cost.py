"""Tables 6 and 7 and Fig. 8: what PPO-DAP costs, beside what it gains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import NO_PET, NO_VG, PPO
from ppo_dap.study.tables.effects import COSTS, SHARES, Effects, View, across, made_by, view
from ppo_dap.study.tables.paper import printed
from ppo_dap.study.tables.table import (
    OTHER_LOGS,
    READ,
    WALL,
    Columns,
    Row,
    Table,
    across_text,
    change_text,
    iqm_text,
    listed,
    mean_text,
    over_text,
    printed_text,
    ratio_text,
)

PRESETS = ("paper", "tuned")
MEMORY = "Peak memory is that of the process; the paper's is the GPU's."
SPREAD = "±: standard deviation over the tasks; on each task the median of the ratios of pairs of seeds."


class _Measure(NamedTuple):
    name: str
    metric: str
    over: str
    """The arm that it is relative to, or none."""
    text: Callable[[Row], str]
    form: str
    """Of the paper's number."""


def table6(results: Results, study: Study) -> Table:
    """What PET costs over No-PET, and what it gains over PPO and over No-PET."""
    runs = view(results, study, "table6")
    final, area = f"return after {runs.steps:,} steps", f"ALC@{study.epochs:g}"
    measures = [
        _Measure("wall-clock x No-PET", "seconds_per_step", NO_PET.name, ratio_text, ".2f"),
        _Measure("steps per second x No-PET", "steps_per_second", NO_PET.name, ratio_text, ".2f"),
        _Measure("peak memory x No-PET", "peak_mib", NO_PET.name, ratio_text, ".2f"),
        _Measure(final, "last_return", "", mean_text, ",g"),
        _Measure(f"{final}: change over PPO", "last_return", PPO.name, change_text, "+.1%"),
        _Measure(f"{final}: change over No-PET", "last_return", NO_PET.name, change_text, "+.1%"),
        _Measure(area, "alc", "", mean_text, ",g"),
        _Measure(f"{area}: change over PPO", "alc", PPO.name, change_text, "+.1%"),
        _Measure(f"{area}: change over No-PET", "alc", NO_PET.name, change_text, "+.1%"),
    ]
    (setting, *_), lines, rows = runs.settings, [], []
    by_f = sorted(runs.arms, key=lambda arm: runs.arms[arm].get("f", -1))
    for measure, found in zip(measures, _found(runs, measures), strict=True):
        for base in dict.fromkeys(map(runs.base, by_f)):
            if not measure.over or base not in (PPO.name, measure.over):
                name = f"{measure.metric} over {measure.over}" if measure.form == "+.1%" else measure.metric
                of = printed("Table 6", name, setting[0], base)
                own = [found[preset][measure.metric, setting[0], runs.named(base, preset)] for preset in PRESETS]
                lines.append([measure.name, base, printed_text(*of, measure.form), *map(measure.text, own)])
                told = {"measure": measure.name, "paper": of.value, "paper_half_width": of.spread}
                rows += [told | row for row in own if row["n"]]
    columns = ["measure", "setting", "the paper", *(f"ours, `{preset}`" for preset in PRESETS)]
    lines, notes = lines if runs.rows else [], [READ, WALL, MEMORY, OTHER_LOGS]
    return Table(f"Table 6: PET on {', '.join(setting)}", columns, lines, rows, notes, 2, made_by(study, runs))


def _found(runs: View, measures: list[_Measure]) -> Iterator[dict[str, Effects]]:
    """By preset, each measure against what it is relative to in the same preset; PPO has one."""
    metrics = [*COSTS, "last_return", "alc"]
    by_ppo = runs.effects(PPO.name, metrics)
    by_frozen = {preset: runs.effects(runs.named(NO_PET.name, preset), metrics) for preset in PRESETS}
    for measure in measures:
        yield by_frozen if measure.over == NO_PET.name else dict.fromkeys(PRESETS, by_ppo)


def table7(results: Results, study: Study) -> Table:
    """Costs x PPO over eight tasks, and wall-clock on each."""
    runs = view(results, study, "table7")
    found = runs.effects(PPO.name, [*COSTS, *SHARES])
    lines, rows = [], []
    for arm in sorted(runs.arms, key=lambda arm: list(map(runs.base, runs.arms)).index(runs.base(arm))):
        base, preset = runs.base(arm), runs.arms[arm]["preset"]
        if preset == PPO.preset:
            lines += [_paper_line(base, base)]
            lines += [_paper_line(base, "Diffusion-NoVG")] if base == NO_VG.name else []
        own = {name: across(_of_ppo(found[name, task, arm]) for task in runs.tasks) for name in COSTS}
        own |= {name: across(found[name, task, arm]["mean"] for task in runs.tasks) for name in SHARES}
        tasks = sum(bool(found["seconds_per_step", task, arm]["n"]) for task in runs.tasks)
        if tasks:
            costs = [across_text(*own[name], ".2f", tasks) for name in COSTS]
            shares = [across_text(*own[name], ".1%", tasks) for name in SHARES]
            runs_of = len(runs.runs(arm))
            lines.append([base, f"ours, `{preset}`", str(tasks), str(runs_of), *costs, *shares])
            row = {"method": arm, "preset": preset, "tasks": tasks, "runs": runs_of}
            for name, (mean, deviation, _) in own.items():
                row |= {name: mean, f"{name}_deviation": deviation}
            rows.append(row)
    columns = ["method", "whose", "tasks", "runs", "steps per second x PPO", "wall-clock x PPO", "peak memory x PPO"]
    notes = [
        SPREAD,
        WALL,
        MEMORY,
        "Sampling, PET: the device's seconds at proposals and at PET over the wall-clock. They go by beside the "
        "environments, so wall-clock rises by less. Diffusion-NoVG is No-VG under another name.",
    ]
    columns, more = [*columns, "sampling", "PET"], [_by_task(runs, found)] if rows else []
    lines, made = lines if rows else [], made_by(study, runs)
    return Table("Table 7: cost over the tasks", columns, lines, rows, notes, 2, made, more)


def _of_ppo(row: Row) -> float:
    """A cost over PPO's; PPO's own is 1 where it is known."""
    return row["ratio"] if row["pairs"] or not row["n"] or row["method"] != row["baseline"] else 1.0


def _paper_line(base: str, name: str) -> list[str]:
    whose = "the paper" if base == name else f"the paper, as {name}"
    numbers = [printed_text(*printed("Table 7", cost, "", name), ".2f") for cost in COSTS]
    return [base, whose, "8", "", *numbers, "", ""]


def _by_task(runs: View, found: Effects) -> Table:
    lines, rows = [], []
    for arm in runs.arms:
        own = [found["seconds_per_step", task, arm] for task in runs.tasks]
        if any(row["pairs"] for row in own):
            lines.append([arm, *map(ratio_text, own)])
            every = (found[metric, task, arm] for metric in COSTS for task in runs.tasks)
            rows += [row for row in every if row["n"]]
    return Table("Table 7: wall-clock x PPO by task", ["method", *runs.tasks], lines, rows, [READ])


def fig8(results: Results, study: Study) -> Table:
    """Wall-clock over PPO beside what is gained over PPO."""
    runs = view(results, study, "fig8")
    found = runs.effects(PPO.name, ["seconds_per_step"])
    over, records = runs.over(PPO.name, ["alc", "last_return"]), []
    for arm in runs.arms:
        wall, deviation, tasks = across(found["seconds_per_step", task, arm]["ratio"] for task in runs.tasks)
        if tasks:
            record = {"method": arm, "tasks": tasks, "wall": wall, "wall_deviation": deviation}
            records.append(record | {metric: over[metric, arm] for metric in ("alc", "last_return")})

    columns: Columns = {
        "method": lambda row: row["method"],
        "tasks": lambda row: str(row["tasks"]),
        "wall-clock x PPO": lambda row: printed_text(row["wall"], row["wall_deviation"], ".2f"),
        f"ALC@{study.epochs:g}: P(better than PPO)": lambda row: over_text(row["alc"]),
        f"return after {runs.steps:,} steps: P(better than PPO)": lambda row: over_text(row["last_return"]),
        "its IQM": lambda row: iqm_text(row["last_return"]),
        "PPO's": lambda row: iqm_text(row["last_return"], "iqm_baseline"),
    }
    notes = [SPREAD, WALL, "IQM: interquartile mean of normalised returns, of the tasks whose two ends D4RL publishes."]
    return listed("Fig. 8: return against compute", records, columns, notes, made=made_by(study, runs))
