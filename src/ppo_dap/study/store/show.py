"""What a terminal shows while a study runs: a live table, or a line for each thing that happens where there is none."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from ppo_dap.study.store.cells import KINDS, Cell
from ppo_dap.study.store.plan import PLURAL

if TYPE_CHECKING:
    from ppo_dap.study.store.supervise import Supervisor


class Show:
    """A live table on a terminal, lines elsewhere; `quiet` shows failures alone."""

    def __init__(self, quiet: bool = False):
        self._live: Any = None
        self._quiet, self._started = quiet, {}
        if sys.stdout.isatty() and not quiet:
            from rich.live import Live

            self._live = Live(refresh_per_second=2, transient=True)

    def __enter__(self) -> Show:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """A line that stays."""
        if self._live is not None and self._live.is_started:
            self._live.console.print(text, highlight=False, markup=False)
        else:
            print(text, flush=True)

    def finished(self, supervisor: Supervisor, cell: Cell) -> None:
        """A cell is there."""
        if self._live is None and not self._quiet:
            counts = f"{len(supervisor.done)}/{len(supervisor.plan.cells)}"
            took = supervisor.store.cost(cell).get("seconds")
            time_taken = "" if took is None else f" in {took:,.0f} s"
            self.say(
                f"[{counts}] {cell}: done{time_taken}; {len(supervisor.running)} running, {len(supervisor.failed)} "
                f"failed, {duration(supervisor.left())} left"
            )

    def update(self, supervisor: Supervisor) -> None:
        """What is so now."""
        for cell in supervisor.running:
            self._started.setdefault(cell, time.monotonic())
        self._started = {cell: at for cell, at in self._started.items() if cell in supervisor.running}
        if self._live is not None:
            self._live.update(self._table(supervisor))

    def _table(self, supervisor: Supervisor) -> Any:
        from rich.console import Group
        from rich.table import Table

        table = Table(title=f"{supervisor.plan.study.name}: {duration(supervisor.left())} left")
        for column in ("", "done", "running", "failed", "to come"):
            table.add_column(column, justify="right" if column else "left")
        groups = (supervisor.done, supervisor.running, supervisor.failed, supervisor.open)
        counts = [Counter(cell.kind for cell in group) for group in groups]
        for kind in KINDS:
            if any(count[kind] for count in counts):
                table.add_row(PLURAL[kind], *(str(count[kind]) for count in counts))
        table.add_row("all", *(str(len(group)) for group in groups))
        now = Table(box=None, show_header=False)
        for cell, at in self._started.items():
            now.add_row(duration(time.monotonic() - at), _progress(supervisor, cell), str(cell))
        return Group(table, now)


def _progress(supervisor: Supervisor, cell: Cell) -> str:
    """How far a run is, by its last line."""
    if cell.kind not in ("run", "behaviour"):
        return ""
    path = supervisor.store.artefact(cell) / "metrics.jsonl"
    try:
        with open(path, "rb") as file:
            file.seek(max(0, path.stat().st_size - 8192))
            row = json.loads(file.read().splitlines()[-1])
        return f"{row['env_steps'] / cell.settings['steps']:.0%}"
    except (OSError, ValueError, IndexError, KeyError):
        return ""


def duration(seconds: float) -> str:
    """Hours, minutes or seconds."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
