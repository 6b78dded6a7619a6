"""Figures of runs, in colours and dashes that print and that the colour-blind can tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ppo_dap.training.run import Run

STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#CC79A7", ":"), ("#E69F00", (0, (5, 1))))
"""Okabe and Ito's palette, with a dash each."""


def on_common_steps(
    evaluations: Sequence[Sequence[Mapping[str, Any]]],
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "n p"]]:
    """Environment steps at which the run that ends first was evaluated, and the return of each run there.

    The other runs were evaluated a few steps before or after: between two of their points a line is drawn.
    """
    curves = [_curve(rows) for rows in evaluations]
    steps = min(curves, key=lambda curve: curve[0, -1])[0]
    return steps, np.array([np.interp(steps, *curve) for curve in curves])


def _curve(rows: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, "2 p"]:
    return np.array([(row["env_steps"], row["return_mean"]) for row in rows], float).T


def learning_curves(groups: Mapping[str, Sequence[Run]], path: Path, title: str) -> None:
    """Return of the deterministic policy against environment steps: a thin line a seed, a thick one their mean."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    for (label, runs), (colour, dash) in zip(groups.items(), STYLES, strict=False):
        evaluations = [run.evaluations for run in runs]
        for rows in evaluations:
            axes.plot(*_curve(rows) / [[1e3], [1]], color=colour, linestyle=dash, linewidth=0.8, alpha=0.5)
        steps, returns = on_common_steps(evaluations)
        axes.plot(
            steps / 1e3,
            returns.mean(0),
            color=colour,
            linestyle=dash,
            linewidth=2.4,
            label=f"{label} (n = {len(runs)})",
        )
    axes.set(xlabel="environment steps (thousands)", ylabel="return of the deterministic policy", title=title)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
