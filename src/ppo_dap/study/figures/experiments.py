"""Figures of 5.5 (factorised ablations), 5.7, 5.8 and of the logs of several gaits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from ppo_dap.study.figures import panels
from ppo_dap.study.figures.data import Dot, Row, absent, arms, changes, of_runs, tasks
from ppo_dap.study.figures.main import Panel, forest, metrics
from ppo_dap.study.plots.drawing import GREY, Drawn, family, head, legend_below, looks, new_figure, setting, shown
from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import PPO, TUNED_WARM

WHOLE = TUNED_WARM.name
PART = f"{WHOLE}: "


def mixed(results: Results, study: Study) -> Drawn:
    """Two figures: ALC and final return of every method, and what `tuned-warm` changes without each of its parts."""
    rows = results.rows(study, part="early")
    methods = {arm: shown(own) for arm, own in arms(study).items() if not arm.startswith(PART)}
    parts = {arm: arm.removeprefix(PART) for arm in arms(study) if arm.startswith(PART)}
    found: Drawn = {}
    there = [row for row in rows if row["label"] in methods]
    if there:
        title = "Logs of several gaits: every method"
        note = "mean with 95% Student-t interval from 3 seeds on; small points: a seed each"
        own = _panels(study, there, lambda task, metric: _means(there, methods, task, metric), False)
        missing = [arm for arm in absent(study, rows) if arm in methods]
        found["mixed-methods"] = forest(own, list(methods.values()), title, missing, note, shared=True)
    changed = {arm: {metric: changes(rows, arm, WHOLE, metric) for metric in METRICS} for arm in parts}
    if any(by for own in changed.values() for by in own.values()):

        def change(task: str, metric: str) -> dict[str, Dot]:
            return {parts[arm]: own[metric][task] for arm, own in changed.items() if task in own[metric]}

        title = f"Logs of several gaits: {WHOLE} without a part, or with one more"
        note = "change over the whole, paired by seed, with 95% bootstrap interval; small points: a seed each"
        missing = [parts[arm] for arm in absent(study, rows) if arm in parts]
        order = list(parts.values())
        found["mixed-parts"] = forest(_panels(study, rows, change, True), order, title, missing, note, shared=True)
    return found


METRICS = ("alc", "last_return")


def _panels(
    study: Study, rows: Sequence[Row], values: Callable[[str, str], Mapping[str, Dot]], relative: bool
) -> list[Panel]:
    """A panel a task and metric that has values."""
    what = metrics(study, rows[0]["steps"])
    found = []
    for metric in METRICS:
        for task in tasks(study):
            own = values(task, metric)
            if own:
                name, words = task.rpartition("-")[0] or task, what[metric].replace(", ", ",\n")
                found.append(Panel(f"{name}: {words}", {"change" if relative else "mean": own}, relative))
    return found


def _means(rows: Sequence[Row], names: Mapping[str, str], task: str, metric: str) -> dict[str, Dot]:
    """Arm, as it is shown -> mean of its runs."""
    own = {
        name: of_runs(row[metric] for row in rows if (row["task"], row["label"]) == (task, arm))
        for arm, name in names.items()
    }
    return {name: dot for name, dot in own.items() if dot}


def ablation(results: Results, study: Study) -> Drawn:
    """Two figures, ALC and final return: change over |PPO| of each configuration, a panel a setting."""
    rows = results.rows(study)
    configurations = {arm: own for arm, own in arms(study).items() if arm != PPO.name}
    found: Drawn = {}
    for metric in METRICS:
        by_arm = {arm: changes(rows, arm, PPO.name, metric) for arm in configurations}
        panels_of_tasks = []
        for task, labels in tasks(study).items():
            series: dict[str, dict[str, Dot]] = {}
            for arm, own in configurations.items():
                if task in by_arm[arm]:
                    series.setdefault(f"preset {own['preset']}", {})[family(own)] = by_arm[arm][task]
            if series:
                panels_of_tasks.append(Panel(setting(labels), series))
        if panels_of_tasks:
            order = _factors(configurations)
            what = metrics(study, rows[0]["steps"])[metric]
            title = f"Prior / guidance / PET frequency, and the controls of Table 3: {what}"
            note = "change over |PPO|, paired by seed, with 95% bootstrap interval; small points: a seed each"
            name = {"alc": "ablation-alc", "last_return": "ablation-final"}[metric]
            found[name] = forest(panels_of_tasks, order, title, absent(study, rows), note, shared=True)
    return found


def _factors(configurations: Mapping[str, Row]) -> list[str]:
    """Arms without their preset, in the study's order, those of one prior and guidance by PET frequency."""
    groups = list(dict.fromkeys((own.get("prior", arm), own.get("guidance")) for arm, own in configurations.items()))

    def place(arm: str) -> tuple[int, int]:
        own = configurations[arm]
        return groups.index((own.get("prior", arm), own.get("guidance"))), own.get("f", 0)

    return list(dict.fromkeys(family(configurations[arm]) for arm in sorted(configurations, key=place)))


RELIABILITY: tuple[tuple[str, str, Callable[[Row], float | None]], ...] = (
    ("rho", "(a) rho within states", lambda row: row.get("q.proposals.rho")),
    ("ece", "(b) ECE, as it is", lambda row: row.get("calibration.as it is.ece")),
    ("affine", "(c) ECE, affine map", lambda row: row.get("calibration.affine.ece")),
    ("gain", "(d) return gained", lambda row: _gain(row)),
)
CEILING = "what the true Q would reach"


def _gain(report: Row) -> float | None:
    guided, free = report.get("returns.reweighted"), report.get("returns.unguided")
    return None if guided is None or free is None else guided - free


def reliability(results: Results, study: Study) -> Drawn:
    """Rank correlation within states beside its ceiling, calibration error, and what guidance adds in real return."""
    found = [
        e.labels | results.reports[e.cell.name]
        for e in study.entries
        if e.cell.kind == "reliability" and e.cell.name in results.reports
    ]
    if not found:
        return {}
    labels = {task: setting(own) for task, own in tasks(study).items() if any(row["task"] == task for row in found)}
    there = {row["arm"] for row in found}
    series = [arm for arm in arms(study) if arm in there]
    figure = new_figure(1.6 + 0.75 * len(labels))
    grid = figure.subplots(1, 4)
    look = looks([*series, CEILING])
    look[CEILING] = look[CEILING]._replace(colour=GREY, mark="d")
    for number, (axes, (name, title, value)) in enumerate(zip(grid, RELIABILITY, strict=True)):
        values = {arm: _by_setting(found, labels, arm, value) for arm in series}
        if name == "rho":
            ceiling = _by_setting(found, labels, None, lambda row: row.get("rank_ceiling.proposals"))
            values[CEILING] = {name: Dot(dot.value, math.nan, math.nan, {}, dot.n) for name, dot in ceiling.items()}
        panels.dots(axes, list(labels.values()), values, look, relative=False, counts=name == "gain")
        axes.set_title(title)
        axes.tick_params(labelleft=number == 0)
        if name in ("rho", "gain"):
            axes.axvline(0, color=GREY, linewidth=1, zorder=1)
    for axes in grid[1:3]:
        high = max(a.get_xlim()[1] for a in grid[1:3])
        axes.set_xlim(0, high)
    missing = [arm for arm in arms(study) if arm not in there]
    note = (
        "rho: of Q and Monte-Carlo return among a state's proposals; ECE: in Q's units, on states that the map was not "
        "fitted to; return gained: of reweighted proposals less that of unguided ones; mean of the runs with 95% "
        "Student-t interval from 3 on; small points: a run each"
    )
    head(figure, "How far Q can be trusted (5.7)", missing, note)
    legend_below(figure, grid[0], 3)
    return {"reliability": figure}


def _by_setting(
    found: Sequence[Row], labels: Mapping[str, str], arm: str | None, value: Callable[[Row], float | None]
) -> dict[str, Dot]:
    own = {
        name: of_runs(value(row) for row in found if row["task"] == task and arm in (None, row["arm"]))
        for task, name in labels.items()
    }
    return {name: dot for name, dot in own.items() if dot}


DIVERGENCES = {
    "policy-KL, of an update": "policy_kl",
    "prior-KL, of its PET": "prior_kl",
    "KL of the policy to its proposals": "kl_to_prior",
}
AUDIT = {
    "pgshare": ("(b) PGShare", min),
    "spr": ("(c) SPR", min),
    "oglr": ("(d) OGLR", max),
    "batch_fresh": ("(e) fresh rows", min),
}
"""Measure -> title, and which of several runs is the worst."""


def audit(results: Results, study: Study) -> Drawn:
    """Policy-KL beside prior-KL on one axis, and the worst iteration of each measure of the audit; a row a method."""
    rows = results.rows(study)
    if not rows:
        return {}
    names = {arm: shown(own) for arm, own in arms(study).items() if any(row["label"] == arm for row in rows)}
    figure = new_figure(1.5 + 0.36 * len(names))
    grid = figure.subplots(1, 1 + len(AUDIT), width_ratios=(2.6, *[1] * len(AUDIT)))
    divergences = {what: _worst(rows, names, measure, None) for what, measure in DIVERGENCES.items()}
    panels.dots(grid[0], list(names.values()), divergences, looks(divergences), relative=False, counts=False)
    grid[0].set(title="(a) divergences", xscale="log")
    for axes, (measure, (title, worst)) in zip(grid[1:], AUDIT.items(), strict=True):
        found = _worst(rows, names, measure, worst)
        panels.dots(
            axes,
            list(names.values()),
            {"worst": found},
            looks(["worst"]),
            relative=False,
            counts=measure == "batch_fresh",
        )
        axes.set_title(title)
        axes.tick_params(labelleft=False)
        axes.locator_params(axis="x", nbins=3)
        values = [value for dot in found.values() for value in dot.each[""]] or [0.0]
        low, high = (-0.1, max(values)) if measure == "oglr" else (min(values), 1.0)
        axes.set_xlim(low - 0.1, max(1.0, high) + 0.1)
    note = (
        "(a) means over a run's iterations, large: over all runs; (b) to (e): the worst iteration, large: of all runs; "
        "small points: a run each; fresh rows: share of the update's rows that its own policy collected"
    )
    head(figure, "The audit (5.8): divergences, and the worst of each measure", absent(study, rows), note)
    legend_below(figure, grid[0], 3)
    return {"audit": figure}


def _worst(
    rows: Sequence[Row], names: Mapping[str, str], measure: str, worst: Callable[[Sequence[float]], float] | None
) -> dict[str, Dot]:
    """Arm, as it is shown -> the worst of its runs. Without `worst` their mean; 0 has then no place on the axis."""
    found = {}
    for arm, name in names.items():
        values = [row[measure] for row in rows if row["label"] == arm and row[measure] is not None]
        values = values if worst else [value for value in values if value > 0]
        dot = of_runs(values)
        if dot:
            found[name] = dot._replace(value=worst(values) if worst else dot.value, low=math.nan, high=math.nan)
    return found
