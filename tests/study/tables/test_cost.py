"""Tables 6 and 7: costs and gains."""

import math

from ppo_dap.study.tables.studies import TABLES
from study.results_made import made
from study.tables.tables_read import body, read


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
