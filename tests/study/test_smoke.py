"""Everything that the paper's tables and figures need, from behaviours to pictures, tiny, by the command itself."""

import subprocess
import sys

from ppo_dap.study.draw import draw
from ppo_dap.study.results import load_results
from ppo_dap.study.store.store import Store
from ppo_dap.study.store.studies import STUDIES, make_study


def test_smoke_makes_every_table_and_figure(tmp_path):
    root = tmp_path / "store"
    command = [sys.executable, "-m", "ppo_dap.cli", "study", "smoke", "--store", str(root)]
    made = subprocess.run([*command, "--workers", "2"], capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    study = make_study("smoke")
    assert f"smoke: {len(study.cells())} of {len(study.cells())} cells are there" in made.stdout
    store, folder = Store(root), root / "results"
    results = load_results(folder)
    assert results.runs.keys() == {cell.name for cell in study.cells() if cell.kind == "run"}
    assert results.reports.keys() == {cell.name for cell in study.cells() if cell.kind == "reliability"}
    assert not any("/" in str(value) for row in results.reports.values() for value in row.values())  # no folder of ours
    assert results.proposals
    assert all(row["as_declared"] for row in results.runs.values())
    assert {row["method"] for row in results.runs.values() if not row["strictly_on_policy"]} == {"ppo-arc"}
    assert all(store.cost(cell)["peak_mib"] > 50 for cell in study.cells())
    for name in STUDIES:
        assert (folder / f"{name}.md").stat().st_size > 300
    # The CSV files are all that is needed to make the same again.
    pages = draw(study, results, tmp_path / "again")
    for name, page in pages.items():
        assert page.text in (folder / f"{name}.md").read_text()
    figures = {path.name for path in folder.iterdir() if path.suffix in (".svg", ".png")}
    assert figures == {path.name for path in (tmp_path / "again").iterdir()}
    assert len(figures) >= 24
    for name in figures:
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
