"""Figures of runs, in colours and dashes that print and that the colour-blind can tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ppo_dap.training.run import Run

STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#CC79A7", ":"), ("#E69F00", (0, (5, 1))))
"""Okabe and Ito's palette, with a dash each."""


def learning_curves(groups: Mapping[str, Sequence[Run]], path: Path, title: str) -> None:
    """Return of the deterministic policy against environment steps: a thin line a seed, a thick one their mean."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    for (label, runs), (colour, dash) in zip(groups.items(), STYLES, strict=False):
        curves = [[(row["env_steps"], row["return_mean"]) for row in run.evaluations] for run in runs]
        grid = np.linspace(0, min(curve[-1][0] for curve in curves), 101)
        for curve in curves:
            axes.plot(*np.array(curve).T / [[1e3], [1]], color=colour, linestyle=dash, linewidth=0.8, alpha=0.5)
        mean = np.mean([np.interp(grid, *np.array(curve).T) for curve in curves], axis=0)
        axes.plot(grid / 1e3, mean, color=colour, linestyle=dash, linewidth=2.4, label=f"{label} (n = {len(runs)})")
    axes.set(xlabel="environment steps (thousands)", ylabel="return of the deterministic policy", title=title)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
