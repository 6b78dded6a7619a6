"""The html report: one file, nothing from outside, names of strangers as text, and the worst first."""

import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from logs.logs_made import make_logs, pendulums
from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs, check_logs, save_npz, write_report

HOSTILE = "<script>alert(1)<b> & \"'$x_$.npz"


class Page(HTMLParser):
    """Tags, attributes and text of a page, as a browser's parser gives them."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.text = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]

    def handle_data(self, data):
        self.text.append(data)

    def values(self, tag, name):
        return [value for t, n, value in self.attributes if (t, n) == (tag, name)]


def made(**changes):
    arrays = pendulums()
    logs = Logs(arrays["observations"], arrays["actions"], arrays["timeouts"], rewards=arrays["actions"][:, 0])
    return dataclasses.replace(logs, **changes)


def written(path, logs):
    report = check_logs(logs)
    write_report(logs, report, path)
    return path.read_text(), report


def test_hostile_names_are_text_and_nothing_comes_from_outside(tmp_path):
    text, _ = written(tmp_path / "a.html", made(source=f"here/{HOSTILE}", task="<img src=x onerror=alert(2)>"))
    page = Page(text)
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert any(HOSTILE in data for data in page.text)
    assert any("<img src=x onerror=alert(2)>" in data for data in page.text)
    assert page.tags.count("img") == len(page.values("img", "src")) == 6
    assert all(value.startswith("data:image/png;base64,") for value in page.values("img", "src"))
    assert {tag for tag in page.tags if tag in ("link", "iframe", "object", "base", "form")} == set()
    assert not [value for _, name, value in page.attributes if name in ("href", "srcset") or name.startswith("on")]
    assert "http:" not in text
    assert "https:" not in text
    assert "url(" not in text
    assert "default-src 'none'" in page.values("meta", "content")[-1]


def test_pictures_are_whole_and_described(tmp_path):
    from matplotlib.image import imread

    page = Page(written(tmp_path / "a.html", made())[0])
    for source in page.values("img", "src"):
        picture = imread(io.BytesIO(base64.b64decode(source.partition(",")[2])))
        assert picture.shape[1] > 600
        assert len(np.unique(picture[::7, :, :3].sum(2))) > 10  # something is drawn
    assert all(len(alt) > 40 for alt in page.values("img", "alt"))


def test_the_worst_findings_come_first(tmp_path):
    logs = made(observations=np.concatenate([made().observations, np.ones((1800, 1))], axis=1))
    report = check_logs(logs, observation_size=6)
    assert {line.level for line in report.lines} == {"ok", "warning", "error"}
    write_report(logs, report, tmp_path / "a.html")
    page = Page((tmp_path / "a.html").read_text())
    levels = [value.removeprefix("level ") for value in page.values("td", "class")]
    assert "skipped" in levels  # no time stamps: neither a warning nor a tick
    levels = ["ok" if level == "skipped" else level for level in levels]
    assert levels == sorted(levels, key=["error", "warning", "ok"].index)
    assert len(levels) == len(report.lines)
    words = " ".join(page.text)
    assert "Unusable as they are (1 error, 1 warning, 15 ok)." in words
    assert all(line.message in words for line in report.lines)


@pytest.mark.parametrize(
    "logs",
    [
        make_logs(),
        make_logs((1,), rewards=None, terminated=None),
        Logs(np.ones((300, 2)), np.ones((300, 20)), np.arange(300) % 30 == 29),
    ],
    ids=["small", "one row", "constant"],
)
def test_small_and_constant_logs_have_a_report_too(tmp_path, logs):
    text, _ = written(tmp_path / "a.html", logs)
    assert 3 <= Page(text).tags.count("img") <= 6


def test_a_jump_is_marked_in_the_pictures(tmp_path):
    """The red of a mark is in the two pictures of jumps exactly when there is one."""
    from matplotlib.image import imread

    def red(logs):
        page = Page(written(tmp_path / "a.html", logs)[0])
        counts = []
        for source in page.values("img", "src")[2:4]:
            picture = imread(io.BytesIO(base64.b64decode(source.partition(",")[2])))[:, :, :3]
            counts.append(int((np.abs(picture - np.array([0xD5, 0x5E, 0x00]) / 255).max(2) < 0.02).sum()))
        return counts

    logs = made()
    assert red(logs) == [0, 0]
    left = logs.episode_ends.copy()
    left[np.flatnonzero(left)[10]] = False
    assert min(red(dataclasses.replace(logs, episode_ends=left))) > 10


def test_the_command_writes_it_and_bad_places_are_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_npz(made(), "a.npz")
    assert main(["check-logs", "--logs", "a.npz", "--html", "new/b.html"]) == 0
    assert "report: new/b.html" in capsys.readouterr().out
    assert re.match("<!doctype html>", (tmp_path / "new" / "b.html").read_text())
    assert main(["check-logs", "--logs", "a.npz", "--html", "c.HTM", "--json"]) == 0
    assert capsys.readouterr().out.startswith("[{")
    before = (tmp_path / "a.npz").read_bytes()
    assert main(["check-logs", "--logs", "a.npz", "--html", "a.npz"]) == 2
    assert capsys.readouterr().err == "ppo-dap: a.npz: must end in .html\n"
    assert (tmp_path / "a.npz").read_bytes() == before
    with pytest.raises(InputError, match=r"a\.npz/x\.html: cannot be written"):
        write_report(made(), check_logs(made()), "a.npz/x.html")
