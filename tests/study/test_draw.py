"""From results to documents: which block gets what, and what stays as it was."""

from pathlib import Path

import pytest

from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.study import draw as drawing
from ppo_dap.study.draw import BLOCK, Page, draw, fill, save_pages
from ppo_dap.study.results import Results, load_results
from ppo_dap.study.store.grids import Scale
from ppo_dap.study.store.studies import make_study, parts
from ppo_dap.study.tables.studies import TABLES


class _Table:
    def __init__(self, text):
        self.text = text

    def markdown(self):
        return self.text

    def csv(self):
        return "rows\n"


def _figure(results, study, folder):
    files = [folder / f"{study.name}.{ending}" for ending in ("svg", "png")]
    for path in files:
        path.touch()
    return files


@pytest.fixture
def drawn(monkeypatch):
    """Tables and figures that say whose they are."""
    tables = {n: lambda results, study: _Table(f"| {study.name} |\n\n| two |") for n in TABLES}
    monkeypatch.setattr(drawing, "TABLES", tables)
    monkeypatch.setattr(drawing, "FIGURES", {"fig6": _figure, "fig10": _figure})


def _results(study):
    """Every run of the study has one evaluation, and its seed as its return."""
    results = Results()
    for entry in study.entries:
        if entry.cell.kind == "run":
            results.runs[entry.cell.name] = {"last_return": float(entry.labels["seed"])}
            results.curves[entry.cell.name] = [{"env_steps": 0, "return_mean": 0.0, "length_mean": 1.0}]
    return results


def test_each_part_has_its_tables_and_figures_and_an_empty_one_has_nothing(drawn, tmp_path):
    study = make_study("all", scale=Scale(early_steps=1000, full_steps=1000, many=(0,), few=(0,)))
    chosen = {part.name: part for part in parts(study)}
    results = _results(chosen["table6"])
    pages = draw(study, results, tmp_path / "results")
    # Table 6 and Figs 6, 11 share their runs; HalfCheetah's of Fig. 10 were not made.
    assert pages["table6"].text == "| table6 |\n\n| two |"
    assert pages["fig6"].text == f"| fig6 |\n\n| two |\n\n![{chosen['fig6'].title}](fig6.png)"
    assert "fig10" not in pages
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["fig6.png", "fig6.svg"]
    files = save_pages(study, pages, tmp_path)
    text = (tmp_path / "fig6.md").read_text()
    assert tmp_path / "fig6.md" in files
    assert (tmp_path / "fig6.csv").read_text() == "rows\n"
    assert text.startswith(f"# {chosen['fig6'].title}\n\n`ppo-dap study fig6`\n\n| fig6 |")


def test_blocks_of_a_document_are_filled_and_nothing_else_changes(tmp_path):
    document = tmp_path / "docs" / "results.md"
    document.parent.mkdir()
    document.write_text(
        "a\n<!--study one-->\nold\n<!--/-->\nb\n<!--other-->\n<!--study two-->\n<!--/-->\n"
        "<!--study three-->\nkept\n<!--/-->\n"
    )
    pages = {
        "one": Page("| 1 |\n\n![title](one.png)", ""),
        "two": Page("| 2 |\n\n[a link](elsewhere.md)", ""),
        "four": Page("no block", ""),
    }
    again = fill(document, pages, tmp_path / "docs" / "results")
    assert again == (
        "a\n<!--study one-->\n| 1 |\n\n![title](results/one.png)\n<!--/-->\nb\n<!--other-->\n<!--study two-->\n"
        "| 2 |\n\n[a link](elsewhere.md)\n<!--/-->\n<!--study three-->\nkept\n<!--/-->\n"
    )
    document.write_text(again)
    assert fill(document, pages, tmp_path / "docs" / "results") == again
    assert "(../figures/one.png)" in fill(document, pages, tmp_path / "figures")


def test_a_document_without_blocks_is_refused(tmp_path):
    (tmp_path / "notes.md").write_text("<!--study one-->\nno end\n")
    with pytest.raises(InputError, match="has no line <!--study NAME-->"):
        fill(tmp_path / "notes.md", {}, tmp_path)
    with pytest.raises(InputError, match="is not a file"):
        fill(tmp_path / "none.md", {}, tmp_path)


def test_drawing_runs_nothing_and_keeps_what_was_measured(drawn, tmp_path, capsys):
    study = make_study("fig6", seeds=[0], steps=1000)
    results = _results(study)
    results.save(tmp_path / "kept")
    document = tmp_path / "page.md"
    document.write_text("<!--study fig6-->\n<!--/-->\n")
    options = [
        "--store",
        str(tmp_path / "none"),
        "--results",
        str(tmp_path / "kept"),
        "--seeds",
        "0",
        "--steps",
        "1000",
    ]
    assert main(["study", "fig6", "--draw", *options, "--document", str(document)]) == 0
    assert "| fig6 |" in capsys.readouterr().out
    assert "![" in document.read_text()
    assert load_results(tmp_path / "kept") == results
    assert not (tmp_path / "none").exists()
    assert main(["study", "fig10", "--draw", *options]) == 0
    assert "no run of fig10 is finished: nothing to draw" in capsys.readouterr().out
    assert main(["study", "fig6", "--draw", "--dry-run", *options]) == 2
    assert main(["study", "fig6", *options, "--document", str(tmp_path / "no.md")]) == 2
    told = capsys.readouterr().err.splitlines()
    assert [line.split(": ", 1)[1].split(" ")[0] for line in told] == ["--dry-run", "document"]


def test_the_documents_tables_are_those_of_the_committed_files(tmp_path):
    document = Path(__file__).parents[2] / "docs" / "results.md"
    folder = document.parent / "results"
    results, text = load_results(folder), document.read_text()
    pages = {}
    for block in BLOCK.finditer(text):
        pages |= draw(make_study(block["name"]), results, tmp_path)
    assert {"mixed", "table5", "fig11"} <= pages.keys()
    assert fill(document, pages, folder) == text
    assert {path.name for path in tmp_path.iterdir()} <= {path.name for path in folder.iterdir()}
