"""The figures on the page are those of `summary`, of scipy and of the runs' own tables."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ppo_dap.study.report import runs as report_runs
from ppo_dap.study.report.parts import style
from ppo_dap.training.run import Run
from study.report.report_made import evaluations
from study.report.report_read import summary


def test_every_run_is_as_summary_has_it(capsys, folders, page):
    rows = {row["run"]: row for row in json.loads(summary(capsys, *folders, "--json"))}
    shown = page.table("run", "declared")
    assert [row["run"] for row in shown] == folders
    for line in shown:
        row = rows[line["run"]]
        assert line["ALC@10"] == f"{row['alc']:,.0f}"
        assert line["last return"] == f"{row['last_return']:,.0f}"
        assert line["training"] == "2 s"
        assert line["ALC x PPO"] == (f"{row['x_ppo']:.2f}" if row["x_ppo"] else "-")
        assert line["audit"] == ("not, as declared" if row["method"] == "ppo-arc" else "strictly on-policy")
        assert line["declared"] == ("not " * (row["method"] == "ppo-arc")) + "strictly on-policy"


def test_means_and_intervals_against_scipy(capsys, folders, page):
    rows = json.loads(summary(capsys, *folders, "--json"))
    shown = {(line["method"], line["n"]): line for line in page.table("method", "seeds")}
    assert len(shown) == 5
    for name, label in (("alc", "ALC@10"), ("last_return", "last return")):
        own = [row[name] for row in rows if row["label"] == "ppo (tuned)"]
        low, high = stats.t.interval(0.95, 6, np.mean(own), stats.sem(own))
        form = ",.0f" if (low + high) / 2 >= 100 else ",.1f"
        expected = f"{(low + high) / 2:{form}} ± {(high - low) / 2:{form}}"
        assert shown["ppo (tuned)", "7"][label] == expected
    assert shown["ppo (tuned)", "7"]["seeds"] == "0-6"
    assert shown["ppo-arc", "3"]["audit"] == "not, as declared"


def test_the_comparison_is_that_of_summary(capsys, folders, page):
    lines = [
        line for line in summary(capsys, *folders, "--compare", "ppo", "--markdown").splitlines() if line[:1] == "|"
    ]
    cells = [[cell.strip().replace("+-", "±") for cell in line.strip("|").split(" | ")] for line in lines]
    expected = [dict(zip(cells[0], row, strict=True)) for row in cells if "---" not in row and row[0] != "task"]
    assert page.table("pairs", "Holm p") == expected
    assert len(expected) == 10


def test_the_curves_are_means_with_intervals(page):
    """Against scipy, run by run interpolated by hand at the steps of the one that ends first."""
    data = page.data()
    assert [[group["label"] for group in chart] for chart in data["charts"]] == [
        ["ppo (tuned)", "ppo-flow", "ppo"],
        ["ppo-arc", "ppo"],
    ]
    group = data["charts"][0][0]
    assert [data["runs"][n]["label"] for n in group["runs"]] == ["ppo (tuned)"] * 7
    assert group["steps"] == [row["env_steps"] for row in evaluations(900, 0)]
    for place in (0, 3, 5):
        at, column = group["steps"][place], []
        for seed in range(7):
            rows = evaluations(900, seed)
            after = next(n for n, row in enumerate(rows) if row["env_steps"] >= at)
            before = max(after - 1, 0)
            (x0, y0), (x1, y1) = ((rows[n]["env_steps"], rows[n]["return_mean"]) for n in (before, after))
            column.append(y1 if x0 == x1 else y0 + (y1 - y0) * (at - x0) / (x1 - x0))
        low, high = stats.t.interval(0.95, 6, np.mean(column), stats.sem(column))
        assert group["mean"][place] == pytest.approx((low + high) / 2)
        assert group["half_width"][place] == pytest.approx((high - low) / 2)


def test_the_block_of_data_is_the_evaluations(folders, page):
    data = page.data()
    assert [run["run"] for run in data["runs"]] == folders
    for run in data["runs"]:
        columns = run["evaluations"]
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        with open(f"{run['run']}/evaluations.jsonl") as file:
            assert rows == [json.loads(line) for line in file]


def test_where_the_time_goes(page):
    """Iterations of one second: a second's parts are shares; what is left of the host's is dispatch."""
    for line in page.table("an iteration"):
        assert line["an iteration"] == "1,000 ms"
        assert (line["environment"], line["policy"], line["dispatch and the rest"]) == ("50%", "10%", "20%")
        assert (line["device: GAE"], line["device: audits"], line["device: PET"]) == ("2%", "<1%", "-")
    assert len(page.table("an iteration")) == 5


def test_settings_that_differ_and_no_others(page):
    rows = {line["method"]: line["instead"] for line in page.table("instead")}
    assert "gamma=0.99 (7 runs), 0.9999 (3 runs)" in rows["ppo"]
    assert "gamma" not in rows["ppo (tuned)"]  # the most frequent value, which the caption has
    assert "gamma=0.99;" in next(table["caption"] for table in page.tables if "instead" in table["rows"][0])
    assert "prior_hash=aaaaaaaaaaaa" in rows["ppo-flow"]
    assert "reuse_batches=1" in rows["ppo-arc"]
    assert "num_envs" not in page.words()
    assert "seed=" not in page.words()


def test_styles_differ_for_as_many_methods_as_there_are_pairs():
    assert len({tuple(style(place).values()) for place in range(25)}) == 25
    assert style(25) == style(0)
    assert all(re.fullmatch(r"#[0-9A-F]{6}", style(place)["colour"]) for place in range(25))


@pytest.mark.parametrize(
    ("seeds", "text"),
    [
        ([3], "3"),
        ([0, 1, 2], "0-2"),
        ([5, 0, 2, 6], "0, 2, 5-6"),
        ([0, 1, 1, 2], "0, 1 x2, 2"),
        ([1, 1, 2, 2], "1-2 x2"),
    ],
)
def test_seeds_in_words(seeds, text):
    def entry(seed):
        return report_runs.Entry(Run(Path()), {"seed": seed}, [], [], [])

    assert report_runs.seeds_text([entry(seed) for seed in seeds]) == text
