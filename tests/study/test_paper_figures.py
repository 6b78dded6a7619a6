"""Figures of studies: what stands in them is read back, and compared with what was worked out by hand."""

import math

import numpy as np
import pytest
from matplotlib.image import imread
from scipy import stats

from ppo_dap.study import figure_data
from ppo_dap.study.cells import Cell
from ppo_dap.study.compare import compare
from ppo_dap.study.drawing import MAIN, looks
from ppo_dap.study.figure_data import BANDED, band, changes, mean_over_tasks, of_runs, pareto
from ppo_dap.study.figure_panels import BOXED
from ppo_dap.study.grids import Scale
from ppo_dap.study.paper_figures import DRAWINGS, FIGURES, figures_of
from ppo_dap.study.results import Results
from ppo_dap.study.studies import SMOKE, STUDIES, make_study, only, parts
from study.levels_made import made_results

REPS = 8


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few resamples; and cells that are named after their labels, since hundreds of settings take long to resolve."""

    def run(scale, setting, arm, seed, steps):
        labels = {"task": setting.task, "arm": arm.name, "seed": seed, "steps": steps}
        return Cell("run", labels, {"prior": Cell("prior", {})})

    monkeypatch.setattr(figure_data, "REPS", REPS)
    monkeypatch.setattr(Scale, "run", run)


def drawn(name, seeds=(0, 1, 2), done=lambda labels: True, wanted=None, change=None):
    """A study, made-up results of it, and its figures; `change` puts other figures into a run's row, by its labels."""
    study = make_study(name, seeds=seeds)
    study = only(study, wanted) if wanted else study
    results = made_results(study, done=done)
    for entry in study.entries if change else ():
        if entry.cell.name in results.runs:
            results.runs[entry.cell.name] |= change(entry.labels)
    return study, results, figures_of(results, study)


def line(axes, label):
    """The line of that label in the legend."""
    (found,) = [line for line in axes.lines if str(line.get_label()).partition(" (n =")[0] == label]
    return found


def columns(rows, arm, metric, task=None):
    """A metric of an arm's runs by seed."""
    own = [row for row in rows if row["label"] == arm and task in (None, row["task"])]
    return np.array([row[metric] for row in sorted(own, key=lambda row: row["seed"])])


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


def test_fig_6_is_the_mean_of_the_seeds_with_its_student_t_band():
    study, results, found = drawn("fig6")
    length, returns = found["fig6"].axes
    assert ("length" in length.get_title(), "return" in returns.get_title()) == (True, True)
    for axes, column in ((length, "length_mean"), (returns, "return_mean")):
        for place, arm in enumerate(MAIN[:4]):
            runs = [results.curves[row["run"]] for row in results.rows(study, arm=arm)]
            values = np.array([[row[column] for row in curve] for curve in runs])
            x, y = line(axes, arm).get_data()
            assert x == pytest.approx(np.linspace(0, 1, 41), abs=1e-6)  # in millions of steps
            assert y == pytest.approx(values.mean(0))
            assert line(axes, arm).get_label() == f"{arm} (n = 3)"
            if column == "return_mean":
                edge = axes.collections[place].get_paths()[0].vertices
                low, high = stats.t.interval(0.95, 2, values.mean(0)[-1], stats.sem(values[:, -1]))
                last = edge[np.isclose(edge[:, 0], 1), 1]
                assert (last.min(), last.max()) == pytest.approx((low, high))
                assert axes.get_ylim()[0] < values.min() < values.max() < axes.get_ylim()[1]
    assert "no finished" not in found["fig6"].get_suptitle()


def test_fewer_than_three_seeds_are_drawn_and_no_band():
    def done(labels):
        return labels["seed"] < {"PPO": 1, "PPO-DAP": 2, "PPO-DAP (tuned)": 3}.get(labels["arm"], 0)

    study, results, found = drawn("fig6", done=done)
    axes = found["fig6"].axes[1]
    assert BANDED == 3
    assert len(axes.collections) == 1  # the band of the three seeds of tuned
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
    assert axes.get_title() == "(b) ALC@40: 1 task"
    mine, base = (columns(results.rows(study), arm, "alc", "Hopper-v5") for arm in ("PPO-DAP", "PPO"))
    assert line(axes, "PPO-DAP").get_ydata() == pytest.approx([mine.mean() / base.mean() - 1])
    every = [line for line in axes.lines if line.get_alpha() == 0.45]
    assert sorted(len(line.get_xdata()) for line in every) == [1, 8]


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
    seconds = [columns(rows, arm, "seconds_iteration", "Hopper-v5").sum() for arm in ("K=20 (tuned)", "PPO")]
    assert line(axes[4], "Hopper medium-expert, tuned").get_ydata()[-1] == pytest.approx(seconds[0] / seconds[1])


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


def test_parts_are_compared_with_the_whole_on_the_same_seeds():
    study, results, found = drawn("mixed", seeds=(0, 1, 2, 3))
    rows = results.rows(study, part="early")
    axes = found["mixed-parts"].axes[1]
    assert axes.get_title() == "Hopper: ALC@40"
    names = [text.get_text() for text in found["mixed-parts"].axes[0].get_yticklabels()]
    whole = columns(rows, "PPO-DAP (tuned-warm)", "alc", "Hopper-v5")
    part = columns(rows, "PPO-DAP (tuned-warm): no PET", "alc", "Hopper-v5")
    own = names.index("no PET")
    large = line(axes, "change")
    assert large.get_xdata()[own] == pytest.approx((part.mean() - whole.mean()) / whole.mean())
    small = next(mark for mark in axes.lines if mark.get_markersize() == 3).get_xydata()
    here = small[abs(small[:, 1] - own) < 0.4, 0]
    assert sorted(here) == pytest.approx(sorted((part - whole) / whole.mean()))


def test_methods_on_mixed_logs_say_which_are_reconstructions():
    def done(labels):
        return labels["seed"] < (2 if labels["arm"] == "PPO" else 3) and labels["arm"] != "VAE + PPO (ctrl)"

    study, results, found = drawn("mixed", done=done)
    axes = found["mixed-methods"].axes[0]
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert {"ABPPO (reconstruction)", "PPO-ARC (reconstruction)", "PPO-GC (reconstruction)"} < set(names)
    assert "VAE + PPO (ctrl)" not in names
    assert "VAE + PPO (ctrl)" in found["mixed-methods"].get_suptitle().replace("\n", " ")
    values = columns(results.rows(study, part="early"), "PPO + BC", "alc", "Walker2d-v5")
    place = names.index("PPO + BC")
    assert line(axes, "mean").get_xdata()[place] == pytest.approx(values.mean())
    ends = [path.vertices[:, 0] for path in axes.collections[0].get_paths()]
    assert ends[place] == pytest.approx(stats.t.interval(0.95, 2, values.mean(), stats.sem(values)))
    assert np.isnan(ends[names.index("PPO")]).all()  # two runs: no interval
    assert [text.get_text() for text in axes.texts][names.index("PPO")] == "n = 2"


def test_configurations_of_the_ablation_are_ordered_by_pet_frequency():
    study, results, found = drawn("ablation", seeds=(0,), wanted={"task": ["Hopper-v5"]})
    assert list(found) == ["ablation-alc", "ablation-final"]
    (axes,) = found["ablation-alc"].axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    energy = [name for name in names if name.startswith("diffusion / energy /")]
    assert energy == [f"diffusion / energy / f={f}" for f in (0, 10, 20)]
    rows = results.rows(study)
    one, ppo = (columns(rows, arm, "alc")[0] for arm in ("flow / energy (tuned)", "PPO"))
    tuned = line(axes, "preset tuned")
    (here,) = np.flatnonzero(abs(tuned.get_ydata() - names.index("flow / energy")) < 0.5)
    assert tuned.get_xdata()[here] == pytest.approx((one - ppo) / ppo)
    assert len(line(axes, "preset paper").get_xdata()) == len(tuned.get_xdata()) + 1  # AWR has one preset


def test_reliability_shows_the_reports_beside_what_is_possible():
    study, results, found = drawn("reliability")
    rho, _, affine, gain = found["reliability"].axes
    reports = [
        results.reports[entry.cell.name]
        for entry in study.entries
        if entry.cell.kind == "reliability"
        and (entry.labels["arm"], entry.labels["task"]) == ("advantage energy", "Hopper-v5")
    ]
    place = [text.get_text() for text in rho.get_yticklabels()].index("Hopper\nmedium-expert")
    for axes, values in (
        (rho, [report["q.proposals.rho"] for report in reports]),
        (affine, [report["calibration.affine.ece"] for report in reports]),
        (gain, [report["returns.reweighted"] - report["returns.unguided"] for report in reports]),
    ):
        assert len(values) == 3
        assert line(axes, "advantage energy").get_xdata()[place] == pytest.approx(np.mean(values))
    every = [
        results.reports[entry.cell.name]["rank_ceiling.proposals"]
        for entry in study.entries
        if entry.cell.kind == "reliability" and entry.labels["task"] == "Hopper-v5"
    ]
    assert line(rho, "what the true Q would reach").get_xdata()[place] == pytest.approx(np.mean(every))
    # A task whose states cannot be restored has neither rho nor returns.
    for report in results.reports.values():
        report["q.proposals.rho"] = math.nan
        del report["returns.unguided"]
    rho, ece, _, gain = figures_of(results, study)["reliability"].axes
    assert [len(line(axes, "PPO-DAP").get_xdata()) for axes in (rho, ece, gain)] == [0, 4, 0]


def test_the_audit_shows_the_worst_run_of_each_method():
    def change(labels):
        bad = labels["arm"] == "PPO-DAP" and labels["seed"] == 1 and labels["task"] == "Ant-v5"
        found = {"spr": 0.5, "oglr": 0.25, "prior_kl": 0.0} if bad else {}
        return found if labels["arm"] != "PPO-ARC" else {"batch_fresh": 0.5 + 0.1 * labels["seed"]}

    study, results, found = drawn("audit", change=change)
    kl, share, spr, oglr, fresh = found["audit"].axes
    names = [text.get_text() for text in kl.get_yticklabels()]
    assert names == [*MAIN[:4], "PPO-ARC (reconstruction)"]
    assert dict(zip(line(spr, "worst").get_ydata(), line(spr, "worst").get_xdata(), strict=True)) == {
        1: 0.5,
        2: 1,
        3: 1,
    }
    assert line(oglr, "worst").get_xdata().tolist() == [0.25, 0, 0]
    assert line(fresh, "worst").get_xdata().tolist() == [1, 1, 1, 1, 0.5]
    rows = results.rows(study)
    assert line(share, "worst").get_xdata()[2] == columns(rows, "PPO-DAP (tuned)", "pgshare").min()
    prior, policy = line(kl, "prior-KL, of its PET"), line(kl, "policy-KL, of an update")
    own = columns(rows, "PPO-DAP", "prior_kl")
    assert len(own[own > 0]) == len(own) - 1
    assert prior.get_xdata()[0] == pytest.approx(own[own > 0].mean())
    assert policy.get_xdata()[0] == pytest.approx(columns(rows, "PPO", "policy_kl").mean())
    assert (len(prior.get_xdata()), len(policy.get_xdata()), kl.get_xscale()) == (3, 5, "log")


def test_a_mean_of_runs_leaves_out_what_is_unknown():
    assert of_runs([None, math.nan]) is None
    dot = of_runs([1.0, None, 3.0, math.nan, 5.0])
    assert dot is not None
    assert (dot.value, dot.n) == (3.0, 3)
    assert (dot.low, dot.high) == pytest.approx(stats.t.interval(0.95, 2, 3, stats.sem([1, 3, 5])))


@pytest.fixture(scope="module")
def smoke():
    """The tiny version of every study, and results of it."""
    study = make_study("smoke")
    results = made_results(study)
    for entry in study.entries:
        if entry.labels["study"] == "fig11":
            results.proposals[entry.cell.name] = [
                {"state": i, "guided": j // 3, "drawn": 1, "q": 0.5 * j, "x": i, "y": j}
                for i in (0, 1)
                for j in range(6)
            ]
    return study, results


def test_every_figure_is_written_twice_to_the_same_bytes_in_both_formats(smoke, tmp_path):
    study, results = smoke
    paths = [
        path
        for part in parts(study)
        if part.name in FIGURES
        for path in FIGURES[part.name](results, part, tmp_path / "one")
    ]
    names = {path.name for path in paths}
    assert {path.name for path in (tmp_path / "one").iterdir()} == names
    files = {"mixed-methods", "mixed-parts", "ablation-alc", "ablation-final"} | DRAWINGS.keys() - {"mixed", "ablation"}
    assert names == {f"{name}.{suffix}" for name in files for suffix in ("svg", "png")}
    for part in parts(study):
        if part.name in ("fig6", "fig11"):
            for path in FIGURES[part.name](results, part, tmp_path / "two"):
                assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
    for path in paths:
        if path.suffix == ".png":  # nothing reaches the edge, where it would be cut off
            pixels = imread(path)
            assert all(edge.min() == 1 for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]))
        content = path.read_bytes()
        assert content[:4] == (b"\x89PNG" if path.suffix == ".png" else b"<?xm")
        assert b"dc:date" not in content


@pytest.mark.parametrize("name", DRAWINGS)
def test_nothing_is_drawn_of_a_study_without_runs(name, tmp_path):
    assert name in STUDIES
    study = make_study(name, scale=SMOKE)
    assert FIGURES[name](Results(), study, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["fig7", "fig8", "fig9", "fig12", "ablation"])
def test_there_is_no_change_without_the_baseline(name):
    study = make_study(name, scale=SMOKE)
    results = made_results(study, done=lambda labels: labels["arm"] != "PPO")
    found = figures_of(results, study)
    if name == "fig12":  # high-Q rate and ESS have no baseline
        assert [len(axes.get_legend_handles_labels()[1]) for axes in found["fig12"].axes] == [0, 0, 1, 1]
    else:
        assert list(found) == (["fig9"] if name == "fig9" and found else [])
