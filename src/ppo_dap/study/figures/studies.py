"""`FIGURES`: what draws each study, from `Results` alone. Gains are over |PPO|, paired by seed."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

from ppo_dap.study.figures import experiments as experiment_figures
from ppo_dap.study.figures import knobs as knob_figures
from ppo_dap.study.figures import main as main_figures
from ppo_dap.study.figures import proposals as proposal_figure
from ppo_dap.study.plots.drawing import Drawn, house_style, write
from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study

DRAWINGS: dict[str, Callable[[Results, Study], Drawn]] = {
    "fig6": main_figures.fig6,
    "fig7": main_figures.fig7,
    "fig8": main_figures.fig8,
    "fig9": knob_figures.fig9,
    "fig10": knob_figures.fig10,
    "fig11": proposal_figure.fig11,
    "fig12": knob_figures.fig12,
    "ablation": experiment_figures.ablation,
    "coverage": knob_figures.coverage,
    "reliability": experiment_figures.reliability,
    "audit": experiment_figures.audit,
    "mixed": experiment_figures.mixed,
}
"""Study -> its figures by file name, none where the results have nothing to show."""


def figures_of(results: Results, study: Study) -> Drawn:
    """The figures of a study that is in `DRAWINGS`, unwritten."""
    with house_style():
        return DRAWINGS[study.name](results, study)


def _written(name: str, results: Results, study: Study, folder: Path) -> list[Path]:
    drawn = figures_of(results, dataclasses.replace(study, name=name))
    return [path for file, figure in drawn.items() for path in write(figure, folder, file)]


FIGURES: dict[str, Callable[[Results, Study, Path], list[Path]]] = {
    name: functools.partial(_written, name) for name in DRAWINGS
}
"""Study -> writes its figures into a folder, as .svg and .png; returns the files, none for a study without runs."""
