"""Comparisons with a baseline: from made rows, and from run folders through the command."""

import csv
import functools
import json
import math
import statistics
import warnings

import numpy as np
import pytest
from scipy import stats

from ppo_dap import config as configs
from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.methods import get_method, resolve
from ppo_dap.study.stats.compare import comparable, compare, markdown, overall, print_comparison, save_csv
from ppo_dap.study.stats.measures import interquartile_mean, normalised_score
from ppo_dap.study.stats.pairing import paired_wilcoxon
from ppo_dap.study.stats.summary import label

SEEDS = range(5)
FEW = 200


def row(label, task, seed, alc, last=0.0, steps=200_000, finished=True):
    run = f"runs/{task}-{label}-{seed}"
    made = {"run": run, "label": label, "task": task, "seed": seed, "steps": steps, "finished": finished}
    return made | {"alc": alc, "last_return": last}


def made_rows():
    """Hopper: dap is better on every seed. Swimmer: on some, and returns are below 0."""
    rng = np.random.default_rng(0)
    ppo = {task: rng.normal(mean, 20, 5) for task, mean in (("Hopper-v5", 500), ("Swimmer-v5", -60))}
    gain = {"Hopper-v5": rng.uniform(100, 200, 5), "Swimmer-v5": np.array([9.0, -4, 3, -2, 1])}
    rows = [row("ppo", task, seed, alc[seed]) for task, alc in ppo.items() for seed in SEEDS]
    return rows + [row("dap", task, seed, ppo[task][seed] + gain[task][seed]) for task in ppo for seed in SEEDS]


def column(rows, label, task):
    return np.array([r["alc"] for r in rows if r["label"] == label and r["task"] == task])


def test_figures_of_a_task_against_scipy():
    rows = made_rows()
    found = {(r["task"], r["method"]): r for r in compare(rows, "ppo", ["alc"], FEW)}
    assert list(found) == [(task, method) for task in ("Hopper-v5", "Swimmer-v5") for method in ("ppo", "dap")]
    for task in ("Hopper-v5", "Swimmer-v5"):
        x, y, of = column(rows, "dap", task), column(rows, "ppo", task), found[task, "dap"]
        assert (of["n"], of["pairs"], of["smallest_p"]) == (5, 5, 0.0625)
        low, high = stats.t.interval(0.95, 4, x.mean(), stats.sem(x))
        assert (of["mean"], of["half_width"]) == pytest.approx(((low + high) / 2, (high - low) / 2))
        assert of["p"] == pytest.approx(stats.wilcoxon(x, y, method="exact").pvalue)
        assert of["improvement"] == pytest.approx(stats.mannwhitneyu(x, y).statistic / 25)
        assert of["effect"] == pytest.approx(stats.ttest_rel(x, y).statistic / math.sqrt(5))
        low, high = stats.ttest_rel(x, y).confidence_interval()
        assert (of["difference"], of["difference_half_width"]) == pytest.approx(((low + high) / 2, (high - low) / 2))
        assert of["change"] == pytest.approx((x.mean() - y.mean()) / abs(y.mean()))
        assert of["change_low"] < of["change"] < of["change_high"]
    of, ratios = found["Hopper-v5", "dap"], column(rows, "dap", "Hopper-v5") / column(rows, "ppo", "Hopper-v5")
    assert of["ratio"] == statistics.median(ratios)
    assert min(ratios) <= of["ratio_low"] <= of["ratio"] <= of["ratio_high"] <= max(ratios)
    assert math.isnan(found["Swimmer-v5", "dap"]["ratio"])
    assert found["Swimmer-v5", "dap"]["change"] > 0
    assert found["Hopper-v5", "dap"]["p_holm"] == 2 * found["Hopper-v5", "dap"]["p"] == 0.125
    assert found["Swimmer-v5", "dap"]["p_holm"] == found["Swimmer-v5", "dap"]["p"]
    baseline = found["Hopper-v5", "ppo"]
    assert (baseline["n"], baseline["pairs"]) == (5, 0)
    assert math.isnan(baseline["p"])


def test_pairs_are_by_seed_and_not_by_place():
    rows = made_rows()
    assert compare(rows[::-1], "ppo", ["alc"], FEW)[-1]["p"] == compare(rows, "ppo", ["alc"], FEW)[1]["p"]
    x, y = column(rows, "dap", "Swimmer-v5"), column(rows, "ppo", "Swimmer-v5")
    assert paired_wilcoxon(x, y) != paired_wilcoxon(x, np.roll(y, 1))  # the planted fault would be seen


def test_over_all_tasks():
    rows = made_rows()
    (of,) = overall(rows, "ppo", ["alc"], FEW)
    each = {r["task"]: r["improvement"] for r in compare(rows, "ppo", ["alc"], FEW) if r["method"] == "dap"}
    assert (of["tasks"], of["pairs"], of["normalised_tasks"]) == (2, 10, 1)
    assert of["improvement"] == pytest.approx(np.mean(list(each.values())))
    assert of["improvement_low"] < of["improvement"] < of["improvement_high"] <= 1
    for name, side in (("iqm", "dap"), ("iqm_baseline", "ppo")):
        scores = [normalised_score("Hopper-v5", value) for value in column(rows, side, "Hopper-v5")]
        assert of[name] == pytest.approx(interquartile_mean(scores))
        assert of[f"{name}_low"] <= of[name] <= of[f"{name}_high"]


def test_runs_without_a_partner_count_for_the_mean_alone():
    rows = [*made_rows(), row("dap", "Hopper-v5", 5, 1e6), row("ppo", "Hopper-v5", 6, None)]
    before, after = (
        next(r for r in compare(each, "ppo", ["alc"], FEW) if r["method"] == "dap") for each in (rows[:-2], rows)
    )
    assert (after["n"], after["pairs"], after["p"], after["change"]) == (6, 5, before["p"], before["change"])
    assert after["mean"] > 1e5 > before["mean"]
    assert after["unpaired"] == [
        "dap without ppo, 200,000 steps: seed 5",
        "ppo without alc, 200,000 steps: seed 6",
    ]


def test_a_task_without_the_baseline_has_no_comparison():
    found = compare([row("ppo", "Ant-v5", 0, 1.0), row("dap", "Hopper-v5", 0, 1.0)], "ppo", ["alc"], FEW)
    assert [(r["task"], r["method"], r["pairs"]) for r in found] == [("Ant-v5", "ppo", 0), ("Hopper-v5", "dap", 0)]
    assert overall([row("ppo", "Ant-v5", 0, 1.0), row("dap", "Hopper-v5", 0, 1.0)], "ppo", ["alc"], FEW) == []


def test_an_unfinished_run_is_left_out():
    rows = [*made_rows(), row("dap", "Hopper-v5", 5, 1e6, finished=False)]
    with pytest.warns(UserWarning, match="runs/Hopper-v5-dap-5 is not finished: it is left out"):
        kept = comparable(rows, "ppo")
    assert kept == made_rows()


def test_one_budget_a_task():
    rows = [*made_rows(), row("dap", "Hopper-v5", 5, 1.0, steps=1_000_000)]
    with pytest.raises(InputError, match="runs of Hopper-v5 have 200,000 and 1,000,000 steps: compare runs of one"):
        compare(rows, "ppo")


def test_a_baseline_that_no_run_has():
    with pytest.raises(InputError, match=r"unknown method to compare with.*'poo': did you mean 'ppo'\? known are dap"):
        compare(made_rows(), "poo")


def shown(capsys, rows):
    print_comparison(compare(rows, "ppo", reps=FEW), overall(rows, "ppo", reps=FEW))
    return capsys.readouterr().out


def test_the_table(capsys):
    out = shown(capsys, made_rows())
    assert "ALC@40 against ppo, paired by seed" in out
    assert "last return against ppo" in out
    assert max(map(len, out.splitlines())) <= 120
    line = next(line for line in out.splitlines() if "dap" in line)
    assert "0.062" in line
    assert "0.12" in line
    assert "dap over 2 tasks: P(better) 0." in out
    assert "seed 5" in shown(capsys, [*made_rows(), row("dap", "Hopper-v5", 5, 1.0)])


def test_markdown_is_a_table_with_as_many_cells_in_each_line():
    rows = [row("dap + a=(1|2)", "Hopper-v5", seed, 600.0 + seed, 1.0) for seed in SEEDS]
    text = markdown(compare([*made_rows(), *rows], "ppo", ["alc"], FEW), epochs=10.0)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + 5
    assert {line.replace(r"\|", "").count("|") for line in lines} == {11}
    assert text.startswith("ALC@10 against ppo")


def test_csv(tmp_path):
    rows = compare(made_rows(), "ppo", ["alc"], FEW)
    save_csv(rows, tmp_path / "rows.csv")
    with open(tmp_path / "rows.csv") as file:
        read = list(csv.DictReader(file))
    assert [(r["task"], r["method"], int(r["n"]), float(r["mean"])) for r in read] == [
        (r["task"], r["method"], r["n"], r["mean"]) for r in rows
    ]
    assert read[0]["p"] == ""
    assert float(read[1]["p"]) == rows[1]["p"]


def stored(method="ppo", preset="paper", task="Hopper-v5", prior_hash=None, **options):
    config = resolve(get_method(method), configs.make(preset, **options), options)
    return {
        "task": task,
        "method": method,
        "preset": preset,
        "prior_hash": prior_hash,
        "config": configs.flatten(config),
    }


LABELS = {
    "ppo": stored(seed=3, steps=7, eval_every=0, tensorboard=False),
    "ppo (tuned)": stored(preset="tuned"),
    "ppo + checkpoint_every=5": stored(checkpoint_every=5),
    "ppo-bc": stored("ppo-bc"),
    "ppo-bc + warm_start=actor_critic": stored("ppo-bc", warm_start="actor_critic"),
    "ppo-dap": stored("ppo-dap", prior_hash="af31"),
    "ppo-dap (tuned) + lambda_kl=0.05": stored("ppo-dap", "tuned", lambda_kl=0.05),
    "ppo-dap + top_k=3 + lambda_aux=0.3": stored("ppo-dap", lambda_aux=0.3, top_k=3),
    "ppo-dap-no-vg": stored("ppo-dap-no-vg"),
    "ppo-flow": stored("ppo-flow"),
    "ppo-awr": stored("ppo-awr"),
    "ppo-arc": stored("ppo-arc"),
    "ppo + gamma=0.99": stored(task="Swimmer-v5"),
}


@pytest.mark.parametrize("name", LABELS)
def test_label(name):
    assert label(LABELS[name]) == name


def test_label_of_other_cases():
    assert label(stored(task="Swimmer-v5", gamma=0.9999)) == "ppo"
    random = stored("ppo-dap", guidance="energy", pet_frequency=0, prior_hash="random")
    assert label(random) == "ppo-dap + prior=random"
    of_old = stored("ppo-dap")
    del of_old["config"]["guidance_gate"]
    assert label(of_old | {"config": of_old["config"] | {"gone": 1}}) == "ppo-dap"
    assert label(stored() | {"preset": "gone"}) == "ppo (gone)"


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Four finished runs of two methods, two seeds each, and one that is not finished; the working folder has them."""
    monkeypatch.chdir(tmp_path)
    made = []
    for name, seed, gain in (("ppo", 0, 1.0), ("ppo", 1, 2.0), ("tuned", 0, 4.0), ("tuned", 1, 3.0), ("ppo", 2, 9.0)):
        folder = tmp_path / f"{name}-{seed}"
        folder.mkdir()
        preset = "paper" if name == "ppo" else "tuned"
        (folder / "config.json").write_text(json.dumps(stored(preset=preset, seed=seed, steps=50_000)))
        ends = 25_000 if seed == 2 else 50_000
        rows = ({"env_steps": steps, "return_mean": gain * steps} for steps in (0, ends))
        (folder / "evaluations.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
        measured = {"env_steps": ends, "seconds_iteration": 1.0, "ratio_error_first": 0.0}
        (folder / "metrics.jsonl").write_text(3 * (json.dumps(measured) + "\n"))
        (folder / "audit.json").write_text(json.dumps({"static": []}))
        made.append(str(folder))
    return made


@pytest.fixture
def fair(monkeypatch):
    """These runs were made by hand and have nothing to audit; few resamples do, since types are checked in each."""
    for function in (compare, overall):
        few = functools.partial(function, reps=FEW)
        monkeypatch.setattr(f"ppo_dap.study.stats.compare.{function.__name__}", few)
    monkeypatch.setattr("ppo_dap.training.run.Run.verdict", lambda run: (True, True))


@pytest.mark.usefixtures("fair")
def test_the_command(capsys, folders, tmp_path):
    command = ["summary", *folders[:4], "--epochs", "10", "--compare", "ppo"]
    assert main([*command, "--json", "--csv", "out.csv"]) == 0
    found = json.loads(capsys.readouterr().out)
    by_name = {(r["metric"], r["method"]): r for r in found["tasks"]}
    # A line through 0 has its mean in the middle: 25,000 times its slope.
    assert by_name["alc", "ppo"]["mean"] == pytest.approx(37_500)
    assert by_name["alc", "ppo (tuned)"]["change"] == pytest.approx(7 / 3 - 1)
    assert by_name["last_return", "ppo (tuned)"]["p"] == by_name["alc", "ppo (tuned)"]["smallest_p"] == 0.5
    assert by_name["alc", "ppo"]["p"] is None
    assert len((tmp_path / "out.csv").read_text().splitlines()) == 1 + len(by_name)
    assert main([*command, "--markdown"]) == 0
    assert "| Hopper-v5 | ppo (tuned) | 2 |" in capsys.readouterr().out
    assert main(command) == 0
    assert "ALC@10 against ppo, paired by seed" in capsys.readouterr().out


@pytest.mark.usefixtures("fair")
def test_the_command_leaves_out_what_is_not_finished(capsys, folders):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["summary", *folders, "--epochs", "5", "--compare", "ppo", "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == f"ppo-dap: warning: {folders[4]} is not finished: it is left out\n"
    assert {r["n"] for r in json.loads(captured.out)["tasks"]} == {2}


@pytest.mark.usefixtures("fair")
def test_a_run_that_has_only_begun_is_summarised(capsys, folders, tmp_path):
    """No evaluation yet, and no iteration after the compiling ones: nothing to divide by."""
    (tmp_path / "ppo-0" / "evaluations.jsonl").write_text("")
    (tmp_path / "ppo-0" / "metrics.jsonl").write_text("")
    assert main(["summary", folders[0], "--epochs", "10", "--json"]) == 0
    begun = json.loads(capsys.readouterr().out)[0]
    assert [begun[name] for name in ("last_return", "alc", "finished", "wall_x_ppo")] == [None, None, False, None]
    assert main(["summary", folders[0], "--epochs", "10"]) == 0
    assert "Hopper-v5" in capsys.readouterr().out


@pytest.mark.usefixtures("fair")
def test_the_table_names_what_is_not_finished(capsys, folders):
    assert main(["summary", *folders, "--epochs", "5"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "not finished" in line]
    assert lines == [f"not finished: {folders[4]}, which is to have 50,000 steps"]


@pytest.mark.usefixtures("fair")
def test_rows_of_runs_as_csv(folders, tmp_path):
    assert main(["summary", *folders, "--epochs", "10", "--csv", "runs.csv"]) == 0
    with open(tmp_path / "runs.csv") as file:
        read = list(csv.DictReader(file))
    assert [(r["label"], r["seed"], r["finished"]) for r in read][2:] == [
        ("ppo (tuned)", "0", "True"),
        ("ppo (tuned)", "1", "True"),
        ("ppo", "2", "False"),
    ]
    assert read[4]["alc"] == ""


@pytest.mark.usefixtures("fair")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--markdown",), "--markdown prints a comparison: give --compare METHOD"),
        (("--compare", "ppo-dap"), "unknown method to compare with"),
        (("--compare", "ppo", "--epochs", "nan"), "--epochs"),
    ],
)
def test_bad_input_of_the_command(capsys, folders, options, words):
    assert main(["summary", *folders[:4], *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
