"""The tables of the paper, from runs whose numbers are made up: what stands in a cell, and what must not."""

import csv
import dataclasses
import functools
import io
import math
import re

import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.study import effects
from ppo_dap.study.effects import command
from ppo_dap.study.results import Results
from ppo_dap.study.studies import SMOKE, STUDIES, make_study, only
from ppo_dap.study.table import Table, change_text, difference_text
from ppo_dap.study.tables import TABLES
from study.results_made import Light, made

WARM = "PPO-DAP (tuned-warm)"


@pytest.fixture(scope="module")
def studies():
    """Grids as they are declared; what a command declares is compared with these as well."""
    tiny = {f.name: getattr(SMOKE, f.name) for f in dataclasses.fields(SMOKE)}
    found = {name: make_study(name, scale=Light()) for name in STUDIES}
    found["smoke"] = make_study("smoke", scale=Light(**tiny))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(effects, "make_study", found.__getitem__)
        yield found


@pytest.fixture
def smoke(studies):
    """All studies at once: one task, one preset, the ends of each axis."""
    return studies["smoke"]


def body(table):
    """The lines of each table by what stands in their words, and the heads."""
    found = {}
    for part in (table, *table.more):
        for line in part.lines:
            found[(part.title, *line[: part.words])] = dict(zip(part.columns, line, strict=True))
    return found


def read(table):
    return list(csv.DictReader(io.StringIO(table.csv())))


def hopper(label, seed=None):
    return label["task"] == "Hopper-v5" and seed in (None, label["seed"])


# Table 4.

HOPPER = {"PPO": (100, 110, 120), "PPO-DAP": (150, 120, 180), "PPO-ARC": (140, 150, 160)}


def table4_numbers(labels):
    arm, seed = labels["arm"], labels["seed"]
    if hopper(labels) and arm in HOPPER:
        return {"last_return": float(HOPPER[arm][seed])}
    if labels["task"] == "Pusher-v5" and arm in ("PPO", "PPO-DAP") and seed < 2:
        return {"last_return": {"PPO": -50.0, "PPO-DAP": -40.0}[arm] + seed}
    if labels["task"] == "Swimmer-v5" and arm in ("PPO", "PPO-DAP") and seed == 0:
        return {"last_return": {"PPO": 40.0, "PPO-DAP": 50.0}[arm]}
    return None


@pytest.fixture(scope="module")
def table4(studies):
    return TABLES["table4"](made(studies["table4"], table4_numbers), studies["table4"])


def test_table_4_has_the_papers_returns_above_ours(table4):
    title = "Table 4: return after 1,000,000 steps"
    lines = body(table4)
    assert lines[title, "Hopper-v5", "the paper"]["PPO-DAP"] == "1,542.9 ± 113.4"
    low, high = stats.t.interval(0.95, 2, 150, stats.sem(HOPPER["PPO-DAP"]))
    assert lines[title, "Hopper-v5", "ours"]["PPO-DAP"] == f"150 ± {(high - low) / 2:.0f} (n=3)"
    assert lines[title, "Swimmer-v5", "ours"]["PPO-DAP"] == "50.0 (n=1)"
    assert lines[title, "Ant-v5", "ours"]["PPO"] == lines[title, "Hopper-v5", "ours"]["ABPPO"] == ""
    assert lines[title, "Hopper-v5", "the paper"][WARM] == ""
    assert table4.made[0] == "`ppo-dap study table4`: 1,000,000 steps, seeds 0-2; 15 of 168 runs are finished."
    assert table4.made[1] == f"No finished run yet: PPO-DAP (tuned); {WARM}; PPO-GC; ABPPO."


def test_changes_are_over_the_absolute_value_and_are_not_told_by_few_pairs(table4):
    lines = body(table4)
    of = lines["Table 4: change over PPO", "PPO-DAP", "Hopper-v5"]
    assert of["ours"].startswith("+36% [")  # 150 over 110
    assert (of["the paper"], of["pairs"], of["least p"]) == ("+7.9%", "3", "0.25")
    assert (of["p"], of["Holm p"]) == ("cannot be told", "")
    # The baseline is below 0: -39.5 is better than -49.5, by 10 of 49.5.
    assert lines["Table 4: change over PPO", "PPO-DAP", "Pusher-v5"]["ours"].startswith("+20%")
    one = lines["Table 4: change over PPO", "PPO-DAP", "Swimmer-v5"]
    assert (one["ours"], one["pairs"], one["P(better)"], one["least p"]) == ("+25%", "1", "", "1")
    assert not [key for key in lines if key[0] == "Table 4: change over PPO" and "Ant-v5" in key]


def test_table_4_over_the_tasks(table4):
    of = body(table4)["Table 4: against PPO, over the tasks", "PPO-DAP"]
    assert (of["tasks"], of["best on"]) == ("3", "")  # no task has all five methods
    # Hopper 8.5 of 9 pairs (120 ties once), the others always.
    assert of["P(better)"].startswith(f"{(8.5 / 9 + 2) / 3:.2f} ") or of["P(better)"] == f"{(8.5 / 9 + 2) / 3:.2f}"


def test_best_counts_tasks_on_which_all_have_runs(studies):
    def numbers(labels):
        if labels["task"] not in ("Ant-v5", "Hopper-v5", "Walker2d-v5") or labels["seed"]:
            return None
        if (labels["task"], labels["arm"]) == ("Walker2d-v5", "ABPPO"):
            return None
        height = {"PPO-DAP": 2.0, WARM: 1.0, "PPO-GC": 2.0 if labels["task"] == "Ant-v5" else 3.0}
        return {"last_return": height.get(labels["arm"], 0.5)}

    lines = body(TABLES["table4"](made(studies["table4"], numbers), studies["table4"]))
    title = "Table 4: against PPO, over the tasks"
    assert lines[title, "PPO-DAP"]["best on"] == "1 of 2"  # a tie on Ant, less on Hopper, Walker2d lacks one
    assert lines[title, WARM]["best on"] == "0 of 2"
    assert lines[title, "PPO-GC"]["best on"] == ""


# Table 5.


def gains():
    """Seeds by area, of PPO and of what is held against it: all above on one task, some below on another."""
    rng = np.random.default_rng(5)
    ppo = {task: rng.normal(500, 50, 8) for task in ("Walker2d-v5", "Hopper-v5")}
    dap = {"Walker2d-v5": ppo["Walker2d-v5"] + rng.uniform(10, 90, 8), "Hopper-v5": rng.normal(510, 50, 8)}
    return {"PPO": ppo, "PPO-DAP (tuned)": dap}


@pytest.fixture(scope="module")
def table5(studies):
    def numbers(labels):
        area = gains().get(labels["arm"], {}).get(labels["task"])
        if area is None or (labels["part"] == "full" and labels["seed"]):
            return None
        return {"alc": float(area[labels["seed"]]), "last_return": 1000.0 if labels["part"] == "early" else 3000.0}

    return TABLES["table5"](made(studies["table5"], numbers), studies["table5"])


def test_table_5_tests_pairs_exactly_and_corrects_over_settings(table5):
    title, arm, made_up = "Table 5(a): ALC@40, runs of 200,000 steps", "PPO-DAP (tuned)", gains()
    p = {t: stats.wilcoxon(made_up[arm][t], x, method="exact").pvalue for t, x in made_up["PPO"].items()}
    assert p["Walker2d-v5"] == 2 / 2**8 < 0.05 < p["Hopper-v5"]
    of = body(table5)[title, "Walker2d-v5, medium-expert", arm]
    assert (of["p"], of["Holm p"], of["least p"], of["pairs"]) == ("0.0078", "0.016", "0.0078", "8")
    assert (of["the paper"], of["its change, p"]) == ("2,050 ± 85", "+7.9%, 0.038")
    x, y = made_up[arm]["Walker2d-v5"], made_up["PPO"]["Walker2d-v5"]
    assert of["change over PPO"].startswith(f"{x.mean() / y.mean() - 1:+.0%} [+")
    assert of["ALC@40"] == f"{x.mean():.0f} ± {stats.sem(x) * stats.t.ppf(0.975, 7):.0f} (n=8)"
    other = body(table5)[title, "Hopper-v5, medium-expert", arm]
    assert float(other["p"]) == float(other["Holm p"]) == pytest.approx(p["Hopper-v5"], rel=0.05)
    assert (
        other["P(better)"].split()[0]
        == f"{stats.mannwhitneyu(*(made_up[a]['Hopper-v5'] for a in (arm, 'PPO'))).statistic / 64:.2f}"
    )
    assert body(table5)[title, "Hopper-v5, medium-expert", "PPO"]["change over PPO"] == ""


def test_final_returns_are_those_of_the_long_runs(table5):
    for part in ("Table 5(a): ALC@40, runs of 1,000,000 steps", "Table 5(b): return after 1,000,000 steps"):
        keys = [key for key in body(table5) if key[0] == part]
        assert len(keys) == 4  # two settings, two arms
    of = body(table5)["Table 5(b): return after 1,000,000 steps", "Walker2d-v5, medium-expert", "PPO"]
    assert (of["return"], of["the paper"]) == ("3,000 (n=1)", "2,850 ± 110")
    area = body(table5)["Table 5(a): ALC@40, runs of 1,000,000 steps", "Walker2d-v5, medium-expert", "PPO"]["ALC@40"]
    assert area == f"{gains()['PPO']['Walker2d-v5'][0]:.0f} (n=1)"
    assert "No finished run yet: PPO + BC; PPO-DAP; " in table5.made[1]


# Tables 6 and 7.


def test_table_6_holds_costs_against_no_pet_and_gains_against_ppo(studies):
    def numbers(labels):
        if labels["seed"] == 2 or labels.get("f") == 5:
            return None
        tuned, f = labels["preset"] == "tuned", labels.get("f", -1)
        seconds = {-1: 1.0, 0: 4.0, 10: 5.0, 20: 8.0}[f] * (10 if tuned else 1)
        # The seconds of all attempts are no cost: one may have been killed half-way.
        own = {"env_steps": 2000, "seconds_iteration": seconds, "seconds": 1e6 * (f + 2)}
        own |= {
            "peak_mib": 0.0 if tuned and labels["seed"] else 100.0 + f,
            "alc": 1000.0 + 100 * (f > 0),
            "last_return": 100.0 + f,
        }
        return own

    table = TABLES["table6"](made(studies["table6"], numbers), studies["table6"])
    lines, title = body(table), "Table 6: PET on Walker2d-v5, medium-expert"

    def of(measure, setting="PET f=10"):
        return tuple(lines[title, measure, setting][head] for head in ("the paper", "ours, `paper`", "ours, `tuned`"))

    assert of("wall-clock x No-PET") == ("1.17", "1.25 (n=2)", "1.25 (n=2)")
    assert of("wall-clock x No-PET", "PET f=20") == ("1.22", "2.00 (n=2)", "2.00 (n=2)")
    assert of("steps per second x No-PET") == ("", "0.80 (n=2)", "0.80 (n=2)")
    assert of("peak memory x No-PET") == ("1.05", "1.10 (n=2)", "1.10 (n=1)")  # 0 MiB: not measured
    assert of("return after 1,000,000 steps: change over PPO") == ("+7.7%", "+11% (n=2)", "+11% (n=2)")  # 110 over 99
    assert of("ALC@40: change over No-PET") == ("+2.4%", "+10% (n=2)", "+10% (n=2)")
    assert of("ALC@40", "PPO") == ("1,900 ± 90", "1,000 ± 0 (n=2)", "")
    assert of("ALC@40", "PET f=5") == ("2,120 ± 82", "", "")
    assert (title, "wall-clock x No-PET", "PPO") not in lines
    assert {row["method"] for row in read(table) if row["measure"] == "ALC@40"} >= {
        "PET f=10",
        "PET f=10 (tuned)",
        "PPO",
    }


def test_table_7_is_the_mean_over_tasks_and_their_spread(studies):
    ratio = {"Ant-v5": 1.1, "Hopper-v5": 1.3}

    def numbers(labels):
        if labels["task"] not in ratio or labels["arm"] not in ("PPO", "PPO-DAP"):
            return None
        dap, base = labels["arm"] == "PPO-DAP", 1.0 + labels["seed"]
        own = {"env_steps": 1000, "seconds_iteration": base * (ratio[labels["task"]] if dap else 1)}
        own["peak_mib"] = None if dap and labels["task"] == "Ant-v5" else 500.0 if dap else 400.0
        return own | ({"seconds_proposals": own["seconds_iteration"] / 4, "seconds_pet": 0.0} if dap else {})

    table = TABLES["table7"](made(studies["table7"], numbers), studies["table7"])
    lines, title = body(table), "Table 7: cost over the tasks"
    of = lines[title, "PPO-DAP", "ours, `paper`"]
    assert of["wall-clock x PPO"] == "1.20 ± 0.14"  # 0.2 / sqrt 2
    # Means of 1, 1/2 and 1/3 steps a second, over PPO's: 1/1.1 and 1/1.3.
    assert of["steps per second x PPO"] == f"{(1 / 1.1 + 1 / 1.3) / 2:.2f} ± {(1 / 1.1 - 1 / 1.3) / math.sqrt(2):.2f}"
    assert of["peak memory x PPO"] == "1.25 (1 of 2 tasks)"
    assert (of["tasks"], of["runs"], of["sampling"], of["PET"]) == ("2", "6", "25.0% ± 0.0%", "0.0% ± 0.0%")
    assert lines[title, "PPO-DAP", "the paper"]["wall-clock x PPO"] == "1.18 ± 0.04"
    assert lines[title, "No-VG", "the paper, as Diffusion-NoVG"]["steps per second x PPO"] == "0.89 ± 0.03"
    ppo = lines[title, "PPO", "ours, `paper`"]
    assert (ppo["wall-clock x PPO"], ppo["sampling"]) == ("1.00 ± 0.00", "")
    assert (title, "PPO-DAP", "ours, `tuned`") not in lines
    by_task = lines["Table 7: wall-clock x PPO by task", "PPO-DAP"]
    assert (by_task["Ant-v5"], by_task["Walker2d-v5"]) == ("1.10 (n=3)", "")


# Logs of several gaits.


def mixed_numbers(labels):
    arm, seed, task = labels["arm"], labels["seed"], labels["task"]
    if task != "Hopper-v5":
        return None
    base = 1000.0 + 37 * seed
    if arm == WARM:
        return {"alc": base, "last_return": base, "seconds_iteration": 3.0}
    if arm == "PPO":
        return {"alc": 100.0, "last_return": 100.0 + seed}
    if arm == "PPO + BC":
        return {"alc": base - 10 - seed**2, "last_return": base + (-1) ** seed * (5 + seed)}
    if arm == f"{WARM}: no guidance":
        return {"alc": base - [10, 20, 60][seed], "last_return": base + 4}
    if arm == "PPO-DAP (Ours)" and seed == 0:
        return {"strictly_on_policy": False, "as_declared": False}
    if arm == "PPO-DAP (No-VG)" and seed < 2:
        return {"strictly_on_policy": bool(seed), "as_declared": bool(seed)}
    if arm == "PPO-ARC":
        return {"strictly_on_policy": False}
    return None


@pytest.fixture(scope="module")
def mixed(studies):
    return TABLES["mixed"](made(studies["mixed"], mixed_numbers), studies["mixed"])


def test_a_violated_audit_is_shown_as_such(mixed):
    audits = {key[2]: line["audit"] for key, line in body(mixed).items() if key[0] == "Logs of several gaits"}
    assert audits["PPO-DAP (Ours)"] == "VIOLATED"
    assert audits["PPO-DAP (No-VG)"] == "VIOLATED: 1 of 2"  # one that holds does not outvote it
    assert audits["PPO-ARC"] == "not, as declared"
    assert audits[WARM] == "strictly on-policy"


def test_mixed_tells_what_was_measured_and_what_it_cost(mixed):
    of = body(mixed)["Logs of several gaits", "Hopper-v5", WARM, "tuned-warm"]
    assert (of["n"], of["wall-clock x PPO"]) == ("8", "1.50")
    x = 1000 + 37 * np.arange(8)
    assert of["ALC@40"] == f"{x.mean():,.0f} ± {stats.sem(x) * stats.t.ppf(0.975, 7):,.0f}"
    assert not [key for key in body(mixed) if "Walker2d-v5" in key]
    assert "PPO + BC (best 30%)" in mixed.made[1]


def test_the_whole_against_a_clone(mixed):
    seeds, title = np.arange(8), f"{WARM} against clones and PPO"
    of = body(mixed)[title, "PPO + BC", "ALC@40", "Hopper-v5"]
    assert (of["p"], of["Holm p"], of["pairs"]) == ("0.0078", "0.0078", "8")
    last = body(mixed)[title, "PPO + BC", "return after 200,000 steps", "Hopper-v5"]
    p = stats.wilcoxon(-((-1.0) ** seeds) * (5 + seeds), method="exact").pvalue
    assert last["p"] == f"{p:.2g}"
    assert {key[1] for key in body(mixed) if key[0] == title} == {"PPO + BC", "PPO"}


def test_what_a_part_is_worth_is_a_paired_difference(mixed):
    of = body(mixed)[f"What each part of {WARM} is worth", "Hopper-v5", "no guidance"]
    low, high = stats.ttest_1samp([-10, -20, -60], 0).confidence_interval()
    assert of["ALC@40"] == f"-30 ± {(high - low) / 2:.0f} (n=3)"
    assert of["return after 200,000 steps"] == "+4.0 ± 0.0 (n=3)"
    assert of["p of ALC@40"] == of["p of return"] == "cannot be told"
    own = [row for row in read(mixed) if row["method"] == f"{WARM}: no guidance" and row["baseline"] == WARM]
    (row,) = (row for row in own if row["measure"] == "alc")
    assert (float(row["difference"]), row["pairs"]) == (-30.0, "3")


# Sections 5.5 to 5.8.


def test_the_audit_is_at_its_worst_over_iterations_and_runs(studies):
    def numbers(labels):
        if labels["task"] not in ("Ant-v5", "Hopper-v5") or labels["seed"] == 2:
            return None
        own = {"pgshare": 0.5 + 0.1 * labels["seed"], "pgshare_mean": 0.9 + 0.04 * labels["seed"]}
        own |= {"policy_kl": 0.01, "prior_kl": 0.001 * (1 + labels["seed"])}
        if labels["arm"] == "PPO":
            own |= {"oglr": None, "spr": None, "prior_kl": None}
        if labels["arm"] == "PPO-ARC":
            own |= {"strictly_on_policy": False, "batch_fresh": 0.5}
        if labels["arm"] == "PPO-DAP" and hopper(labels, 1):
            own |= {"strictly_on_policy": False, "as_declared": False, "oglr": 0.25, "spr": 0.75}
        return own

    lines = body(TABLES["audit"](made(studies["audit"], numbers), studies["audit"]))
    title = "5.8: strict on-policy audit"
    bad = lines[title, "PPO-DAP"]
    assert (bad["OGLR, largest"], bad["SPR, smallest"], bad["verdict"]) == ("0.25", "0.75", "VIOLATED: 1 of 4")
    assert lines["5.8 by task", "Hopper-v5", "PPO-DAP"]["verdict"] == "VIOLATED: 1 of 2"
    assert lines["5.8 by task", "Ant-v5", "PPO-DAP"]["verdict"] == "strictly on-policy"
    good = lines[title, "PPO-DAP (tuned)"]
    assert (good["PGShare, smallest"], good["PGShare, mean"]) == ("0.50", "0.92")
    assert (good["policy-KL"], good["prior-KL"], good["prior-KL / policy-KL"]) == ("0.01", "0.0015", "0.15")
    assert (good["n"], good["tasks"]) == ("4", "2")
    assert lines[title, "PPO-ARC"]["verdict"] == "not, as declared"
    assert lines[title, "PPO-ARC"]["fresh rows, smallest"] == "0.5"
    assert (lines[title, "PPO"]["OGLR, largest"], lines[title, "PPO"]["prior-KL"]) == ("", "")
    assert lines[title, "the paper"]["PGShare, mean"] == "0.9 to 1"


def test_reliability_is_the_mean_of_reports(studies):
    def numbers(labels):
        if labels["part"] != "report":
            return {}
        if labels["arm"] != "PPO-DAP" or labels["seed"] == 2:
            return None
        if labels["task"] == "HumanoidStandup-v5":  # no rollouts: no rho, no returns
            return {"monte_carlo": False, "q.proposals.rho": math.nan, "q.all.mae": 0.25}
        rho = 0.1 + 0.2 * labels["seed"]
        return {"monte_carlo": True, "q.proposals.rho": rho, "returns.reweighted": 2.5, "returns.unguided": 2.0}

    table = TABLES["reliability"](made(studies["reliability"], numbers), studies["reliability"])
    lines, title = body(table), "5.7: reliability of value guidance"
    of = lines[title, "Hopper-v5, medium-expert", "PPO-DAP"]
    assert of["rho"] == f"0.20 ± {0.1 * stats.t.ppf(0.975, 1):.2f}"
    assert (of["n"], of["reweighted - unguided"], of["MAE"]) == ("2", "+0.500 ± 0.000", "")
    other = lines[title, "HumanoidStandup-v5, medium-expert (no rollouts)", "PPO-DAP"]
    assert (other["rho"], other["reweighted - unguided"], other["MAE"]) == ("", "", "0.250 ± 0.000")
    assert table.made[0].endswith("48 of 48 runs are finished, and 8 of 48 reports.")


def test_mitigations_are_held_against_narrow_logs_alone(studies):
    heights = {
        "PPO": 1.0,
        "wide logs": 4.0,
        "narrow logs": 2.0,
        "narrow logs: all four": 3.0,
        "narrow logs: alpha 0.2": 1.5,
    }

    def numbers(labels):
        if labels["arm"] not in heights or labels["seed"] == 2:
            return None
        return {"alc": heights[labels["arm"]] + 0.1 * labels["seed"], "high_q_rate": 0.2, "ess": 7.0 + hopper(labels)}

    lines = body(TABLES["coverage"](made(studies["coverage"], numbers), studies["coverage"]))
    title = "5.6: coverage of the logs, and what is recommended for narrow ones"
    head = "P(better than narrow logs alone)"
    assert lines[title, "narrow logs: all four", "paper"][head] == "1.00 (n=8)"  # four settings, two seeds
    assert lines[title, "narrow logs: alpha 0.2", "paper"][head] == "0.00 (n=8)"
    assert lines[title, "narrow logs", "paper"][head] == lines[title, "wide logs", "paper"][head] == ""
    assert lines[title, "wide logs", "paper"]["ESS"] == "7.2 ± 0.5"  # 7, 7, 8 and 7
    of = lines["By setting", "Hopper-v5, medium-expert", "wide logs", "paper"]
    assert (of["ALC@40: change over PPO"][:5], of["ESS"], of["n"]) == ("+286%", "8.0 ± 0.0", "2")


def test_ablations_are_held_against_ppo_and_against_the_whole(studies):
    whole, half = "diffusion / energy+gradient / f=10", "diffusion / energy / f=10"
    areas = {"PPO": (10, 11, 12), whole: (15, 30, 20), half: (14, 16, 40), f"{half} (tuned)": (1, 1, 1)}

    def numbers(labels):
        if labels["arm"] not in areas or labels["task"] == "Walker2d-v5":
            return None
        own = {"alc": float(areas[labels["arm"]][labels["seed"]]), "acceptance": 0.5 + 0.2 * hopper(labels)}
        return own | {"seconds_iteration": 1.0 if labels["arm"] == "PPO" else 1.2}

    lines = body(TABLES["ablation"](made(studies["ablation"], numbers), studies["ablation"]))
    of = lines["5.5: prior, guidance and PET by ALC@40", half, "paper"]
    u = stats.mannwhitneyu(areas[half], areas[whole]).statistic / 9
    assert of["P(better than the whole)"].split()[0] == f"{u:.2f}"
    assert of["P(better than the whole)"].endswith("(n=6)")
    assert of["P(better than PPO)"] == "1.00 (n=6)"
    assert of["Walker2d-v5: change over PPO"] == ""
    assert of["Hopper-v5: change over PPO"].startswith("+112% [")  # 70 over 33
    alone = lines["5.5: prior, guidance and PET by ALC@40", half, "tuned"]
    assert alone["P(better than the whole)"] == ""  # the whole has no run in this preset
    cost = lines["5.5: cost and stability", half, "paper"]
    assert (cost["wall-clock x PPO"], cost["acceptance"]) == (
        "1.20 ± 0.00 (2 of 3 tasks)",
        "0.60 ± 0.14 (2 of 3 tasks)",
    )


def test_figure_10_has_differences_to_no_pet_of_the_same_preset(studies):
    def numbers(labels):
        lift = {"No-PET": 0.0, "No-PET (tuned)": 500.0, "PET f=20": 250.0}.get(labels["arm"])
        return None if lift is None else {"last_return": 1000.0 + lift + 10 * labels["seed"]}

    lines = body(TABLES["fig10"](made(studies["fig10"], numbers), studies["fig10"]))
    title = "Fig. 10: PET frequency, HalfCheetah-v5, medium-replay"
    assert lines[title, "PET f=20", "paper"]["difference to No-PET"] == "+250 ± 0 (n=8)"
    assert lines[title, "No-PET", "tuned"]["difference to No-PET"] == ""
    assert lines[title, "PET f=20", "paper"]["change over PPO"] == ""  # PPO has no run


def test_figures_7_and_9_tell_their_axes(studies):
    def numbers(labels):
        return {"alc": 200.0 if labels["method"] == "ppo" else 300.0} if labels["seed"] == 0 else None

    lines = body(TABLES["fig7"](made(studies["fig7"], numbers), studies["fig7"]))
    of = lines["Fig. 7: change over PPO", "ALC@40", "Walker2d-v5, medium-expert"]
    assert (of["the paper"], of["PPO-DAP"]) == ("+7.9%", "+50% (n=1)")
    assert sum(key[1] == "return after 1,000,000 steps" for key in lines) == 8
    budgets = [key[2:] for key in body(TABLES["fig9"](made(studies["fig9"], numbers), studies["fig9"]))]
    assert budgets[:4] == [("K=5", "paper"), ("K=5", "tuned"), ("K=10", "paper"), ("K=10", "tuned")]
    assert budgets[-1] == ("share=1", "tuned")


# All of them.


def sound(table):
    """Every line has the columns of its head, nothing is a NaN, and the CSV can be read."""
    text = table.markdown()
    for block in re.findall(r"(?:^\|.*\n?)+", text, re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1
    assert not re.search(r"\bnan\b|None|\binf\b|<lambda>", text + table.csv())
    assert all(row["table"] for row in read(table))
    return text


def numbers_of_all(labels):
    return {"alc": 5.0 + labels["seed"], "last_return": 9.0 - labels["seed"], "ess": 3.0, "monte_carlo": True}


@pytest.mark.parametrize("name", TABLES)
def test_a_study_that_is_not_finished_has_a_table(smoke, name):
    assert sound(TABLES[name](Results(), smoke)).count("No finished run tells of it yet.") >= 1
    first = next(e.cell.name for e in smoke.entries if e.labels["study"] == name)
    every = made(smoke, numbers_of_all)
    one = Results({first: every.runs[first]}, {first: every.curves[first]})
    assert "; 1 of " in sound(TABLES[name](one, smoke))


@pytest.mark.parametrize("name", TABLES)
def test_a_study_among_others_has_its_table(smoke, name):
    text = sound(TABLES[name](made(smoke, numbers_of_all), smoke))
    assert "`ppo-dap study smoke`" in text
    assert "No finished run" not in text or name == "mixed"  # PPO-DAP of `paper` in the tables of costs, not here
    assert "Hopper-v5" in text or name == "fig8"


def test_another_study_is_refused(studies):
    with pytest.raises(InputError, match="study table5 has no runs of mixed part early: take study mixed, or all"):
        TABLES["mixed"](Results(), studies["table5"])
    with pytest.raises(InputError, match="study table5 has no runs of table4 part full"):
        TABLES["table4"](Results(), studies["table5"])


def test_every_study_has_a_table():
    assert TABLES.keys() == STUDIES.keys()


def test_the_command_says_what_differs_from_the_declared_study(studies):
    fig6 = functools.partial(make_study, "fig6", scale=Light())
    assert command(studies["fig6"]) == "ppo-dap study fig6"
    assert command(fig6(seeds=(0, 1, 5), steps=5000)) == "ppo-dap study fig6 --seeds 0,1,5 --steps 5000"
    assert command(fig6(seeds=range(8))) == "ppo-dap study fig6 --seeds 0-7"
    assert command(only(studies["fig6"], {"arm": ["PPO"]})) == "ppo-dap study fig6"


def test_texts_of_a_table():
    table = Table(
        "a", ["one", "two"], [["x|y", "1"]], [{"n": 1, "of": [1, 2], "none": None, "nan": math.nan}], ["read so"]
    )
    whole = Table("b", ["one"], [], [], ["hidden"], made=["`command`"], more=[table])
    assert whole.markdown() == (
        "**b**\n\nNo finished run tells of it yet.\n\n- `command`\n\n"
        "**a**\n\n| one | two |\n| --- | ---: |\n| x\\|y | 1 |\n\n- read so"
    )
    assert whole.csv() == "table,n,of,none,nan\na,1,1; 2,,\n"
    assert Table("c", ["one"], [], []).csv() == "table\n"
    # An interval that is a point tells nothing, and a change that rounds to nothing has no sign.
    row = {"change": -0.001, "change_low": -0.001, "change_high": -0.001, "pairs": 3}
    assert change_text(row) == "+0% (n=3)"
    assert difference_text({"difference": -3.0, "difference_half_width": math.nan, "pairs": 1}) == "-3.0 (n=1)"
