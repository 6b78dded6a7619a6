"""What may stand on a page, and how the command is called."""

import re

import pytest

from ppo_dap.cli import main
from study.report.report_made import make_run
from study.report.report_read import HOSTILE, Page, made, written


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
