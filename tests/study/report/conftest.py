"""Runs and their page for the tests of reports."""

import functools

import pytest

from ppo_dap.study.report.page import write_report
from ppo_dap.study.stats.compare import compare, overall
from study.report.report_made import make_run
from study.report.report_read import SWIM, Page

FEW = 100


@pytest.fixture(scope="module", autouse=True)
def few_resamples():
    """Types are checked in each resample: a few do."""
    with pytest.MonkeyPatch.context() as patch:
        for function in (compare, overall):
            for module in ("stats.compare", "report.page"):
                patch.setattr(f"ppo_dap.study.{module}.{function.__name__}", functools.partial(function, reps=FEW))
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Three methods on one task, two on another; a method that is declared not to be on-policy."""
    here = tmp_path_factory.mktemp("runs")
    made = [make_run(here / f"ppo-{seed}", seed=seed, height=500 + seed) for seed in range(7)]
    made += [make_run(here / f"tuned-{seed}", seed=seed, height=900, preset="tuned") for seed in range(7)]
    made += [make_run(here / f"flow-{s}", "ppo-flow", s, 700, prior_hash="a" * 64, pet_frequency=0) for s in (0, 1)]
    made += [make_run(here / f"arc-{s}", "ppo-arc", s, 400, batch_fresh=0.5, **SWIM) for s in (0, 1, 2)]
    made += [make_run(here / f"swim-{s}", "ppo", s, 300, **SWIM) for s in (0, 1, 2)]
    return [str(folder) for folder in made]


@pytest.fixture(scope="module")
def page(folders, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    done = write_report(folders, path, epochs=10.0)
    assert done == (22, 0, 0, True)
    return Page(path.read_text())
