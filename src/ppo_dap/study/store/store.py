"""The folder that studies share: what was made is there once, whoever asked for it and however it was cut off.

cells/NAME/cell.json       what the cell is: kind, settings, needs
cells/NAME/out/            what was made: a run folder, a prior's file, logs, a report
cells/NAME/done.json       written last; without it `out` is half of something
cells/NAME/attempts.jsonl  what each attempt took, and how it ended
cells/NAME/claim-N         who is at it (claims.py)
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppo_dap.errors import InputError
from ppo_dap.storage import write_atomically

if TYPE_CHECKING:  # workers need not know what studies are
    from ppo_dap.study.store.cells import Cell
    from ppo_dap.study.store.grids import Study
    from ppo_dap.training.run import Run


@dataclass(frozen=True)
class Store:
    """A store at `root`; it is made when something is put into it."""

    root: Path

    def folder(self, cell: Cell | str) -> Path:
        """Where everything about a cell is."""
        return self.root / "cells" / (cell if isinstance(cell, str) else cell.name)

    def out(self, cell: Cell | str) -> Path:
        """Where what was made is; of a run, its run folder."""
        return self.folder(cell) / "out"

    def artefact(self, cell: Cell) -> Path:
        """What other commands take: a run folder, a prior's file, a dataset's folder, a report."""
        out = self.out(cell)
        if cell.kind in ("behaviour", "logs"):
            from ppo_dap.training import tiers

            s = cell.settings
            if cell.kind == "logs":
                return tiers.tier_folder(s["task"], s["tier"], out)
            return tiers.behaviour_folder(s["task"], s["seed"], s["steps"], out)
        return out / {"prior": "prior", "reliability": "report.json"}.get(cell.kind, "")

    def done(self, cell: Cell | str) -> bool:
        """Whether it was made, to the end."""
        return (self.folder(cell) / "done.json").is_file()

    def prepare(self, cell: Cell) -> None:
        """Put down what a cell is, unless it is there."""
        path = self.folder(cell) / "cell.json"
        if not path.is_file():
            write_atomically(path, json.dumps(cell.description(), indent=1).encode())

    def check(self, cell: Cell) -> None:
        """Raise `InputError` for a cell that is there with other settings: a default has changed since."""
        path = self.folder(cell) / "cell.json"
        if not path.is_file():
            return
        stored = self.read(cell.name)["settings"]
        for name, value in cell.settings.items():
            if name in stored and stored[name] != json.loads(json.dumps(value)):
                raise InputError(
                    f"{path} was made with {name} {stored[name]!r}, and {name} is {value!r} now: name another store"
                )

    def read(self, name: str) -> dict[str, Any]:
        """What `prepare` put down."""
        path = self.folder(name) / "cell.json"
        try:
            stored = json.loads(path.read_text())
            if not {"kind", "settings", "call", "needs"} <= stored.keys():
                raise ValueError("it lacks kind, settings, call or needs")
            return stored
        except (FileNotFoundError, ValueError, AttributeError) as error:
            raise InputError(f"{path} is missing or damaged ({error}): remove its folder, to begin anew") from error

    def finish(self, name: str) -> None:
        """Say that the cell is made; what a kill left half-written in it is removed."""
        for partial in self.folder(name).rglob(".*.partial"):
            partial.unlink()
        write_atomically(self.folder(name) / "done.json", json.dumps({"cell": name}).encode())

    def note(self, name: str, **attempt: Any) -> None:
        """One more line about an attempt: how it `end`ed (done, failed, stopped), `seconds`, `peak_mib`, `error`."""
        with open(self.folder(name) / "attempts.jsonl", "a") as file:
            file.write(json.dumps(attempt) + "\n")

    def attempts(self, name: str) -> list[dict[str, Any]]:
        """What `note` wrote; a line that was cut off by a kill is left out."""
        path, rows = self.folder(name) / "attempts.jsonl", []
        for line in path.read_text().splitlines() if path.is_file() else []:
            try:
                rows.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return rows

    def failures(self, name: str) -> list[str]:
        """The errors of the attempts that failed, oldest first."""
        return [row["error"] for row in self.attempts(name) if row["end"] == "failed"]

    def cost(self, cell: Cell) -> dict[str, float]:
        """Seconds of all attempts with start-up, and the largest peak of memory in MiB; empty if nothing is known."""
        rows = self.attempts(cell.name)
        if not rows:
            return {}
        return {"seconds": sum(row["seconds"] for row in rows), "peak_mib": max(row["peak_mib"] for row in rows)}

    def runs(self, study: Study) -> list[tuple[dict[str, Any], Run]]:
        """The runs of a study that are there, with their labels."""
        from ppo_dap.training.run import load_run

        made = [entry for entry in study.entries if entry.cell.kind == "run" and self.done(entry.cell)]
        return [(entry.labels, load_run(self.out(entry.cell))) for entry in made]

    def size(self, cell: Cell) -> int:
        """Bytes of what was made."""
        return sum(path.lstat().st_size for path in self.out(cell).rglob("*") if not path.is_dir())

    def free_bytes(self) -> int:
        """Room left where the store is, or will be."""
        place = self.root.absolute()
        while not place.exists():
            place = place.parent
        return shutil.disk_usage(place).free


def open_store(root: str | Path) -> Store:
    """The store at this folder; raises `InputError` for a folder that holds something else."""
    root = Path(root)
    if root.exists() and not root.is_dir():
        raise InputError(f"store {root} is a file: name a folder")
    if root.is_dir() and any(root.iterdir()) and not (root / "cells").is_dir():
        raise InputError(f"store {root} is a folder with other files in it: name a new one, or one that a study made")
    return Store(root)
