"""The pictures of the html report: PNG bytes each, without names from the logs in them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.finding import Report
from ppo_dap.logs.jumps import STRONG, Jumps
from ppo_dap.logs.neighbours import Mixture, Neighbours

BLUE, RED, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"  # Okabe and Ito's
DPI = 144
MAX_ACTIONS = 12
MAX_TRACES = 6
WINDOW = 400  # rows of the trajectories shown
MAX_POINTS = 2000


class Picture(NamedTuple):
    """A picture, what it shows and what to look for."""

    title: str
    caption: str
    png: bytes


def draw_all(logs: Logs, report: Report, low: np.ndarray | None, high: np.ndarray | None) -> Iterator[Picture]:
    """Every picture that these logs have something for; bounds are drawn where they are given and fit."""
    bounds = (low, high) if low is not None and high is not None and len(low) == logs.action_size else None
    yield _draw("Lengths and returns of the episodes", _caption_episodes(logs), _episodes, logs)
    shown = min(logs.action_size, MAX_ACTIONS)
    cut = f" The first {shown} of {logs.action_size} are shown." if shown < logs.action_size else ""
    limits = "Dashed red: the action space. " if bounds else ""
    caption = f"{limits}A spike at a bound is saturation; a range far inside the bounds, other units.{cut}"
    yield _draw("Actions, one panel a dimension", caption, _actions, logs, bounds)
    if report.jumps is not None and report.jumps.num_columns:
        caption = (
            "How badly each step breaks the one-step model, over the usual. Above the dotted line a step is a jump if "
            "it stands alone; below it, if it leads back to a start. Red crosses: episode ends that no flag marks."
        )
        yield _draw("Unmarked ends", caption, _mismatch, report.jumps)
    caption = (
        "The observations that vary most, each shifted and scaled to its own lane. Grey lines: marked episode ends; "
        "red dashed lines: ends that no flag marks."
    )
    yield _draw("A stretch of the logs", caption, _trajectories, logs, report.jumps)
    if report.neighbours is not None and len(report.neighbours.rows):
        caption = (
            "For each row, how much the actions of the nearest states in other episodes differ from its own. Near 0 "
            "the state settles the action; a heap at 1 means that it says nothing about it."
        )
        yield _draw("Nearest-neighbour spread of the actions", caption, _spread, report.neighbours)
    if report.mixture is not None:
        caption = (
            "One point an episode: how its actions differ from those of near states in other episodes, in its first "
            "half and in its second, along the direction in which the halves agree most. One policy gives a shapeless "
            "cloud; several, a cloud along the dotted diagonal, or heaps on it."
        )
        yield _draw("Mixture of policies", caption, _mixture, report.mixture)


def _caption_episodes(logs: Logs) -> str:
    text = "Many episodes of exactly the same, greatest length are time limits."
    return text if logs.rewards is None else f"{text} Two heaps of returns are two behaviours."


def _draw(title: str, caption: str, draw: Callable[..., None], *values: Any) -> Picture:
    # The object-oriented interface: nothing of the caller's matplotlib state is touched.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, *values)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": None})
    return Picture(title, caption, content.getvalue())


def _episodes(figure: Any, logs: Logs) -> None:
    values = {"length (rows)": logs.episode_lengths(), "return (sum of rewards)": logs.episode_returns()}
    known = {label: value for label, value in values.items() if value is not None}
    for axes, (label, value) in zip(np.ravel(figure.subplots(1, len(known))), known.items(), strict=True):
        axes.hist(value, bins=min(40, max(5, len(value) // 4)), color=BLUE)
        axes.set(xlabel=f"{label} of an episode", ylabel="episodes")


def _actions(figure: Any, logs: Logs, bounds: tuple[np.ndarray, np.ndarray] | None) -> None:
    count = min(logs.action_size, MAX_ACTIONS)
    across = min(count, 4)
    down = -(-count // across)
    figure.set_size_inches(8, 0.6 + 2.0 * down)
    panels = np.ravel(figure.subplots(down, across, squeeze=False))
    for column, axes in enumerate(panels):
        if column >= count:
            axes.set_visible(False)
            continue
        axes.hist(logs.actions[:, column], bins=60, color=BLUE)
        for bound in bounds or ():
            if np.isfinite(bound[column]):
                axes.axvline(bound[column], color=RED, linestyle="--", linewidth=1.2)
        axes.set(title=f"action {column}", yticks=[])
        axes.title.set_size(9)
    figure.supxlabel("value in the environment's units", fontsize=9)
    figure.supylabel("rows", fontsize=9)


def _mismatch(figure: Any, jumps: Jumps) -> None:
    axes = figure.subplots()
    # The largest of every bin of rows, so that no jump is lost between two points.
    width = -(-len(jumps.mismatch) // MAX_POINTS)
    padded = np.full(width * -(-len(jumps.mismatch) // width), np.nan)
    padded[: len(jumps.mismatch)] = jumps.mismatch
    largest = np.where(np.isnan(padded), 0.0, padded).reshape(-1, width).max(1)
    shown = largest > 0
    axes.semilogy(np.flatnonzero(shown) * width, largest[shown], ".", color=BLUE, markersize=2)
    axes.semilogy(jumps.rows, jumps.mismatch[jumps.rows], "x", color=RED, markersize=6)
    axes.axhline(STRONG, color=GREY, linestyle=":")
    unit = "row" if width == 1 else f"row (a point is the largest of {width} rows)"
    axes.set(xlabel=unit, ylabel="mismatch (times the usual)")


def _trajectories(figure: Any, logs: Logs, jumps: Jumps | None) -> None:
    found = np.zeros(0, np.int64) if jumps is None else jumps.rows
    # Around the first unmarked end; without one, around the first marked end.
    centre = int(found[0]) if len(found) else int(np.flatnonzero(logs.episode_ends)[0])
    start = max(0, min(centre - WINDOW // 2, logs.num_rows - WINDOW))
    rows = np.arange(start, min(start + WINDOW, logs.num_rows))
    values = logs.observations[rows].astype(np.float64)
    low, high = np.percentile(values, [1, 99], axis=0)
    span = np.maximum(high - low, 1e-12)
    usual = np.maximum(logs.observations[:: max(1, logs.num_rows // MAX_POINTS)].std(0), 1e-12)
    chosen = np.sort(np.argsort(-span / usual, kind="stable")[:MAX_TRACES])
    figure.set_size_inches(8, 1.2 + 0.5 * len(chosen))
    axes = figure.subplots()
    inside = np.where(logs.episode_ends[rows][:, None], np.nan, 0.0)
    for lane, column in enumerate(chosen):
        line = np.clip((values[:, column] - low[column]) / span[column], -0.05, 1.05) * 0.85 + lane
        # A gap after an episode's last row: two episodes are not one line.
        broken = np.insert(line, np.flatnonzero(np.isnan(inside[:, 0])) + 1, np.nan)
        where = np.insert(rows.astype(float), np.flatnonzero(np.isnan(inside[:, 0])) + 1, np.nan)
        axes.plot(where, broken, color=BLUE, linewidth=0.9)
    for end in rows[logs.episode_ends[rows]]:
        axes.axvline(end + 0.5, color=GREY, linewidth=0.8)
    for end in found[np.isin(found, rows)]:
        axes.axvline(end + 0.5, color=RED, linestyle="--", linewidth=1.2)
    axes.set(xlabel="row", yticks=np.arange(len(chosen)) + 0.42, yticklabels=[f"obs {column}" for column in chosen])


def _spread(figure: Any, neighbours: Neighbours) -> None:
    axes = figure.subplots()
    axes.hist(np.minimum(neighbours.spread, 2.0), bins=np.linspace(0, 2, 61), color=BLUE)
    mean = float(neighbours.spread.mean())
    axes.axvline(min(mean, 2.0), color=RED, linestyle="--", label=f"mean {mean:.2f}")
    axes.axvline(1.0, color=GREY, linestyle=":", label="1: any two rows")
    axes.set(xlabel="variance among neighbours over variance of all actions (2 and above in the last bar)")
    axes.set(ylabel="rows")
    axes.legend(frameon=False)


def _mixture(figure: Any, mixture: Mixture) -> None:
    figure.set_size_inches(4.5, 4)
    axes = figure.subplots()
    reach = float(np.abs(mixture.halves).max()) * 1.1 or 1.0
    axes.plot([-reach, reach], [-reach, reach], color=GREY, linestyle=":", linewidth=1)
    axes.plot(*mixture.halves, "o", color=BLUE, markersize=4, alpha=0.6)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel="difference in the first half (relative)", ylabel="difference in the second half (relative)")
