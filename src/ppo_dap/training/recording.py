"""A run folder's tables: one JSON line an iteration and an evaluation, TensorBoard, and what the terminal shows."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from ppo_dap.errors import InputError

TABLES = ("metrics", "evaluations")


class Recorder:
    """Appends to `metrics.jsonl` and `evaluations.jsonl`, each line flushed, and mirrors numbers to TensorBoard."""

    def __init__(self, folder: Path, tensorboard: bool, keep: Mapping[str, int] | None = None):
        """`keep` says how many lines of each table belong to the checkpoint that the run resumes from (else 0)."""
        folder.mkdir(parents=True, exist_ok=True)
        self._files: dict[str, Any] = {}
        for table in TABLES:
            path = folder / f"{table}.jsonl"
            rows = path.read_text().splitlines(keepends=True)[: keep[table]] if keep else []
            path.write_text("".join(rows))
            self._files[table] = open(path, "a")  # noqa: SIM115 (open for as long as the run is)
        self.counts: dict[str, int] = dict(keep) if keep else dict.fromkeys(TABLES, 0)
        self._writer = None
        if tensorboard:
            from tensorboardX.writer import FileWriter

            self._writer = FileWriter(str(folder / "tensorboard"))

    def add(self, table: str, row: Mapping[str, Any]) -> None:
        """One more line."""
        self._files[table].write(json.dumps(row) + "\n")
        self._files[table].flush()
        self.counts[table] += 1
        if self._writer is not None:
            from tensorboardX.proto.summary_pb2 import Summary  # type: ignore[attr-defined]

            # One event for the whole row: an event for each number costs twenty times as much.
            numbers = {f"{table}/{name}": row[name] for name in row if name not in ("env_steps", "iteration")}
            values = [
                Summary.Value(tag=tag, simple_value=number)
                for tag, number in numbers.items()
                if isinstance(number, int | float)
            ]
            self._writer.add_summary(Summary(value=values), row["env_steps"])

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()
        if self._writer is not None:
            self._writer.close()


def read_table(folder: Path, table: str) -> list[dict[str, Any]]:
    """Rows of a table of a run folder; a last line that was cut off by a kill is left out."""
    path = folder / f"{table}.jsonl"
    rows = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
        if not isinstance(rows[-1], dict):
            raise InputError(f"{path} is damaged: line {len(rows)} is {line[:40]}, must be an object of named numbers")
    return rows


@runtime_checkable
class Progress(Protocol):
    """What shows a run's progress."""

    def update(self, env_steps: int, shown: Mapping[str, float | None]) -> None:
        """Called once an iteration."""
        ...

    def close(self) -> None:
        """Called once at the end."""
        ...


class Silent:
    """Shows nothing."""

    def update(self, env_steps: int, shown: Mapping[str, float | None]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


class Bar:
    """A bar with return, steps/s and time left, for a terminal."""

    def __init__(self, label: str, total: int, done: int):
        from rich import progress

        columns = (
            progress.TextColumn("{task.description}"),
            progress.BarColumn(),
            progress.TextColumn("{task.completed:>9,.0f}/{task.total:,.0f} steps"),
            progress.TextColumn("return {task.fields[shown]:>8}"),
            progress.TextColumn("{task.fields[speed]:>7}/s"),
            progress.TimeRemainingColumn(),
        )
        self._progress = progress.Progress(*columns)
        self._task = self._progress.add_task(label, total=total, completed=done, shown="-", speed="-")
        self._progress.start()

    def update(self, env_steps: int, shown: Mapping[str, float | None]) -> None:
        """Move the bar."""
        value, speed = shown["return"], shown["steps_per_second"]
        self._progress.update(
            self._task,
            completed=env_steps,
            shown="-" if value is None else f"{value:,.1f}",
            speed="-" if speed is None else f"{speed:,.0f}",
        )

    def close(self) -> None:
        """Leave the bar as it is."""
        self._progress.stop()


class Lines:
    """A plain line at every twentieth of the run, for logs and pipes."""

    def __init__(self, label: str, total: int, done: int):
        self._label, self._total, self._shown = label, total, done * 20 // total

    def update(self, env_steps: int, shown: Mapping[str, float | None]) -> None:
        """Print a line when a twentieth is over."""
        twentieth = env_steps * 20 // self._total
        if twentieth <= self._shown:
            return
        self._shown = twentieth
        value, speed = shown["return"], shown["steps_per_second"] or 0.0
        left = (self._total - env_steps) / speed if speed else 0.0
        text = "-" if value is None else f"{value:,.1f}"
        print(
            f"{self._label}: {env_steps:,}/{self._total:,} steps, return {text}, {speed:,.0f} steps/s, "
            f"{max(left, 0):,.0f} s left",
            file=sys.stderr,
            flush=True,
        )

    def close(self) -> None:
        """Nothing to close."""


def make_progress(label: str, total: int, done: int, enabled: bool) -> Progress:
    """The bar on a terminal, lines elsewhere, nothing when not enabled."""
    if not enabled:
        return Silent()
    return Bar(label, total, done) if sys.stderr.isatty() else Lines(label, total, done)
