"""Every figure as a file, and those that must not be drawn."""

import re

import pytest
from matplotlib.image import imread

from ppo_dap.study.figures.studies import DRAWINGS, FIGURES, figures_of
from ppo_dap.study.plots.drawing import numbered
from ppo_dap.study.results import Results
from ppo_dap.study.store.studies import SMOKE, STUDIES, make_study, parts
from study.figures.levels_made import made_results


@pytest.fixture(scope="module")
def smoke():
    """The tiny version of every study, and results of it."""
    study = make_study("smoke")
    results = made_results(study)
    for entry in study.entries:
        if entry.labels["study"] == "fig11":
            results.proposals[entry.cell.name] = [
                {"state": i, "guided": j // 3, "drawn": 1, "q": 0.5 * j, "x": i, "y": j}
                for i in (0, 1)
                for j in range(6)
            ]
    return study, results


def test_every_figure_is_written_twice_to_the_same_bytes_in_both_formats(smoke, tmp_path):
    study, results = smoke
    paths = [
        path
        for part in parts(study)
        if part.name in FIGURES
        for path in FIGURES[part.name](results, part, tmp_path / "one")
    ]
    names = {path.name for path in paths}
    assert {path.name for path in (tmp_path / "one").iterdir()} == names
    files = {"mixed-methods", "mixed-parts", "ablation-alc", "ablation-final"} | DRAWINGS.keys() - {"mixed", "ablation"}
    assert names == {f"{name}.{suffix}" for name in files for suffix in ("svg", "png")}
    for part in parts(study):
        if part.name in ("fig6", "fig11"):
            for path in FIGURES[part.name](results, part, tmp_path / "two"):
                assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes()
    for path in paths:
        if path.suffix == ".png":  # nothing reaches the edge, where it would be cut off
            pixels = imread(path)
            assert all(edge.min() == 1 for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]))
        content = path.read_bytes()
        assert content[:4] == (b"\x89PNG" if path.suffix == ".png" else b"<?xm")
        assert b"dc:date" not in content


@pytest.mark.parametrize("name", DRAWINGS)
def test_nothing_is_drawn_of_a_study_without_runs(name, tmp_path):
    assert name in STUDIES
    study = make_study(name, scale=SMOKE)
    assert FIGURES[name](Results(), study, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["fig7", "fig8", "fig9", "fig12", "ablation"])
def test_there_is_no_change_without_the_baseline(name):
    study = make_study(name, scale=SMOKE)
    results = made_results(study, done=lambda labels: labels["arm"] != "PPO")
    found = figures_of(results, study)
    if name == "fig12":  # high-Q rate and ESS have no baseline
        assert [len(axes.get_legend_handles_labels()[1]) for axes in found["fig12"].axes] == [0, 0, 1, 1]
    else:
        assert list(found) == (["fig9"] if name == "fig9" and found else [])


def test_names_inside_a_figure_do_not_feel_the_last_bit_of_its_layout(smoke, tmp_path):
    one, other = (b'<clipPath id="p%s"/><use xlink:href="#m0123456789"/><g clip-path="url(#p%s)"/>' % (x, x)
                  for x in (b"86e59be5cf", b"6d8208f5f3"))  # fmt: skip
    assert numbered(one) == numbered(other) != numbered(one.replace(b"m0123456789", b"p86e59be5cf"))
    study, results = smoke
    (part,) = (part for part in parts(study) if part.name == "fig6")
    (path,) = (path for path in FIGURES["fig6"](results, part, tmp_path) if path.suffix == ".svg")
    text = path.read_text()
    named, used = re.findall(r' id="([^"]+)"', text), re.findall(r'(?:href="|url\()#([^")]+)', text)
    assert len(named) == len(set(named))
    assert used
    assert set(used) <= set(named)
    assert not re.search(r"[0-9a-f]{10}[\")]", text)
