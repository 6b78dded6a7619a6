"""Figures 9, 10 and 12, and 5.6's mitigations: proposals, PET frequency, coverage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ppo_dap.study.figures import panels
from ppo_dap.study.figures.data import (
    Dot,
    Row,
    absent,
    arms,
    band,
    changes,
    cost_ratios,
    mean_over_tasks,
    of_runs,
    rows_with_cost,
    seeds_in_words,
    tasks,
)
from ppo_dap.study.figures.main import metrics
from ppo_dap.study.plots.drawing import (
    MARKS,
    PRESETS,
    Drawn,
    family,
    head,
    legend_below,
    looks,
    new_figure,
    percent,
    setting,
)
from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import PPO

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KNOBS = {"K": "proposals a state, K", "share": "share of states with proposals"}


def fig9(results: Results, study: Study) -> Drawn:
    """Gains over PPO and cost against K and against the share of states that get proposals; a line a setting."""
    rows = rows_with_cost(results, study)
    measures = {**metrics(study, rows[0]["steps"] if rows else 0), "seconds_per_step": "wall-clock / PPO's"}
    found = {knob: {metric: _by_value(rows, study, knob, metric) for metric in measures} for knob in KNOBS}
    dots = [d for by in found.values() for series in by.values() for own in series.values() for d in own.values()]
    if not dots:
        return {}
    look = {
        f"{setting(labels, ' ')}, {preset}": looks(tasks(study))[task]._replace(dash=dash, filled=filled)
        for task, labels in tasks(study).items()
        for preset, dash, filled in (("paper", "--", False), ("tuned", "-", True))
    }
    figure = new_figure(6.4)
    grid = figure.subplots(len(measures), len(KNOBS), sharey="row")
    for column, (knob, label) in enumerate(KNOBS.items()):
        values = sorted({own[knob] for own in arms(study).values() if knob in own})
        for line, (metric, what) in zip(grid, measures.items(), strict=True):
            cost = metric == "seconds_per_step"
            panels.trends(line[column], [f"{v:g}" for v in values], found[knob][metric], look, baseline=float(cost))
            if column == 0:
                line[column].set_ylabel(what if cost else f"{what}\nchange over |PPO|")
        grid[-1, column].set_xlabel(label)
    for axes in grid[:-1].flat:
        percent(axes, "y")
    note = f"{seeds_in_words(dots)} pairs of seeds a mark, 95% bootstrap interval; small points: a seed each"
    head(figure, study.title, absent(study, rows), note)
    widest = max(grid.flat, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    legend_below(figure, widest, 3)
    return {"fig9": figure}


def _by_value(rows: Sequence[Row], study: Study, knob: str, metric: str) -> dict[str, dict[str, Dot]]:
    """Setting and preset -> value of the knob -> change, or cost for `wall`, against PPO."""
    found: dict[str, dict[str, Dot]] = {}
    for task, where in tasks(study).items():
        for arm, labels in arms(study).items():
            if knob not in labels:
                continue
            of_tasks = (
                cost_ratios(rows, arm, PPO.name)
                if metric == "seconds_per_step"
                else changes(rows, arm, PPO.name, metric)
            )
            if task in of_tasks:
                series = found.setdefault(f"{setting(where, ' ')}, {labels['preset']}", {})
                series[f"{labels[knob]:g}"] = of_tasks[task]
    return found


def fig10(results: Results, study: Study) -> Drawn:
    """(a) Curves by PET frequency; distribution of (b) final returns and (c) ALC; a row of panels a preset."""
    rows = results.rows(study)
    with_f = sorted((own for own in arms(study).values() if "f" in own), key=lambda own: own["f"])
    by_preset = {}
    for preset in dict.fromkeys(labels["preset"] for labels in with_f):
        named = {PPO.name: PPO.name} | {own["arm"]: f"f = {own['f']}" for own in with_f if own["preset"] == preset}
        own = {name: [row for row in rows if row["label"] == arm] for arm, name in named.items()}
        if any(own[name] for arm, name in named.items() if arm != PPO.name):
            by_preset[preset] = {name: found for name, found in own.items() if found}
    if not by_preset:
        return {}
    figure = new_figure(1.0 + 2.4 * len(by_preset))
    grid = figure.subplots(len(by_preset), 3, squeeze=False, width_ratios=(1.1, 1, 1))
    what = metrics(study, rows[0]["steps"])
    for line, (preset, groups) in zip(grid, by_preset.items(), strict=True):
        look = looks([PPO.name, *(f"f = {own['f']}" for own in with_f if own["preset"] == preset)])
        bands = {name: band([results.curves[row["run"]] for row in own], "return_mean") for name, own in groups.items()}
        panels.curves(line[0], bands, look)
        line[0].set(title="(a) return of the deterministic policy", ylabel=f"preset {preset}")
        for letter, axes, metric in zip("bc", line[1:], ("last_return", "alc"), strict=True):
            found = {name: of_runs(row[metric] for row in own) for name, own in groups.items()}
            panels.distribution(axes, {name: dot for name, dot in found.items() if dot}, look)
            axes.set_title(f"({letter}) {what[metric]}")
    note = (
        "f: PET steps per 100 actor updates, 0 is No-PET; curves: mean with 95% Student-t interval; a mark a run, "
        f"thick line: mean, box: quartiles and range from {panels.BOXED} runs on"
    )
    head(figure, study.title, absent(study, rows), note)
    widest = max(grid[:, 0], key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    handles, names = widest.get_legend_handles_labels()
    figure.legend(handles, [name.partition(" (")[0] for name in names], loc="outside lower center", ncols=5)
    return {"fig10": figure}


def _coverage_measures(
    rows: Sequence[Row], study: Study, levels: Mapping[str, str]
) -> dict[str, dict[str, dict[str, Dot]]]:
    """Measure -> preset -> level -> its mean over the tasks; `levels`: arm -> what it is called."""
    found: dict[str, dict[str, dict[str, Dot]]] = {}
    for metric in ("alc", "last_return", "high_q_rate", "ess"):
        baseline = PPO.name if metric in ("alc", "last_return") else None
        for preset in PRESETS:
            own = {arm: level for arm, level in levels.items() if f"preset {arms(study)[arm]['preset']}" == preset}
            dots = mean_over_tasks(rows, list(own), metric, baseline)
            if dots:
                found.setdefault(metric, {})[preset] = {own[arm]: dot for arm, dot in dots.items()}
    return found


def _coverage_titles(study: Study, steps: int) -> dict[str, str]:
    what = metrics(study, steps)
    return {
        "alc": f"(a) {what['alc']}",
        "last_return": f"(b) {what['last_return']}",
        "high_q_rate": "(c) high-Q hit rate",
        "ess": "(d) ESS of the energy weights",
    }


def fig12(results: Results, study: Study) -> Drawn:
    """Gains in (a) ALC and (b) final return, (c) high-Q hit rate, (d) ESS on wide, medium and narrow logs."""
    return _coverage(results, study, "fig12", {arm: own["coverage"] for arm, own in _levels(study).items()}, True)


def coverage(results: Results, study: Study) -> Drawn:
    """Fig. 12's measures for each mitigation of narrow logs, below the three levels without any."""
    named = {arm: family(own).removeprefix("narrow logs: ") for arm, own in _levels(study).items()}
    return _coverage(results, study, "coverage", named, False)


def _levels(study: Study) -> dict[str, Row]:
    return {arm: own for arm, own in arms(study).items() if "coverage" in own}


def _coverage(results: Results, study: Study, name: str, levels: Mapping[str, str], upright: bool) -> Drawn:
    rows = results.rows(study)
    found = _coverage_measures(rows, study, levels)
    if not found:
        return {}
    names = [n for n in dict.fromkeys(levels.values()) if any(n in own for by in found.values() for own in by.values())]
    figure = new_figure(5.2 if upright else 2.2 + 0.38 * len(names))
    grid = figure.subplots(2, 2) if upright else figure.subplots(1, 4)
    marks = dict(zip(tasks(study), MARKS, strict=False))
    titles = _coverage_titles(study, rows[0]["steps"])
    for number, (axes, (metric, title)) in enumerate(zip(grid.flat, titles.items(), strict=True)):
        gain, series = metric in ("alc", "last_return"), found.get(metric, {})
        if upright:
            panels.trends(axes, names, series, looks(PRESETS), baseline=0.0 if gain else None, marks=marks)
            if gain:
                percent(axes, "y")
                axes.set_ylabel("change over |PPO|")
        else:
            panels.dots(axes, names, series, looks(PRESETS), relative=gain, counts=False, marks=marks)
            axes.tick_params(labelleft=number == 0)
            title = title.replace(", ", ",\n").replace(" energy", "\nenergy").replace(" hit", "\nhit")
        axes.set_title(title)
    dots = [dot for by in found.values() for own in by.values() for dot in own.values()]
    note = (
        f"mean over the tasks that all arms of a preset have, {seeds_in_words(dots)} runs, with 95% bootstrap "
        "interval; small: each task; gains: over |PPO|, paired by seed"
    )
    head(figure, study.title, absent(study, rows), note)
    _legend_of_tasks(figure, grid.flat, marks, {task for dot in dots for task in dot.each}, study)
    return {name: figure}


def _legend_of_tasks(
    figure: Any, panels_: Iterable[Axes], marks: Mapping[str, str], there: set[str], study: Study
) -> None:
    """Presets, and the small mark of each task."""
    from matplotlib.lines import Line2D

    widest = max(panels_, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    handles, names = widest.get_legend_handles_labels()
    for task, labels in tasks(study).items():
        if task in there:
            handles.append(Line2D([], [], linestyle="none", marker=marks[task], color="0.55", ms=4))
            names.append(setting(labels, " "))
    figure.legend(handles, names, loc="outside lower center", ncols=3)
