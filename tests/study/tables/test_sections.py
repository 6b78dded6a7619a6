"""Tables of 5.5 to 5.8, and those beside figures."""

import math

from scipy import stats

from ppo_dap.study.tables.studies import TABLES
from study.results_made import made
from study.tables.tables_read import body, hopper


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
        area = 200.0 if labels["method"] == "ppo" else 100.0 * labels.get("K", 3)
        return {"alc": area} if labels["seed"] == 0 else None

    lines = body(TABLES["fig7"](made(studies["fig7"], numbers), studies["fig7"]))
    of = lines["Fig. 7: change over PPO", "ALC@40", "Walker2d-v5, medium-expert"]
    assert (of["the paper"], of["PPO-DAP"]) == ("+7.9%", "+50% (n=1)")
    assert sum(key[1] == "return after 1,000,000 steps" for key in lines) == 8
    lines = body(TABLES["fig9"](made(studies["fig9"], numbers), studies["fig9"]))
    of = lines["Fig. 9: proposal budget", "Hopper-v5, medium-expert", "K=20", "tuned"]
    assert (of["ALC@40"], of["ALC@40: change over PPO"]) == ("2,000 (n=1)", "+900% (n=1)")
    budgets = [key[2:] for key in lines]
    assert budgets[:4] == [("K=5", "paper"), ("K=5", "tuned"), ("K=10", "paper"), ("K=10", "tuned")]
    assert budgets[-1] == ("share=1", "tuned")
