"""What makes the tests of figures quick."""

import pytest

from ppo_dap.study.figures import data as figure_data
from ppo_dap.study.store.cells import Cell
from ppo_dap.study.store.grids import Scale
from study.figures.figures_drawn import REPS


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few resamples; and cells that are named after their labels, since hundreds of settings take long to resolve."""

    def run(scale, setting, arm, seed, steps):
        labels = {"task": setting.task, "arm": arm.name, "seed": seed, "steps": steps}
        return Cell("run", labels, {"prior": Cell("prior", {})})

    monkeypatch.setattr(figure_data, "REPS", REPS)
    monkeypatch.setattr(Scale, "run", run)
