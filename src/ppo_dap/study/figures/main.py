"""Figures 6, 7 and 8: learning curves, the forest plot, return against compute (5.3, 5.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ppo_dap.study.figures import panels
from ppo_dap.study.figures.data import (
    Dot,
    Row,
    absent,
    arms,
    band,
    changes,
    cost_ratios,
    pareto,
    rows_with_cost,
    seeds_in_words,
    tasks,
)
from ppo_dap.study.plots.drawing import (
    GREY,
    Drawn,
    Look,
    family,
    head,
    legend_below,
    looks,
    new_figure,
    percent,
    setting,
    shown,
)
from ppo_dap.study.results import Results
from ppo_dap.study.stats.measures import interquartile_mean
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import PPO

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Panel(NamedTuple):
    """A panel of a forest plot."""

    title: str
    series: Mapping[str, Mapping[str, Dot]]
    """Series -> row -> what stands there."""
    relative: bool = True


def metrics(study: Study, steps: int) -> dict[str, str]:
    """What is compared, in words."""
    return {"alc": f"ALC@{study.epochs:g}", "last_return": f"final return, {steps:,} steps"}


def fig6(results: Results, study: Study) -> Drawn:
    """(a) Episode length and (b) return against environment steps: mean, band or seeds; a row of panels a task."""
    rows = results.rows(study)
    if not rows:
        return {}
    found = [name for name in tasks(study) if any(row["task"] == name for row in rows)]
    names = {arm: shown(labels) for arm, labels in arms(study).items()}
    look = looks(names.values())
    figure = new_figure(0.9 + 2.5 * len(found))
    grid = figure.subplots(len(found), 2, squeeze=False)
    columns = {"length_mean": "(a) episode length", "return_mean": "(b) return of the deterministic policy"}
    for task, line in zip(found, grid, strict=True):
        for (column, title), axes in zip(columns.items(), line, strict=True):
            own = {
                name: [results.curves[row["run"]] for row in rows if (row["label"], row["task"]) == (arm, task)]
                for arm, name in names.items()
            }
            panels.curves(axes, {name: band(runs, column) for name, runs in own.items() if runs}, look)
            axes.set(title=f"{title}, {task}")
    note = f"mean with 95% Student-t interval; a thin line a seed where there are fewer than {panels.SHADED} seeds"
    head(figure, study.title, absent(study, rows), note)
    # The number of seeds may differ from task to task: it stands in the first panel's legend for the first task alone.
    for axes in grid[:, 0] if len(found) > 1 else ():
        axes.legend(fontsize=6)
    if len(found) == 1:
        legend_below(figure, grid[0, 0], 2)
    return {"fig6": figure}


def fig7(results: Results, study: Study) -> Drawn:
    """Change over |PPO| with the interval of paired differences: (a) ALC@40 a setting, (b) final return a task."""
    parts = {"alc": results.rows(study, part="early"), "last_return": results.rows(study, part="full")}
    found = []
    for letter, (metric, rows) in zip("ab", parts.items(), strict=True):
        series = {
            arm: {setting(tasks(study)[task]): dot for task, dot in changes(rows, arm, PPO.name, metric).items()}
            for arm in arms(study)
            if arm != PPO.name
        }
        title = metrics(study, rows[0]["steps"] if rows else 0)[metric]
        found.append(Panel(f"({letter}) {title}", {arm: own for arm, own in series.items() if own}))
    found = [panel for panel in found if panel.series]
    if not found:
        return {}
    order = [setting(labels) for labels in tasks(study).values()]
    note = "change over |PPO|, paired by seed, with 95% bootstrap interval; small points: a seed each"
    missing = absent(study, parts["alc"] + parts["last_return"])
    return {"fig7": forest(found, order, study.title, missing, note, shared=False)}


def forest(
    found: Sequence[Panel], order: Sequence[str], title: str, missing: Sequence[str], note: str, *, shared: bool
) -> Figure:
    """A figure of forest plots side by side; with `shared` they have the same rows, named once."""
    series = list(dict.fromkeys(name for panel in found for name in panel.series))
    look = looks(series)
    rows = [[name for name in order if any(name in own for own in p.series.values())] for p in found]
    if shared:
        rows = [[name for name in order if any(name in own for own in rows)]] * len(found)
    lines = max(len(own) * max(len(panel.series), 1) for own, panel in zip(rows, found, strict=True))
    labels = max(sum(0.04 + 0.16 * (1 + name.count("\n")) for name in own) for own in rows)
    figure = new_figure(1.3 + max(0.13 * lines, labels))
    grid = figure.subplots(1, len(found), squeeze=False)[0]
    for number, (axes, panel, own) in enumerate(zip(grid, found, rows, strict=True)):
        panels.dots(axes, own, panel.series, look, relative=panel.relative)
        axes.set_title(panel.title)
        if shared and number:
            axes.tick_params(labelleft=False)
    head(figure, title, missing, note)
    if len(series) > 1:
        widest = max(range(len(found)), key=lambda i: len(found[i].series))
        legend_below(figure, grid[widest])
    return figure


def fig8(results: Results, study: Study) -> Drawn:
    """Change of the return over |PPO| against wall-clock over PPO's, a mark a method and the Pareto envelope."""
    rows = rows_with_cost(results, study)
    labels = {arm: labels for arm, labels in arms(study).items() if any(row["label"] == arm for row in rows)}
    look = _by_family(labels)
    drawn = []
    for metric in ("last_return", "alc"):
        found = {arm: _tasks_of(rows, arm, metric) for arm in labels if arm != PPO.name}
        found = {arm: own for arm, own in found.items() if own}
        if found:
            drawn.append((metric, found))
    if not drawn:
        return {}
    figure = new_figure(3.9)
    grid = figure.subplots(1, len(drawn), squeeze=False)[0]
    counts: list[Dot] = []
    for letter, axes, (metric, found) in zip("ab", grid, drawn, strict=False):
        common = [task for task in tasks(study) if all(task in own for own in found.values())]
        counts += [dot for own in found.values() for dot, _ in own.values()]
        _trade_off(axes, found, common, look)
        what = metrics(study, rows[0]["steps"])[metric]
        axes.set_title(f"({letter}) {what}: {common[0] if len(common) == 1 else f'{len(common)} tasks'}")
    note = (
        "large: mean cost and interquartile mean of the change over the tasks that all methods have; small: each "
        f"task, {seeds_in_words(counts)} pairs; line: Pareto envelope"
    )
    head(figure, "Return against compute", absent(study, rows), note)
    legend_below(figure, grid[0], 4)
    return {"fig8": figure}


def _by_family(labels: Mapping[str, Row]) -> dict[str, Look]:
    """Colour and mark by the method, hollow in preset `paper` unless it has no other."""
    families = looks(dict.fromkeys(family(own) for own in labels.values()))
    return {arm: families[family(own)]._replace(filled=own["preset"] != "paper") for arm, own in labels.items()}


def _tasks_of(rows: Sequence[Row], arm: str, metric: str) -> dict[str, tuple[Dot, Dot]]:
    """Task -> cost and change of an arm."""
    costs, gains = cost_ratios(rows, arm, PPO.name), changes(rows, arm, PPO.name, metric)
    return {task: (costs[task], gains[task]) for task in costs if task in gains}


def _trade_off(
    axes: Axes,
    found: Mapping[str, Mapping[str, tuple[Dot, Dot]]],
    common: Sequence[str],
    look: Mapping[str, Look],
) -> None:
    """A panel of Fig. 8. Without a task that all methods have there are the small marks alone."""
    for arm, own in found.items():
        costs, gains = ([pair[side].value for pair in own.values()] for side in (0, 1))
        axes.plot(costs, gains, linestyle="none", alpha=0.45, zorder=2, **look[arm].point(3.0))
    if common:
        points = {PPO.name: (1.0, 0.0)}
        for arm, own in found.items():
            cost = sum(own[task][0].value for task in common) / len(common)
            points[arm] = (cost, interquartile_mean([own[task][1].value for task in common]))
        for arm, point in points.items():
            axes.plot(*point, linestyle="none", label=arm, zorder=4, **look[arm].point(7.5))
        envelope = [points[arm] for arm in pareto(points)]
        end = max(cost for cost, _ in points.values())
        steps = [*envelope, (end, envelope[-1][1])]
        axes.step(*zip(*steps, strict=True), where="post", color=GREY, linewidth=1, zorder=3, label="envelope")
    axes.axhline(0, color=GREY, linewidth=0.6, linestyle=":")
    axes.set(xlabel="wall-clock / PPO's", ylabel="change over |PPO|")
    percent(axes, "y")
