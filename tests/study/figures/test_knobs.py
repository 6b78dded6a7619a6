"""Figs 9, 10 and 12, and coverage: what a knob changes."""

import statistics

import numpy as np
import pytest

from ppo_dap.study.figures.panels import BOXED
from study.figures.figures_drawn import columns, drawn, line


def test_fig_9_goes_from_the_smallest_value_to_the_largest():
    study, results, found = drawn("fig9")
    axes = found["fig9"].axes
    rows = results.rows(study)
    base = columns(rows, "PPO", "alc", "Walker2d-v5").mean()
    for panel, arms in ((0, ["K=5", "K=10", "K=15", "K=20"]), (1, [f"share={x}" for x in (0.05, 0.2, 0.5, 1)])):
        x, y = line(axes[panel], "Walker2d medium-expert, paper").get_data()
        assert y == pytest.approx([columns(rows, arm, "alc", "Walker2d-v5").mean() / base - 1 for arm in arms])
        assert np.diff(x) == pytest.approx([1, 1, 1])
        assert [text.get_text() for text in axes[panel].get_xticklabels()] == [arm.partition("=")[2] for arm in arms]
    seconds = [columns(rows, arm, "seconds_iteration", "Hopper-v5") for arm in ("K=20 (tuned)", "PPO")]
    ratio = statistics.median(seconds[0] / seconds[1])
    assert line(axes[4], "Hopper medium-expert, tuned").get_ydata()[-1] == pytest.approx(ratio)


def test_fig_10_shows_every_run_and_boxes_of_five_or_more():
    study, results, found = drawn("fig10", seeds=range(5), done=lambda own: own["arm"] != "PET f=5" or own["seed"] < 4)
    axes = found["fig10"].axes[1]
    assert BOXED == 5
    ticks = [text.get_text() for text in axes.get_xticklabels()]
    assert ticks == ["PPO\nn=5", "f=0\nn=5", "f=5\nn=4", "f=10\nn=5", "f=20\nn=5"]
    rows = results.rows(study)
    marks = [line for line in axes.lines if line.get_marker() not in ("None", "", None)]
    for marked, arm in zip(marks, ("PPO", "No-PET", "PET f=5", "PET f=10", "PET f=20"), strict=True):
        assert sorted(marked.get_ydata()) == pytest.approx(sorted(columns(rows, arm, "last_return")))
    # A box is a line of five corners, the quartiles.
    boxes = [line.get_ydata() for line in axes.lines if len(line.get_xdata()) == 5 and line not in marks]
    low, high = np.quantile(columns(rows, "No-PET", "last_return"), [0.25, 0.75])
    assert len(boxes) == 4
    assert (boxes[1].min(), boxes[1].max()) == pytest.approx((low, high))
    curve = line(found["fig10"].axes[0], "f = 10").get_ydata()
    runs = [results.curves[row["run"]] for row in results.rows(study, arm="PET f=10")]
    assert curve == pytest.approx(np.mean([[row["return_mean"] for row in run] for run in runs], axis=0))


def test_fig_12_is_the_mean_over_the_tasks_that_every_level_has():
    def done(labels):
        return (labels["arm"], labels["task"]) != ("medium logs", "HumanoidStandup-v5")

    study, results, found = drawn("fig12", done=done)
    axes = found["fig12"].axes
    rows = results.rows(study)
    every = ["Walker2d-v5", "HalfCheetah-v5", "Hopper-v5", "HumanoidStandup-v5"]
    for preset, tasks, ending in (("preset paper", every[:3], ""), ("preset tuned", every, " (tuned)")):
        arms = [f"{level} logs{ending}" for level in ("wide", "medium", "narrow")]
        gains = [
            [columns(rows, arm, "alc", task).mean() / columns(rows, "PPO", "alc", task).mean() - 1 for task in tasks]
            for arm in arms
        ]
        assert line(axes[0], preset).get_ydata() == pytest.approx(np.mean(gains, axis=1))
        ess = [np.mean([columns(rows, arm, "ess", task).mean() for task in tasks]) for arm in arms]
        assert line(axes[3], preset).get_ydata() == pytest.approx(ess)
    small = [mark for mark in axes[0].lines if mark.get_markersize() == 3 and mark.get_marker() == "D"]
    assert [len(mark.get_xdata()) for mark in small] == [3]  # HumanoidStandup, in preset tuned alone


def test_mitigations_stand_below_the_levels_of_coverage():
    study, results, found = drawn("coverage", done=lambda own: own.get("mitigation") != "alpha 0.2")
    axes = found["coverage"].axes[0]
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names[:4] == ["wide logs", "medium logs", "narrow logs", "gate and beta 0.6"]
    assert names[-1] == "all four"
    assert "alpha 0.2" not in names
    assert "narrow logs: alpha 0.2" in found["coverage"].get_suptitle().replace("\n", " ")
    rows = results.rows(study)
    arms = ("narrow logs: all four", "PPO")
    gains = [np.divide(*(columns(rows, arm, "alc", t).mean() for arm in arms)) - 1 for t in {r["task"] for r in rows}]
    assert line(axes, "preset paper").get_xdata()[-1] == pytest.approx(np.mean(gains))
