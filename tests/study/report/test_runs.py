"""What the page says of its runs: who leads, what is compared, who is left out."""

import shutil
import warnings

import numpy as np
from scipy import stats

from ppo_dap.cli import main
from ppo_dap.study.report import runs as report_runs
from study.report.report_made import STEPS, evaluations, make_run
from study.report.report_read import Page, made, written


def lead(folders, metric="alc"):
    return report_runs.leader(report_runs.read_runs(folders, 10.0).entries, metric)


def test_a_lead_is_tested_on_pairs(tmp_path):
    found = lead(made(tmp_path, (500, 900, 880)))
    x, y = ([alc_of(height, seed) for seed in range(7)] for height in (900, 880))
    assert (found.first, found.second) == ("ppo + learning_rate=0.002", "ppo + learning_rate=0.003")
    assert found.figure.startswith(f"{np.mean(x):,.0f} +- ")
    p = stats.wilcoxon(x, y, method="exact").pvalue
    assert found.verdict == f"The lead holds on 7 paired seeds: p = {p:.2g}."
    assert (found.ranked, found.few) == (3, 0)


def alc_of(height, seed):
    """By the trapezoidal rule up to `STEPS`, at which the curve is cut."""
    rows = evaluations(height, seed)
    steps, returns = ([row[name] for row in rows] for name in ("env_steps", "return_mean"))
    at = [*steps[:-1], STEPS]
    return np.trapezoid(np.interp(at, steps, returns), at) / STEPS


def test_what_is_no_lead(tmp_path):
    folders = made(tmp_path / "a", (500,))
    for seed in range(7):  # better and worse by turns
        height = 500 + 30 * (seed + 1) * (-1) ** seed
        folders.append(make_run(tmp_path / "a" / f"b{seed}", seed=seed, height=height, learning_rate=0.5))
    x, y = (
        [alc_of(h, s) for s, h in enumerate(each)]
        for each in ([500] * 7, [500 + 30 * (s + 1) * (-1) ** s for s in range(7)])
    )
    p = stats.wilcoxon(x, y, method="exact").pvalue
    assert p > 0.3
    assert lead(folders).verdict == f"The two are not told apart on 7 paired seeds: p = {p:.2g}."
    few = lead(made(tmp_path / "b", (500, 900), range(5)))
    assert few.verdict == "No claim can be made: 5 paired seeds can give no p below 0.062."
    one = lead(made(tmp_path / "c", (500, 900), [3]))
    assert one.verdict == "No claim can be made: 1 paired seed can give no p below 1."
    assert one.figure.endswith(" (n = 1)")
    alone = lead(made(tmp_path / "d", (500,)))
    assert (alone.second, alone.verdict) == (None, "There is no other method to compare with.")
    apart = [*made(tmp_path / "e", (500,)), *made(tmp_path / "f", (1, 900), range(10, 17))[7:]]
    assert lead(apart).verdict == "No claim can be made: the two have no seed in common."
    assert lead(made(tmp_path / "g", (500,), ends=20_000)) is None


def test_a_single_lucky_run_is_not_ranked(tmp_path):
    many = made(tmp_path / "a", (500, 900))
    lucky = make_run(tmp_path / "lucky", "ppo", 0, 9_000, learning_rate=0.5)
    found = lead([*many, lucky])
    assert (found.first, found.ranked, found.few) == ("ppo + learning_rate=0.002", 2, 1)
    assert lead([*many[:7], lucky]).first == "ppo + learning_rate=0.5"  # with one method of enough runs, all are ranked


def test_runs_that_cannot_be_told_apart(tmp_path):
    """The same method, task, steps and seed, of two priors: told, kept in the mean, left out of pairs."""
    folders = made(tmp_path / "a", (500, 900))
    again = make_run(tmp_path / "again", seed=6, height=900, learning_rate=0.002)
    assert lead([*folders, again]).verdict.startswith("The lead holds on 6 paired seeds")
    page = written([*folders, again], tmp_path / "a.html", baseline="ppo + learning_rate=0.001")
    assert {line["method"]: line["seeds"] for line in page.table("seeds")}["ppo + learning_rate=0.002"] == "0-5, 6 x2"
    assert f"cannot be paired: {folders[13]}, {again}." in page.words()
    assert "In 1 case runs share method" in page.words()
    assert {line["pairs"] for line in page.table("pairs")} == {"-", "6"}


def test_a_budget_is_compared_apart(tmp_path):
    folders = [*made(tmp_path / "a", (500, 900), (0, 1)), *made(tmp_path / "b", (500, 900), (0, 1), steps=100_000)]
    folders.append(make_run(tmp_path / "c", seed=0, steps=25_000, learning_rate=0.002))
    page = written(folders, tmp_path / "a.html", baseline="ppo + learning_rate=0.001")
    captions = [table["caption"] for table in page.tables if "Holm p" in table["rows"][0]]
    assert [text.partition(", paired by seed, ")[2] for text in captions] == [
        "50,000 steps",
        "50,000 steps",
        "100,000 steps",
        "100,000 steps",
    ]
    assert "No run of 25,000 steps is ppo + learning_rate=0.001" in page.words()
    assert "No run reaches 50,000 steps: --epochs 5 or less has an ALC." in page.words()


def test_without_a_baseline_there_is_no_comparison(tmp_path):
    page = written(made(tmp_path, (500, 900), (0, 1)), tmp_path / "a.html")
    assert "No finished run is plain PPO: --compare METHOD names another baseline." in page.words()
    assert page.table("Holm p") == []


def test_damaged_and_unfinished_runs_are_named(tmp_path, folders):
    def copy(name):
        shutil.copytree(folders[0], tmp_path / name)
        return tmp_path / name

    (copy("no-audit") / "audit.json").unlink()
    (copy("bad-audit") / "audit.json").write_text('{"static": [{"clause": 1}]}')
    (copy("bad-config") / "config.json").write_text('{"task": "Hop')
    whole = (copy("old-method") / "config.json").read_text()
    (tmp_path / "old-method" / "config.json").write_text(whole.replace('"method": "ppo"', '"method": "gone"'))
    (copy("seedless") / "config.json").write_text('{"task": "a", "method": "ppo", "preset": "paper", "config": {}}')
    lines = (copy("hole") / "metrics.jsonl").read_text().splitlines()
    (tmp_path / "hole" / "metrics.jsonl").write_text("\n".join([lines[0], lines[1][:9], *lines[2:]]))
    (copy("nan") / "evaluations.jsonl").write_text('{"env_steps": 0, "return_mean": NaN}\n')
    (copy("binary") / "metrics.jsonl").write_bytes(b"\xff\xfe")
    (tmp_path / "file").write_text("mine")
    half = make_run(tmp_path / "half", seed=9, ends=20_000)
    begun = make_run(tmp_path / "begun", seed=8)
    for table in ("metrics", "evaluations"):
        (begun / f"{table}.jsonl").write_text("")
    bad = [tmp_path / name for name in ("no-audit", "bad-audit", "bad-config", "old-method", "seedless", "hole")]
    bad += [tmp_path / name for name in ("nan", "binary", "file")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the page names them: nothing else does
        page = written([*folders, *bad, half, begun], tmp_path / "a.html")
    items = ["".join(data.split("\n")) for tag, data in page.texts if tag == "li"]
    for folder, reason in zip(
        bad,
        (
            "has no audit.json", "statement", "is damaged", "unknown method", "it lacks prior_hash",
            "line 2 of its metrics.jsonl is damaged", "line 1 of its evaluations.jsonl", "decode", "no config.json",
        ),
        strict=True,
    ):  # fmt: skip
        (line,) = (item for item in items if item.startswith(f"{folder}: "))
        assert reason in line
    assert f"{half}: ppo, Hopper-v5, seed 9, at 20,000 of 50,000 steps" in items
    assert f"{begun}: ppo, Hopper-v5, seed 8, at 0 of 50,000 steps" in items
    assert "Of the folders, 2 hold an unfinished run and 9 could not be read" in page.words()
    counted = {line["method"]: line["n"] for line in page.table("method", "seeds")}
    assert counted["ppo (tuned)"] == "7"
    (curve,) = (group for group in page.data()["charts"][0] if group["label"] == "ppo")
    assert (curve["n"], len(curve["runs"])) == (7, 9)


def test_only_unfinished_runs_are_a_page_too(tmp_path):
    page = written([make_run(tmp_path / "half", ends=20_000)], tmp_path / "a.html")
    assert "No run is finished: no claim can be made." in page.words()
    assert page.data()["charts"][0][0]["mean"] == []
    assert page.data()["runs"][0]["evaluations"]["env_steps"] == [0, 10_000, 20_000]


def test_a_violation_is_told(tmp_path, capsys, folders):
    bad = make_run(tmp_path / "bad", "ppo-dap", 0, 700, spr=0.5, prior_hash="b" * 64)
    assert main(["report", folders[0], str(bad), "--out", str(tmp_path / "a.html"), "--epochs", "10"]) == 1
    assert capsys.readouterr().out == f"{tmp_path / 'a.html'}: 2 runs\n"
    page = Page((tmp_path / "a.html").read_text())
    assert f"Audit: 1 of 2 runs VIOLATED: {bad}." in page.words()
    assert f"{bad}: (ii) SPR, smallest: 0.5 over 4 iterations" in page.words()
    assert {line["method"]: line["audit"] for line in page.table("seeds")} == {
        "ppo": "strictly on-policy",
        "ppo-dap": "VIOLATED",
    }
    assert {line["claim"]: line["holds in"] for line in page.table("claim")}["SPR, smallest"] == "0 of 1"
