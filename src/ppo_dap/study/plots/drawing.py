"""How the figures of studies look, and how they are written: vector and bitmap, the same bytes every time.

Nothing is told by colour alone: what differs in colour differs in dash and mark too, or stands in its own row.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ppo_dap.methods import get_method
from ppo_dap.storage import write_atomically
from ppo_dap.study.plots.curves import STYLES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.2
"""Inches of a page's text."""
DPI = 150
GREY = "#595959"
WIDE = 10.0
"""Relative change, 1000%, from which an axis is logarithmic."""
MARKS = ("o", "s", "^", "D", "v", "P", "X")
MAIN = ("PPO", "PPO-DAP", "PPO-DAP (tuned)", "PPO-DAP (tuned-warm)", "PPO + BC")
"""What looks the same in every figure."""
PRESETS = {"preset paper": "PPO-DAP", "preset tuned": "PPO-DAP (tuned)"}
"""A series of a preset's arms -> whose look it has."""
HOUSE: dict[str, Any] = {
    "font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5, "legend.handlelength": 2.8, "legend.frameon": False, "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True, "grid.alpha": 0.3, "grid.linewidth": 0.6, "axes.axisbelow": True, "figure.dpi": 100,
    # Letters as paths: a viewer without the font would set them wider and over each other.
    "svg.fonttype": "path",
    # Names inside the file are hashes of this and of what they name, instead of random ones; `numbered` does the rest.
    "svg.hashsalt": "ppo-dap",
}  # fmt: skip
HASH = re.compile(rb"(?<=[mph_])[0-9a-f]{10}(?=[\")_])")
"""What follows the kind (marker, path, hatch, collection) in a name inside an .svg."""
WRITTEN = {"svg": {"Date": None, "Creator": None}, "png": {"Software": None}}
"""Metadata by format: neither the hour nor a version, so that a figure changes where its data do."""


Drawn = dict[str, "Figure"]
"""File name without its ending -> figure; empty where there is nothing to show."""


class Look(NamedTuple):
    """How one series of a figure is told from the others."""

    colour: str
    dash: Any
    mark: str
    filled: bool = True

    def point(self, size: float = 5.0) -> dict[str, Any]:
        """Of a mark."""
        face = self.colour if self.filled else "white"
        return {"marker": self.mark, "ms": size, "color": self.colour, "markerfacecolor": face}

    def line(self) -> dict[str, Any]:
        """Of a line."""
        return {"color": self.colour, "linestyle": self.dash}


def looks(names: Iterable[str]) -> dict[str, Look]:
    """A look for each name; `MAIN` have their own, and others come after those."""
    own = {name: PRESETS.get(name, name) for name in names}
    taken = {MAIN.index(name) for name in own.values() if name in MAIN}
    free = (i for i in range(len(own) + len(MAIN)) if i not in taken)
    found = {}
    for name, like in own.items():
        number = MAIN.index(like) if like in MAIN else next(free)
        colour, dash = STYLES[number % len(STYLES)]
        found[name] = Look(colour, dash, MARKS[number % len(MARKS)])
    return found


def house_style() -> AbstractContextManager[Any]:
    """Sizes and lines; both while a figure is made and while it is written."""
    import matplotlib

    return matplotlib.rc_context(HOUSE)  # type: ignore[arg-type]  # its stub lists every name


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """A figure without pyplot: nothing of the caller's matplotlib is touched."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def write(figure: Figure, folder: Path, name: str) -> list[Path]:
    """`name`.svg and `name`.png in `folder`."""
    paths = []
    with house_style():
        for suffix, metadata in WRITTEN.items():
            content = io.BytesIO()
            figure.savefig(content, format=suffix, dpi=DPI, metadata=metadata)
            paths.append(folder / f"{name}.{suffix}")
            made = content.getvalue()
            write_atomically(paths[-1], numbered(made) if suffix == "svg" else made)
    return paths


def numbered(svg: bytes) -> bytes:
    """`svg` with numbers for matplotlib's hashed names, which feel the last bit of a layout that prints the same."""
    numbers: dict[bytes, bytes] = {}

    def number(found: re.Match[bytes]) -> bytes:
        return numbers.setdefault(found[0], b"%d" % len(numbers))

    return HASH.sub(number, svg)


def head(figure: Figure, title: str, missing: Sequence[str] = (), note: str = "") -> None:
    """The title; below it a note, and the arms that have no finished run and are therefore left out."""
    absent = f"no finished runs of: {', '.join(missing)}" if missing else ""
    small = "; ".join(part for part in (note, absent) if part)
    width = int(figure.get_figwidth() * 14.5)
    lines = [line for text in (title, small) for line in textwrap.wrap(text, width, break_on_hyphens=False)]
    figure.suptitle("\n".join(lines), fontsize=8.5)


def legend_below(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """The legend of `axes` under the whole figure, where it is over no data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(columns, len(handles)))


def percent(axes: Axes, which: Literal["x", "y"]) -> None:
    """Ticks of relative changes that are drawn: +50%, 0, -50%; beyond `WIDE` the axis is logarithmic outside +-100%, as
    where a baseline is near 0.
    """
    ends = axes.dataLim.intervalx if which == "x" else axes.dataLim.intervaly
    if max(map(abs, ends)) > WIDE:
        (axes.set_xscale if which == "x" else axes.set_yscale)("symlog", linthresh=1)
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter(
        lambda value, _: "0" if abs(value) < 1e-9 else f"{value:+,.0%}".replace("-", "\N{MINUS SIGN}")
    )


def thousands(axes: Axes, steps: float) -> Callable[[Any], Any]:
    """Label the x-axis for `steps` environment steps; returns what turns steps into its units."""
    unit, name = (1e6, "millions") if steps >= 1e6 else (1e3, "thousands")
    axes.set_xlabel(f"environment steps ({name})")
    return lambda values: values / unit


def setting(labels: Mapping[str, Any], line: str = "\n") -> str:
    """A task and the tier of its logs, as the paper names them."""
    return f"{labels['task'].rpartition('-')[0] or labels['task']}{line}{labels['logs']}"


def shown(labels: Mapping[str, Any]) -> str:
    """An arm as a figure names it: a reconstruction of a method that nobody has described says so."""
    extra = " (reconstruction)" if get_method(labels["method"]).source == "reconstruction" else ""
    return labels["arm"] + extra


def family(labels: Mapping[str, Any]) -> str:
    """An arm without its preset."""
    return shown(labels).replace(f" ({labels['preset']})", "")
