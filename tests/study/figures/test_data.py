"""What figures are drawn from: bands, the envelope, means; and looks that differ."""

import math

import numpy as np
import pytest
from scipy import stats

from ppo_dap.study.figures.data import band, mean_over_tasks, of_runs, pareto
from ppo_dap.study.plots.drawing import MAIN, looks
from study.figures.figures_drawn import columns, drawn


def test_no_two_of_many_series_look_the_same():
    found = looks([*(f"arm {i}" for i in range(14)), *MAIN])
    assert len({(look.mark, str(look.dash)) for look in found.values()}) == len(found)
    assert {name: looks([name])[name] for name in MAIN} == {name: found[name] for name in MAIN}


@pytest.mark.parametrize("seed", range(20))
def test_the_envelope_is_what_no_point_beats(seed):
    rng = np.random.default_rng(seed)
    # Few values, so that costs and gains are tied often.
    points = {str(i): tuple(map(float, rng.integers(0, 6, 2))) for i in range(12)}

    def beaten(own):
        return any(c <= own[0] and g >= own[1] and (c, g) != own for c, g in points.values())

    kept = pareto(points)
    assert set(kept) == {name for name, point in points.items() if not beaten(point)}
    assert [points[name][0] for name in kept] == sorted(points[name][0] for name in kept)


def test_a_band_is_at_all_steps_that_every_seed_reached():
    def curve(*pairs):
        return [{"env_steps": steps, "return_mean": value} for steps, value in pairs]

    found = band([curve((0, 0.0), (10, 10.0), (30, 30.0)), curve((0, 2.0), (20, 6.0))], "return_mean")
    assert found.steps.tolist() == [0, 10, 20]
    assert found.each.tolist() == [[0, 10, 20], [2, 4, 6]]
    assert found.mean.tolist() == [1, 7, 13]
    # Two values 2 apart: 12.706 times their standard error, which is 1.
    assert found.half_width == pytest.approx(12.7062 * np.array([1, 3, 7]), rel=1e-5)
    assert np.isnan(band([curve((0, 0.0), (10, 1.0))], "return_mean").half_width).all()


def test_intervals_over_tasks_resample_seeds_in_their_task():
    study, results, _ = drawn("fig12")
    rows = results.rows(study)
    dot = mean_over_tasks(rows, ["wide logs"], "alc", "PPO")["wide logs"]
    assert dot.n == 12
    assert dot.low < dot.value < dot.high
    assert dot.value == pytest.approx(np.mean([value for each in dot.each.values() for value in each]))
    # All pairs of a task alike: nothing to resample, however the tasks differ.
    alike = [row | {"alc": (2.0 + len(row["task"])) ** (row["label"] != "PPO")} for row in rows]
    dot = mean_over_tasks(alike, ["wide logs"], "alc", "PPO")["wide logs"]
    assert (dot.low, dot.high) == pytest.approx((dot.value, dot.value))
    assert mean_over_tasks(rows, ["wide logs"], "ess", None)["wide logs"].value == pytest.approx(
        np.mean([columns(rows, "wide logs", "ess", task).mean() for task in dot.each])
    )


def test_a_mean_of_runs_leaves_out_what_is_unknown():
    assert of_runs([None, math.nan]) is None
    dot = of_runs([1.0, None, 3.0, math.nan, 5.0])
    assert dot is not None
    assert (dot.value, dot.n) == (3.0, 3)
    assert (dot.low, dot.high) == pytest.approx(stats.t.interval(0.95, 2, 3, stats.sem([1, 3, 5])))
