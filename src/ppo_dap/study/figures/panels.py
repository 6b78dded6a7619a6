"""Kinds of panel that figures of studies are made of. Each draws numbers that it is given, and computes none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ppo_dap.study.figures.data import Band, Dot
from ppo_dap.study.plots.drawing import GREY, Look, percent, thousands

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BOXED = 5
"""Runs from which a box is drawn."""
SHADED = 5
"""Runs from which a curve has a band: that of three is 4.3 standard errors to each side and hides all else."""


def curves(axes: Axes, bands: Mapping[str, Band], look: Mapping[str, Look]) -> None:
    """A line a name, the mean, with its band, or with a thin line a seed where there are fewer than `SHADED`.

    The axis spans the seeds: a band can be far wider, and is cut off.
    """
    scale = thousands(axes, max(band.steps[-1] for band in bands.values()))
    for number, (name, band) in enumerate(bands.items()):
        n, style = len(band.each), look[name].line()
        every = max(len(band.steps) // 6, 1)
        places = slice(every * (number + 1) // (len(bands) + 1), None, every)  # not all names at the same steps
        axes.plot(
            scale(band.steps), band.mean, linewidth=1.5, label=f"{name} (n = {n})", marker=look[name].mark, ms=4,
            markevery=places, **style,
        )  # fmt: skip
        if n >= SHADED:
            low, high = band.mean - band.half_width, band.mean + band.half_width
            axes.fill_between(scale(band.steps), low, high, color=style["color"], alpha=0.15, linewidth=0)
        elif n > 1:
            for each in band.each:
                axes.plot(scale(band.steps), each, linewidth=0.7, alpha=0.6, **style)
    low = min(float(band.each.min()) for band in bands.values())
    high = max(float(band.each.max()) for band in bands.values())
    room = 0.05 * (high - low) or 1.0
    axes.set_ylim(low - room, high + room)
    axes.margins(x=0.01)


def dots(
    axes: Axes,
    names: Sequence[str],
    series: Mapping[str, Mapping[str, Dot]],
    look: Mapping[str, Look],
    *,
    relative: bool = True,
    counts: bool = True,
    marks: Mapping[str, str] | None = None,
) -> None:
    """A row a name; in it, below each other, a mark with its interval for every series that has one, what it is made
    of as small grey marks, and the number of runs at the right end.

    `relative` figures are changes, in per cent of a baseline that is the line at 0.
    """
    step = 0.8 / max(len(series), 1)
    for number, (label, found) in enumerate(series.items()):
        own = _places(names, found, (number - (len(series) - 1) / 2) * step)
        small_marks(axes, own, marks or {}, 0.3 * step, upright=False)
        lows, highs = [dot.low for dot in own.values()], [dot.high for dot in own.values()]
        axes.hlines(list(own), lows, highs, colors=look[label].colour, linewidth=1.4, zorder=3)
        values = [dot.value for dot in own.values()]
        axes.plot(values, list(own), linestyle="none", label=label, zorder=4, **look[label].point())
        for place, dot in own.items() if counts else ():
            where = axes.get_yaxis_transform()
            axes.text(1.01, place, f"n = {dot.n}", transform=where, va="center", fontsize=6, color=GREY)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    for edge in range(len(names) - 1):
        axes.axhline(edge + 0.5, color="0.85", linewidth=0.6, zorder=0)
    if relative:
        axes.axvline(0, color=GREY, linewidth=1, zorder=1)
        percent(axes, "x")


def trends(
    axes: Axes,
    names: Sequence[str],
    series: Mapping[str, Mapping[str, Dot]],
    look: Mapping[str, Look],
    *,
    baseline: float | None = None,
    marks: Mapping[str, str] | None = None,
) -> None:
    """A column a name, in order; a line a series through its values, with their intervals and what they are made of."""
    step = 0.6 / max(len(series), 1)
    for number, (label, found) in enumerate(series.items()):
        own = _places(names, found, (number - (len(series) - 1) / 2) * step)
        small_marks(axes, own, marks or {}, 0.3 * step, upright=True)
        lows, highs = [dot.low for dot in own.values()], [dot.high for dot in own.values()]
        axes.vlines(list(own), lows, highs, colors=look[label].colour, linewidth=1.1, zorder=3)
        style = look[label].line() | look[label].point(4.5)
        axes.plot(list(own), [dot.value for dot in own.values()], linewidth=1.2, label=label, zorder=4, **style)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.grid(visible=False, axis="x")
    if baseline is not None:
        axes.axhline(baseline, color=GREY, linewidth=1, zorder=1)


def _places(names: Sequence[str], found: Mapping[str, Dot], aside: float) -> dict[float, Dot]:
    """Place along the names -> what stands there, in their order."""
    return {place + aside: found[name] for place, name in enumerate(names) if name in found}


def small_marks(axes: Axes, own: Mapping[float, Dot], marks: Mapping[str, str], aside: float, *, upright: bool) -> None:
    """What each dot is made of, `aside` of its place: a small grey mark each, by `marks` or else a point."""
    groups: dict[str, list[tuple[float, float]]] = {}
    for place, dot in own.items():
        for group, values in dot.each.items():
            groups.setdefault(group, []).extend((place + aside, value) for value in values)
    for group, found in groups.items():
        places, values = np.array(found).T
        style: dict[str, Any] = {"marker": marks.get(group, "."), "ms": 3.0, "color": "0.55", "linestyle": "none"}
        axes.plot(*((places, values) if upright else (values, places)), markeredgewidth=0, zorder=2, **style)


def distribution(axes: Axes, groups: Mapping[str, Dot], look: Mapping[str, Look]) -> None:
    """A column a name: a mark a run, a short line for the mean and, from `BOXED` runs on, a box (quartiles, range)."""
    for place, (name, dot) in enumerate(groups.items()):
        values = np.array(dot.each[""])
        if len(values) >= BOXED:
            line = {"color": GREY, "linewidth": 0.9}
            box: dict[str, Any] = {"boxprops": line, "whiskerprops": line, "capprops": line, "medianprops": line}
            axes.boxplot(values, positions=[place], widths=0.6, whis=(0, 100), showfliers=False, **box)
        aside = place + (0.12 * (np.arange(len(values)) % 3 - 1) if len(values) > 1 else np.zeros(1))
        axes.plot(aside, values, linestyle="none", alpha=0.85, zorder=3, **look[name].point(4.0))
        axes.plot([place - 0.3, place + 0.3], [dot.value] * 2, color="black", linewidth=1.6, zorder=4)
    labels = [f"{name.replace(' ', '')}\nn={dot.n}" for name, dot in groups.items()]
    axes.set_xticks(range(len(groups)), labels)
    axes.set_xlim(-0.6, len(groups) - 0.4)
    axes.grid(visible=False, axis="x")
