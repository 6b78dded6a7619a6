"""The page of `ppo-dap report` in a headless Chromium: it draws, zooms, reads out, and hands over its data."""

import csv
import io
import json

import pytest

from ppo_dap.study.report.page import write_report
from study.report.browser import Page, find_chromium
from study.report.report_made import make_run

CHROMIUM = find_chromium()
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium found: put one on the PATH, or name it in CHROMIUM"
)
LABELS = ["ppo (tuned)", "ppo", "ppo-dap"]
FIRST = "document.querySelector('.curves')"
LEGEND = f"{FIRST}.querySelector('.legend')"
SIDEWAYS = "document.documentElement.scrollWidth > innerWidth"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Three methods: of four runs, of two, and one that has not finished; a comma and a quote in a path."""
    here = tmp_path_factory.mktemp("runs")
    folders = [make_run(here / f"tuned-{seed}", seed=seed, height=900, preset="tuned") for seed in range(4)]
    folders += [make_run(here / f'ppo, "{seed}"', seed=seed) for seed in range(2)]
    folders.append(make_run(here / "half", "ppo-dap", 0, ends=30_000, prior_hash="a" * 64))
    folders += [make_run(here / "other", "ppo", 0, 50, task="Swimmer-v5")]
    path = here / "report.html"
    write_report(folders, path, epochs=10.0)
    return path, folders


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    page = Page(CHROMIUM, tmp_path_factory.mktemp("browser"))
    yield page
    page.close()


@pytest.fixture
def page(browser, report):
    browser.open(report[0])
    browser.value(f"{FIRST}.scrollIntoView()")
    browser.settle()
    return browser


def plot(page):
    """Left, top, width and height of the first plot."""
    box = f"(() => {{ const b = {FIRST}.querySelector('svg').getBoundingClientRect();"
    return page.value(box + "return [b.left, b.top, b.width, b.height] })()")


def ticks(page):
    """What stands at the first plot's axis of steps."""
    return page.value(f"[...{FIRST}.querySelectorAll('text[text-anchor=middle]')].map(t => t.textContent)")


def lines(page, kind):
    return page.value(f"[...{FIRST}.querySelectorAll('.{kind}')].filter(p => p.getAttribute('d')).length")


def press(page, key):
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=key)


def test_it_loads_without_a_word_and_without_a_network(page, report):
    assert page.complaints() == []
    assert page.requested() == [report[0].as_uri()]
    assert page.value("document.querySelectorAll('.curves svg .mean').length") == 3


@pytest.mark.parametrize(
    "planted",
    ["<script>window.planted = 1</script>", "<img src='x.png'>", "<p onclick='1'></p>", "<script src='x.js'></script>"],
)
def test_its_policy_lets_nothing_else_run_or_load(browser, report, tmp_path, planted):
    text = report[0].read_text()
    (tmp_path / "a.html").write_text(text.replace("</main>", f"{planted}</main>"))
    browser.open(tmp_path / "a.html")
    browser.value("document.querySelector('p[onclick]')?.click()")
    assert browser.complaints()
    assert browser.value("window.planted") is None
    assert browser.value("document.querySelectorAll('.curves svg .mean').length") == 3


def test_an_error_of_a_script_would_be_heard(browser, tmp_path):
    (tmp_path / "a.html").write_text("<script>nothing.there</script>")
    browser.open(tmp_path / "a.html")
    assert browser.complaints()


def test_curves_bands_and_seeds(page):
    assert (lines(page, "mean"), lines(page, "band"), lines(page, "seed")) == (2, 1, 1)  # the seed that is not finished
    page.value(f"[...{FIRST}.querySelectorAll('.controls input')].forEach(box => box.click())")
    assert (lines(page, "mean"), lines(page, "band"), lines(page, "seed")) == (2, 0, 7)
    names = page.value(f"[...{LEGEND}.querySelectorAll('label')].map(label => label.textContent)")
    assert names == ["ppo (tuned) (n = 4)", "ppo (n = 2)", "ppo-dap (none finished)"]


def test_the_legend_hides_and_shows(page):
    page.value(f"{LEGEND}.querySelector('input').click()")
    assert lines(page, "mean") == 1
    buttons = f"[...{FIRST}.querySelectorAll('button')]"
    page.value(f"{buttons}.find(b => b.textContent == 'show all').click()")
    assert lines(page, "mean") == 2
    page.value(f"{buttons}.find(b => b.textContent == 'hide all').click()")
    assert lines(page, "mean") == 0


def test_a_drag_zooms_and_a_double_click_goes_back(page):
    left, top, width, _ = plot(page)
    whole, path = ticks(page), page.value(f"{FIRST}.querySelector('.mean').getAttribute('d')")
    assert whole == ["0", *(f"{thousand}k" for thousand in range(5, 51, 5))]
    assert page.value(f"{FIRST}.querySelector('button').disabled")
    page.drag((left + width / 2, top + 60), (left + width * 0.75, top + 64))
    near = ticks(page)
    assert all(23.9 <= float(text.rstrip("k")) <= 37.4 for text in near)
    assert len(near) > 3
    page.double_click(left + width / 2, top + 60)
    assert ticks(page) == whole
    assert page.value(f"{FIRST}.querySelector('.mean').getAttribute('d')") == path
    # A box zooms in on returns as well: far above all curves nothing of them is left in the picture.
    page.drag((left + width / 2, top + 40), (left + width * 0.75, top + 90))
    heights = page.value(f"[...{FIRST}.querySelectorAll('text[text-anchor=end]')].map(t => t.textContent)")
    numbers = [float(text.replace(",", "")) for text in heights if text[0].isdigit()]
    assert min(numbers) > 600
    page.value(f"{FIRST}.querySelector('button').click()")
    assert ticks(page) == whole


def test_a_finger_zooms_too(browser, report):
    browser.open(report[0], 400, 800, touch=True)
    browser.value(f"{FIRST}.scrollIntoView()")
    browser.settle()
    left, top, width, _ = plot(browser)
    assert "0" in ticks(browser)
    browser.touch_drag((left + width / 2, top + 60), (left + width - 20, top + 62))
    browser.settle()
    assert all(float(text.rstrip("k")) >= 20 for text in ticks(browser))


def test_the_cursor_reads_values(page, report):
    data = json.loads(page.value("document.getElementById('data').textContent"))
    first = data["charts"][0][0]
    left, top, width, height = plot(page)
    page.mouse("mouseMoved", left + 58 + 2, top + height / 2)
    shown = page.value(f"[...{LEGEND}.querySelectorAll('.value')].map(value => value.textContent)")
    assert shown[0] == f"{first['mean'][0]:,.0f} ± {first['half_width'][0]:,.0f}"
    assert shown[2] == ""
    tip = page.value(f"{FIRST}.querySelector('.tip').textContent")
    assert " at 0 steps" in tip
    page.mouse("mouseMoved", left + width / 2, top + height + 200)
    assert page.value(f"{FIRST}.querySelector('.tip').hidden")


def test_the_keyboard_reads_and_zooms(page):
    page.value(f"{FIRST}.querySelector('svg').focus()")
    spoken = f"{FIRST}.querySelector('[aria-live]').textContent"
    press(page, "ArrowRight")
    assert page.value(spoken).startswith("At 0 steps: ppo (tuned) ")
    press(page, "ArrowRight")
    assert page.value(spoken).startswith("At 10k steps: ppo (tuned) ")
    whole = ticks(page)
    press(page, "+")
    assert ticks(page) != whole
    press(page, "0")
    assert ticks(page) == whole


def test_the_csv_is_the_evaluations(page, report):
    """What the button hands over, read by another program's reader: a line an evaluation."""
    _, folders = report
    keep = "window.kept = null; URL.createObjectURL = blob => { window.kept = blob; return 'data:,' }"
    page.value(f"{keep}; HTMLAnchorElement.prototype.click = function () {{ window.called = this.download }}")
    page.value("document.getElementById('csv').click()")
    assert page.value("window.called") == "evaluations.csv"
    lines = list(csv.DictReader(io.StringIO(page.value("window.kept.text()"), newline="")))
    expected = []
    for folder in folders:
        rows = [json.loads(line) for line in (folder / "evaluations.jsonl").read_text().splitlines()]
        expected += [(str(folder), row) for row in rows]
    assert len(lines) == len(expected) == 7 * 6 + 4
    for line, (folder, row) in zip(lines, expected, strict=True):
        assert line["run"] == folder
        assert [float(part) for part in line["returns"].split("; ")] == row["returns"]
        assert {name: float(line[name]) for name in row if name != "returns"} == {
            n: row[n] for n in row if n != "returns"
        }
    assert [lines[0][name] for name in ("task", "method", "label", "preset", "seed", "finished")] == [
        "Hopper-v5", "ppo", "ppo (tuned)", "tuned", "0", "true",
    ]  # fmt: skip


@pytest.mark.parametrize("width", [320, 400, 1200])
def test_it_does_not_scroll_sideways(browser, report, tmp_path, width):
    browser.open(report[0], width, 800)
    browser.value("document.querySelectorAll('details').forEach(each => each.open = true)")
    browser.settle()
    assert not browser.value(SIDEWAYS)
    assert browser.value(f"{FIRST}.querySelector('svg').getBoundingClientRect().width") <= width
    wide = "<p style='width: 2000px'>wide</p></main>"
    (tmp_path / "wide.html").write_text(report[0].read_text().replace("</main>", wide))
    browser.open(tmp_path / "wide.html", width, 800)
    assert browser.value(SIDEWAYS)
