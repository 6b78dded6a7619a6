"""The page of `ppo-dap report`: its figures are those of `summary`, and nothing on it is a stranger's code."""

import functools
import json
import re
import shutil
import warnings
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ppo_dap.cli import main
from ppo_dap.study import report_runs
from ppo_dap.study.compare import compare, overall
from ppo_dap.study.report import write_report
from ppo_dap.study.report_parts import style
from ppo_dap.training.run import Run
from study.report_made import STEPS, evaluations, make_run

FEW = 100
HOSTILE = "<script>alert(1)</script>&\"'"
SWIM = {"task": "Swimmer-v5", "gamma": 0.9999}
VOID = ("meta", "img", "br", "link", "input")


class Page(HTMLParser):
    """Tables, text by element, tags and attributes, as a parser of html gives them."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.tables, self.texts = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag == "table":
            self.tables.append({"caption": "", "rows": []})
        if tag == "tr":
            self.tables[-1]["rows"].append([])
        if tag in ("td", "th"):
            self.tables[-1]["rows"][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))
        if "td" in self.open or "th" in self.open:
            self.tables[-1]["rows"][-1][-1] += data
        elif self.open[-1:] == ["caption"]:
            self.tables[-1]["caption"] += data

    def table(self, *heads):
        """Rows, by head, of the tables that have these heads."""
        found = [t["rows"] for t in self.tables if set(heads) <= set(t["rows"][0])]
        return [dict(zip(rows[0], row, strict=True)) for rows in found for row in rows[1:]]

    def data(self):
        (text,) = (data for tag, data in self.texts if tag == "script" and data.startswith("{"))
        return json.loads(text)

    def words(self):
        return " ".join("".join(data for tag, data in self.texts if tag not in ("script", "style")).split())


@pytest.fixture(scope="module", autouse=True)
def few_resamples():
    """Types are checked in each resample: a few do."""
    with pytest.MonkeyPatch.context() as patch:
        for function in (compare, overall):
            for module in ("compare", "report"):
                patch.setattr(f"ppo_dap.study.{module}.{function.__name__}", functools.partial(function, reps=FEW))
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Three methods on one task, two on another; a method that is declared not to be on-policy."""
    here = tmp_path_factory.mktemp("runs")
    made = [make_run(here / f"ppo-{seed}", seed=seed, height=500 + seed) for seed in range(7)]
    made += [make_run(here / f"tuned-{seed}", seed=seed, height=900, preset="tuned") for seed in range(7)]
    made += [make_run(here / f"flow-{s}", "ppo-flow", s, 700, prior_hash="a" * 64, pet_frequency=0) for s in (0, 1)]
    made += [make_run(here / f"arc-{s}", "ppo-arc", s, 400, batch_fresh=0.5, **SWIM) for s in (0, 1, 2)]
    made += [make_run(here / f"swim-{s}", "ppo", s, 300, **SWIM) for s in (0, 1, 2)]
    return [str(folder) for folder in made]


@pytest.fixture(scope="module")
def page(folders, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    done = write_report(folders, path, epochs=10.0)
    assert done == (22, 0, 0, True)
    return Page(path.read_text())


def summary(capsys, *arguments):
    assert main(["summary", *arguments, "--epochs", "10"]) == 0
    return capsys.readouterr().out


def written(folders, path, **options):
    write_report([str(folder) for folder in folders], path, **{"epochs": 10.0, **options})
    return Page(path.read_text())


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


def made(tmp_path, heights, seeds=range(7), **changes):
    """A method (a learning rate of its own) for each height."""
    found = []
    for place, height in enumerate(heights):
        rate = 1e-3 * (place + 1)
        found += [
            make_run(tmp_path / f"{place}-{seed}", seed=seed, height=height, learning_rate=rate, **changes)
            for seed in seeds
        ]
    return found


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
            "has no audit.json", "statement", "is damaged", "unknown method", "it lacks '",
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


def outside(text):
    """What a page would fetch or go to, or run beside its own script."""
    page = Page(text)
    refers = ("src", "href", "srcset", "action", "poster", "data")
    found = [v for _, name, v in page.attributes if name in refers and not v.startswith(("#", "data:"))]
    found += [name for _, name, _ in page.attributes if name.startswith("on")]
    found += [tag for tag in page.tags if tag in ("link", "iframe", "object", "embed", "base", "form")]
    found += re.findall(r"https?:|url\(|@import|importScripts|fetch\(|XMLHttpRequest", text)
    return found + ["script"] * (page.tags.count("script") - 2)


@pytest.mark.parametrize(
    "planted",
    [
        "<img src='https://a.b/c.png'>", "<script src=x.js></script>", "<a href='//a.b'>x</a>",
        "<p onclick='x()'>a</p>", "<style>p { background: url(x.png) }</style>", "<iframe></iframe>",
        "<script>1</script>",
    ],
)  # fmt: skip
def test_nothing_comes_from_outside(folders, tmp_path, planted):
    written(folders[:2], tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert outside(text) == []
    assert outside(text.replace("</main>", f"{planted}</main>")) != []


def test_hostile_names_are_text(tmp_path):
    folder = make_run(tmp_path / "x" / HOSTILE.replace("/", ""), seed=1, guidance=HOSTILE, task=f"{HOSTILE}-v0")
    (folder / "film.mp4").write_bytes(b"film")
    (tmp_path / f"{HOSTILE.replace('/', '')}-damaged").mkdir()
    page = written(
        [folder, *tmp_path.glob("<*")], tmp_path / "a.html", baseline=f"ppo + guidance={HOSTILE}", command=HOSTILE
    )
    assert page.tags.count("script") == 2
    assert outside((tmp_path / "a.html").read_text()) == []
    shown = [data for tag, data in page.texts if HOSTILE in data and tag != "script"]
    assert len(shown) > 10
    data = page.data()
    (block,) = (text for tag, text in page.texts if tag == "script" and text.startswith("{"))
    assert not set("<>&") & set(block)  # neither an end tag nor the start of a comment
    assert data["runs"][0]["label"] == f"ppo + guidance={HOSTILE}"
    assert data["runs"][0]["run"] == str(folder)


def test_films(tmp_path):
    folder = make_run(tmp_path / "runs" / "a b#1")
    (folder / "policy.mp4").write_bytes(b"m" * 1_000)
    (folder / "videos").mkdir()
    (folder / "videos" / "late.GIF").write_bytes(b"g" * 600)
    (tmp_path / "pages").mkdir()

    def films(limit):
        page = written([folder], tmp_path / "pages" / "a.html", embed=limit)
        return [
            (tag, v.partition(",")[0]) for tag, name, v in page.attributes if name in ("src", "href") and v[0] != "#"
        ]

    here = "../runs/a%20b%231"
    assert films(1.6e-3) == [("video", "data:video/mp4;base64"), ("img", "data:image/gif;base64")]
    assert films(0.0015) == [("video", "data:video/mp4;base64"), ("a", f"{here}/videos/late.GIF")]
    assert films(0.0007) == [("a", f"{here}/policy.mp4"), ("img", "data:image/gif;base64")]
    assert films(0.0) == [("a", f"{here}/policy.mp4"), ("a", f"{here}/videos/late.GIF")]
    assert "Films" not in written(made(tmp_path / "b", (500,), [0]), tmp_path / "b.html").words()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nothing",), "RUN nothing does not exist: name run folders"),
        (("empty",), "no RUN of 1 can be read: empty is not a run folder: it has no config.json"),
        (("run", "--out", "a.txt"), "a.txt: must end in .html"),
        (("run", "--out", "run/config.json/a.html"), "run/config.json/a.html: cannot be written"),
        (("run", "--compare", "ppo-dap"), "unknown method to compare with, of a finished run, 'ppo-dap'"),
        (("run", "--epochs", "0"), "--epochs"),
        (("run", "--embed-mb", "-1"), "--embed-mb"),
        ((), "RUN"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "run")
    (tmp_path / "empty").mkdir()
    assert main(["report", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("ppo-dap: ")
    assert words in captured.err
    assert len(captured.err.splitlines()) == 1
    assert captured.out == ""
    assert not list(tmp_path.rglob("*.html"))


def test_the_command_names_itself_on_the_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "a run")
    assert main(["report", "a run", "a run/../a run", "--epochs", "10", "--compare", "ppo"]) == 0
    assert capsys.readouterr().out == "report.html: 1 run\n"
    page = Page((tmp_path / "report.html").read_text())
    command = "ppo-dap report 'a run' 'a run/../a run' --out report.html --epochs 10 --compare ppo --embed-mb 10"
    assert command in page.words()
    assert "jax 0.10.2" in page.words()


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
