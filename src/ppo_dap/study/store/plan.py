"""What a study still has to do in a store, and what that will take."""

from __future__ import annotations

import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ppo_dap.study.store.cells import KINDS, Cell
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.store import Store
from ppo_dap.tasks import describe

START = 8.0
"""Seconds that a process takes before its work begins; this and what follows are for estimates alone."""
TRAINING_SHARE = 0.7
"""Speed of training, evaluations included, over that of the bare environments."""
GUIDED = 1.5
"""Time of a run with a prior over that of PPO."""
SECONDS = {"prior": 60.0, "reliability": 120.0}
RUN_BYTES, PRIOR_BYTES, OTHER_BYTES = 3e6, 1e6, 1e5

Speed = Callable[[str], float]
"""Environment steps a second of a task's bare environments."""


@dataclass
class Plan:
    """The cells of a study, in the order in which they are made, beside what a store holds of them."""

    study: Study
    store: Store
    speed: Speed

    @cached_property
    def cells(self) -> list[Cell]:
        """Every cell once, after what it needs."""
        return self.study.cells()

    @cached_property
    def done(self) -> set[Cell]:
        """What was there when this was asked first. Raises `InputError` for what was made with other settings."""
        for cell in self.cells:
            self.store.check(cell)
        return {cell for cell in self.cells if self.store.done(cell)}

    @property
    def missing(self) -> list[Cell]:
        """What was not, in order."""
        return [cell for cell in self.cells if cell not in self.done]

    @cached_property
    def _rates(self) -> dict[tuple, tuple[float, int]]:
        """Seconds a unit of work of finished cells, their sum and number, by what the cells have in common."""
        found: dict[tuple, tuple[float, int]] = {}
        for cell in self.done:
            self.learn(cell, found)
        return found

    def learn(self, cell: Cell, rates: dict[tuple, tuple[float, int]] | None = None) -> None:
        """Take the cost of a cell that is finished now into the estimates."""
        rates, seconds = self._rates if rates is None else rates, self.store.cost(cell).get("seconds", 0.0)
        for key in _alike(cell) if seconds else ():
            total, count = rates.get(key, (0.0, 0))
            rates[key] = total + seconds / _work(cell), count + 1

    @cached_property
    def _speeds(self) -> dict[str, float]:
        return {}

    def seconds(self, cell: Cell) -> float:
        """What making the cell takes on one core, by finished cells like it, or else by the speed of its task."""
        for key in _alike(cell):
            if key in self._rates:
                total, count = self._rates[key]
                return total / count * _work(cell)
        if cell.kind in SECONDS:
            return START + SECONDS[cell.kind]
        task, settings = cell.settings["task"], cell.settings
        if task not in self._speeds:
            self._speeds[task] = self.speed(task)
        if cell.kind == "logs":
            return START + settings["rows"] / self._speeds[task]
        guided = GUIDED if "prior" in cell.needs else 1.0
        return START + guided * settings["steps"] / (TRAINING_SHARE * self._speeds[task])

    @cached_property
    def _sizes(self) -> dict[tuple, float]:
        found: dict[tuple, list[float]] = defaultdict(list)
        for cell in self.done:
            if not any(len(found[key]) >= 3 for key in _alike(cell)[:1]):  # three are enough: a folder has to be walked
                for key in _alike(cell):
                    found[key].append(self.store.size(cell) / _work(cell))
        return {key: statistics.median(values) for key, values in found.items()}

    def bytes(self, cell: Cell) -> float:
        """Room that the cell takes on the disk."""
        for key in _alike(cell):
            if key in self._sizes:
                return self._sizes[key] * _work(cell)
        if cell.kind in ("behaviour", "logs"):
            spec = describe(cell.settings["task"])
            row = 4 * (spec.observation_size + spec.action_size + 2)
            return row * _work(cell)
        return {"run": RUN_BYTES, "prior": PRIOR_BYTES}.get(cell.kind, OTHER_BYTES)

    def totals(self) -> dict[str, Any]:
        """Cells, seconds on one core and bytes of what is missing."""
        missing = self.missing
        return {
            "cells": len(self.cells),
            "done": len(self.done),
            "seconds": sum(map(self.seconds, missing)),
            "bytes": sum(map(self.bytes, missing)),
            "free_bytes": self.store.free_bytes(),
        }


def _work(cell: Cell) -> float:
    """What a cell's time grows with."""
    return float(cell.settings.get("steps" if cell.kind != "logs" else "rows", 1.0))


def _alike(cell: Cell) -> list[tuple]:
    """What a cell has in common with others, the closest first."""
    settings = cell.settings
    if cell.kind == "run":
        keys = [(settings["task"], settings["method"]), (settings["task"], "prior" in cell.needs)]
        keys = [keys[0] + tuple(sorted((k, str(v)) for k, v in cell.call.items() if k != "seed")), *keys]
    elif cell.kind == "prior":
        keys = [(settings["kind"],)]
    else:
        keys = [(settings["task"],)] if "task" in settings else [()]
    return [(cell.kind, *key) for key in keys]


def print_plan(plan: Plan, workers: int, say: Callable[[str], None] = print) -> None:
    """A line a cell, and what is to come in all."""
    for cell in plan.cells:
        state = "done" if cell in plan.done else "-"
        hours = "" if cell in plan.done else f"{plan.seconds(cell) / 3600:.2f} h"
        say(f"{cell.name}  {state:4}  {hours:>8}  {cell}")
    say(summary(plan, workers))


def summary(plan: Plan, workers: int) -> str:
    """The plan in two lines."""
    kinds, done = Counter(cell.kind for cell in plan.cells), Counter(cell.kind for cell in plan.done)
    parts = ", ".join(f"{done[kind]} of {kinds[kind]} {PLURAL[kind]}" for kind in KINDS if kinds[kind])
    totals = plan.totals()
    hours = totals["seconds"] / 3600
    return (
        f"{plan.study.name} ({plan.study.title}): {len(plan.cells)} cells; done: {parts}\n"
        f"to come: {len(plan.missing)} cells, {hours:.1f} h on one core, about {hours / workers:.1f} h with "
        f"{workers} workers; {totals['bytes'] / 1e9:.2f} GB of disk, {totals['free_bytes'] / 1e9:.0f} GB are free"
    )


PLURAL: Mapping[str, str] = {
    "behaviour": "behaviours",
    "logs": "logs",
    "prior": "priors",
    "run": "runs",
    "reliability": "reports",
}
