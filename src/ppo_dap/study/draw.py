"""From a study's results to what a reader sees: its tables, its figures, and the documents that they stand in."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from ppo_dap.errors import InputError
from ppo_dap.storage import write_atomically
from ppo_dap.study.figures.studies import FIGURES
from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import parts
from ppo_dap.study.tables.studies import TABLES

BLOCK = re.compile(r"(<!--study (?P<name>[\w-]+)-->\n).*?(<!--/-->)", re.DOTALL)
"""Where a document takes a study in."""


class Page(NamedTuple):
    """What a part of a study comes to."""

    text: str
    """Markdown: its tables, and its figures by paths relative to the folder that they were written to."""
    csv: str
    """The rows behind the tables."""


def draw(study: Study, results: Results, folder: Path) -> dict[str, Page]:
    """Write the figures of every part of the study to `folder`, each as .svg and .png; returns a page a part.

    Of a part that has no run there is nothing.
    """
    pages = {}
    for part in parts(study):
        if not results.rows(part):
            continue
        folder.mkdir(parents=True, exist_ok=True)
        table = TABLES[part.name](results, part)
        files = FIGURES[part.name](results, part, folder) if part.name in FIGURES else []
        figures = [f"![{part.title}]({path.name})" for path in files if path.suffix == ".png"]
        pages[part.name] = Page("\n\n".join([table.markdown(), *figures]), table.csv())
    return pages


def save_pages(study: Study, pages: Mapping[str, Page], folder: Path) -> list[Path]:
    """Write each page to `folder`/NAME.md, and its rows to NAME.csv; returns the former."""
    titles = {part.name: part.title for part in parts(study)}
    files = []
    for name, page in pages.items():
        files.append(folder / f"{name}.md")
        write_atomically(files[-1], f"# {titles[name]}\n\n`ppo-dap study {name}`\n\n{page.text}\n".encode())
        write_atomically(folder / f"{name}.csv", page.csv.encode())
    return files


def fill(document: Path, pages: Mapping[str, Page], folder: Path) -> str:
    """The text of a document with every block `<!--study NAME-->` ... `<!--/-->` of these pages filled anew.

    Paths of figures, which lie in `folder`, become relative to the document. Raises `InputError` for a document that
    is none or that has no such block.
    """
    if not document.is_file():
        raise InputError(f"document {document} is not a file: name one with lines <!--study NAME--> and <!--/-->")
    text = document.read_text()
    if not BLOCK.search(text):
        raise InputError(f"document {document} has no line <!--study NAME--> with a <!--/--> after it")
    place = Path(os.path.relpath(folder, document.parent)).as_posix()

    def filled(found: re.Match) -> str:
        page = pages.get(found["name"])
        if page is None:
            return found[0]
        return found[1] + re.sub(r"(!\[[^]]*\]\()", rf"\g<1>{place}/", page.text) + "\n" + found[3]

    return BLOCK.sub(filled, text)
