"""Logs of several gaits: what was measured, against the clones, and what each part is worth."""

import numpy as np
import pytest
from scipy import stats

from ppo_dap.study.tables.studies import TABLES
from study.results_made import made
from study.tables.tables_read import WARM, body, read


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
    if arm == "PPO-DAP (Ours)":
        return {"alc": 300.0 + seed} | ({"strictly_on_policy": False, "as_declared": False} if seed == 0 else {})
    if arm == "PPO + Flow-prior" and seed < 7:
        return {"alc": 400.0 - seed}
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
    assert audits["PPO-DAP (Ours)"] == "VIOLATED: 1 of 8"
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


def test_the_paper_s_settings_against_the_other_methods(mixed):
    lines = {key: line for key, line in body(mixed).items() if key[0].startswith("PPO-DAP (Ours) with the paper's")}
    assert {key[1] for key in lines} == {
        "PPO",
        "PPO + Flow-prior",
        "PPO-DAP (No-VG)",
        "PPO-ARC",
    }  # those that have runs
    (of,) = (line for key, line in lines.items() if key[1] == "PPO + Flow-prior")
    x, y = 300 + np.arange(7), 400 - np.arange(7)
    assert (of["pairs"], of["p"]) == ("7", f"{stats.wilcoxon(x, y, method='exact').pvalue:.2g}")
    assert of["change"].startswith(f"{x.mean() / y.mean() - 1:+.0%}")


def test_what_a_part_is_worth_is_a_paired_difference(mixed):
    of = body(mixed)[f"What each part of {WARM} is worth", "Hopper-v5", "no guidance"]
    low, high = stats.ttest_1samp([-10, -20, -60], 0).confidence_interval()
    assert of["ALC@40"] == f"-30 ± {(high - low) / 2:.0f} (n=3)"
    assert of["return after 200,000 steps"] == "+4.0 ± 0.0 (n=3)"
    assert of["p of ALC@40"] == of["p of return"] == "cannot be told"
    own = [row for row in read(mixed) if row["method"] == f"{WARM}: no guidance" and row["baseline"] == WARM]
    (row,) = (row for row in own if row["measure"] == "alc")
    assert (float(row["difference"]), row["pairs"]) == (-30.0, "3")
