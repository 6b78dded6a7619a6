"""Tables 4 and 5, and what holds for the table of every study."""

import functools
import math
import re

import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.study.results import Results
from ppo_dap.study.store.studies import STUDIES, make_study, only
from ppo_dap.study.tables.effects import command
from ppo_dap.study.tables.studies import TABLES
from ppo_dap.study.tables.table import Table, change_text, difference_text
from study.results_made import Light, made
from study.tables.tables_read import HOPPER, WARM, body, hopper, read


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


def test_seeds_that_had_other_logs_and_processors_are_told(studies):
    def numbers(labels, hashes="ab", processors=("One", "")):
        numbers = table4_numbers(labels)
        if numbers is None or labels["arm"] == "PPO":
            return numbers
        return numbers | {"logs_hash": hashes[labels["seed"] > 0], "processor": processors[labels["seed"] > 1]}

    told = TABLES["table4"](made(studies["table4"], numbers), studies["table4"]).made
    (logs,) = [note for note in told if note.startswith("**Seeds of an arm had different logs**")]
    # Arms with one seed on a task, and PPO, which has no logs, cannot have others.
    assert logs.endswith(
        "PPO-DAP on Hopper-v5 (2 of tier medium-expert); PPO-ARC on Hopper-v5 (2 of tier medium-expert); "
        "PPO-DAP on Pusher-v5 (2 of tier medium-expert)."
    )
    (processors,) = [note for note in told if note.startswith("Made on several processors")]
    assert processors.endswith("One (7 runs), not recorded (8 runs).")

    alike = functools.partial(numbers, hashes="aa", processors=("One", "One"))
    (one,) = TABLES["table4"](made(studies["table4"], alike), studies["table4"]).made[2:]
    assert one.endswith("One (9 runs), not recorded (6 runs).")


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
    title = "Table 5(b): mean return in the last tenth of 1,000,000 steps"
    late = body(table5)[title, "Walker2d-v5, medium-expert", "PPO"]
    assert late["return"] == area  # the curves are flat
    assert "No finished run yet: PPO + BC; PPO-DAP; " in table5.made[1]
    early = body(table5)["Table 5: return after 200,000 steps", "Walker2d-v5, medium-expert", "PPO"]
    assert early["return"] == "1,000 ± 0 (n=8)"
    assert not {"the paper", "its change, p"} & (early.keys() | late.keys())  # it has none of these


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
