"""Figures of mixed logs and of 5.5, 5.7 and 5.8."""

import math

import numpy as np
import pytest
from scipy import stats

from ppo_dap.study.figures.studies import figures_of
from ppo_dap.study.plots.drawing import MAIN
from study.figures.figures_drawn import columns, drawn, line


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
