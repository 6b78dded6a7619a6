"""Figs 6 to 8, read back and compared with what was worked out by hand."""

import numpy as np
import pytest
from scipy import stats

from ppo_dap.study.figures.data import changes
from ppo_dap.study.figures.panels import SHADED
from ppo_dap.study.plots.drawing import MAIN
from ppo_dap.study.stats.compare import compare
from ppo_dap.study.store.studies import make_study
from study.figures.figures_drawn import REPS, columns, drawn, line


def test_fig_6_is_the_mean_of_the_seeds_with_its_student_t_band():
    study, results, found = drawn("fig6", seeds=range(5))
    length, returns = found["fig6"].axes
    assert ("length" in length.get_title(), "return" in returns.get_title()) == (True, True)
    for axes, column in ((length, "length_mean"), (returns, "return_mean")):
        for place, arm in enumerate(MAIN[:4]):
            runs = [results.curves[row["run"]] for row in results.rows(study, arm=arm)]
            values = np.array([[row[column] for row in curve] for curve in runs])
            x, y = line(axes, arm).get_data()
            assert x == pytest.approx(np.linspace(0, 1, 41), abs=1e-6)  # in millions of steps
            assert y == pytest.approx(values.mean(0))
            assert line(axes, arm).get_label() == f"{arm} (n = 5)"
            if column == "return_mean":
                edge = axes.collections[place].get_paths()[0].vertices
                low, high = stats.t.interval(0.95, 4, values.mean(0)[-1], stats.sem(values[:, -1]))
                last = edge[np.isclose(edge[:, 0], 1), 1]
                assert (last.min(), last.max()) == pytest.approx((low, high))
                assert axes.get_ylim()[0] < values.min() < values.max() < axes.get_ylim()[1]
    assert "no finished" not in found["fig6"].get_suptitle()


def test_fewer_than_five_seeds_are_drawn_and_no_band():
    def done(labels):
        return labels["seed"] < {"PPO": 1, "PPO-DAP": 4, "PPO-DAP (tuned)": 5}.get(labels["arm"], 0)

    study, results, found = drawn("fig6", seeds=range(5), done=done)
    axes = found["fig6"].axes[1]
    assert SHADED == 5
    assert len(axes.collections) == 1  # the band of the five seeds of tuned
    thin = [line for line in axes.lines if line.get_linewidth() < 1]
    seeds = [[row["return_mean"] for row in results.curves[r["run"]]] for r in results.rows(study, arm="PPO-DAP")]
    assert [each.get_ydata().tolist() for each in thin] == [pytest.approx(values) for values in seeds]
    assert line(axes, "PPO").get_label() == "PPO (n = 1)"
    assert "no finished runs of: PPO-DAP (tuned-warm)" in found["fig6"].get_suptitle().replace("\n", " ")


def test_fig_7_shows_what_the_comparison_says():
    study, results, found = drawn("fig7")
    early, full = found["fig7"].axes
    assert (early.get_title(), full.get_title()) == ("(a) ALC@40", "(b) final return, 1,000,000 steps")
    assert [text.get_text() for text in full.get_yticklabels()[5:7]] == [
        "Pusher\nmedium-expert",
        "Striker\nmedium-expert",
    ]
    rows = results.rows(study, part="full")
    told = {(row["task"], row["method"]): row for row in compare(rows, "PPO", ["last_return"], REPS)}
    tasks = list(dict.fromkeys(entry.labels["task"] for entry in study.entries))
    for number, arm in enumerate(MAIN[1:4]):
        x, y = line(full, arm).get_data()
        assert y == pytest.approx(np.arange(8) + (number - 1) * 0.8 / 3)
        assert x == pytest.approx([told[task, arm]["change"] for task in tasks])
        ends = np.array(full.collections[number].get_segments())[:, :, 0]
        assert ends == pytest.approx(np.array([[told[t, arm][f"change_{e}"] for e in ("low", "high")] for t in tasks]))
        mine, base = (columns(rows, a, "last_return", "Pusher-v5") for a in (arm, "PPO"))
        assert base.mean() < 0
        assert x[5] == pytest.approx((mine.mean() - base.mean()) / -base.mean())
    assert {text.get_text() for text in full.texts} == {"n = 3"}
    assert len(full.texts) == 24


def test_small_marks_of_a_change_are_its_pairs():
    study, results, _ = drawn("fig7")
    rows = results.rows(study, part="full")
    dot = changes(rows, "PPO-DAP", "PPO", "last_return")["Pusher-v5"]
    mine, base = (columns(rows, arm, "last_return", "Pusher-v5") for arm in ("PPO-DAP", "PPO"))
    assert dot.each[""] == pytest.approx((mine - base) / abs(base.mean()))
    assert np.mean(dot.each[""]) == pytest.approx(dot.value)
    # A seed without a partner is in no pair, and a baseline of 0 gives no relative change.
    rows = [
        row | ({"last_return": 0.0} if row["task"] == "Pusher-v5" and row["label"] == "PPO" else {}) for row in rows
    ]
    rows = [row for row in rows if (row["task"], row["label"], row["seed"]) != ("Ant-v5", "PPO", 0)]
    found = changes(rows, "PPO-DAP", "PPO", "last_return")
    assert "Pusher-v5" not in found
    assert found["Ant-v5"].n == 2


def test_an_axis_with_a_change_beyond_1000_percent_is_logarithmic_outside_100():
    def change(labels):
        return {"last_return": {"PPO": 2.0, "PPO-DAP": 5.0}.get(labels["arm"], 30.0)}

    _, _, found = drawn("fig7", change=change)
    assert [axes.get_xscale() for axes in found["fig7"].axes] == ["linear", "symlog"]
    tick = found["fig7"].axes[1].xaxis.get_major_formatter()
    assert [tick(value, 0) for value in (-1, 0, 14.0)] == ["\N{MINUS SIGN}100%", "0", "+1,400%"]


def test_fig_8_puts_methods_at_their_cost_and_gain():
    tasks = [entry.labels["task"] for entry in make_study("fig8", seeds=(0,)).entries]
    order = list(dict.fromkeys(tasks))
    gains = {"PPO": 0, "PPO + BC": 0.1, "PPO-DAP": 0.5, "PPO-DAP (tuned)": 0.9, "No-VG": 0.3}
    costs = {"PPO": 1, "PPO + BC": 1, "PPO-DAP": 1.2, "PPO-DAP (tuned)": 1.3, "No-VG": 1.25}

    def change(labels):
        # The gain is ten times as large on two tasks: an interquartile mean does not see them.
        rare = 10 if order.index(labels["task"]) > 5 else 1
        cost = costs.get(labels["arm"], 2.0) * (1 + 0.1 * order.index(labels["task"]) * (labels["arm"] != "PPO"))
        how = {"last_return": 100 * (1 + rare * gains.get(labels["arm"], 0.2)), "env_steps": 1000}
        return how | {"seconds_iteration": cost}

    _, _, found = drawn("fig8", seeds=(0,), change=change)
    axes = found["fig8"].axes[0]
    assert axes.get_title() == "(a) final return, 200,000 steps: 8 tasks"
    places = {arm: tuple(map(float, line(axes, arm).get_xydata()[0])) for arm in gains}
    assert places["PPO"] == (1.0, 0.0)
    for arm in list(gains)[1:]:
        assert places[arm] == pytest.approx((costs[arm] * 1.35, gains[arm]))
    envelope = line(axes, "envelope").get_xydata()
    expected = [places[arm] for arm in ("PPO", "PPO + BC", "PPO-DAP", "PPO-DAP (tuned)")]
    assert envelope == pytest.approx(np.array([*expected, (2.7, 0.9)]))
    assert line(axes, "PPO-DAP").get_markerfacecolor() == "white"
    assert line(axes, "PPO-DAP (tuned)").get_markerfacecolor() != "white"


def test_fig_8_compares_methods_on_the_tasks_that_all_have():
    def done(labels):
        return labels["arm"] in ("PPO", "PPO-DAP") or (labels["arm"] == "No-VG" and labels["task"] == "Hopper-v5")

    study, results, found = drawn("fig8", done=done)
    axes = found["fig8"].axes[1]
    assert axes.get_title() == "(b) ALC@40: Hopper-v5"
    mine, base = (columns(results.rows(study), arm, "alc", "Hopper-v5") for arm in ("PPO-DAP", "PPO"))
    assert line(axes, "PPO-DAP").get_ydata() == pytest.approx([mine.mean() / base.mean() - 1])
    every = [line for line in axes.lines if line.get_alpha() == 0.45]
    assert sorted(len(line.get_xdata()) for line in every) == [1, 8]
