"""What the diagnostics' figures share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ppo_dap.errors import InputError


def require_png(path: str | Path) -> Path:
    """`path` as a Path; raises `InputError` unless it ends in .png and lies in a folder that is there."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"png {path} must end in .png")
    if not path.parent.is_dir():
        raise InputError(f"png {path}: there is no folder {path.parent}")
    return path


@contextmanager
def saved_figure(path: Path, size: tuple[float, float], rows: int = 1) -> Iterator[Any]:
    """Axes (an array of them for more `rows`) of a figure that is written to `path` when all is drawn."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(rows, figsize=size, layout="constrained", sharex=rows > 1)
    try:
        yield axes
        for each in figure.axes:
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
        figure.savefig(path, dpi=150)
    finally:
        pyplot.close(figure)
