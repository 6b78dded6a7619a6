"""What studies are declared in: settings, arms, a scale, and the grid that they span."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ppo_dap import config as configs
from ppo_dap.methods import get_method
from ppo_dap.study.stats.measures import EPOCH
from ppo_dap.study.store import cells
from ppo_dap.study.store.cells import Cell, in_order

FITS: dict[str, dict[str, Any]] = {"tuned": {"logs_filter": 0.3}, "tuned-warm": {"logs_filter": 0.3}}
"""Preset -> what its priors see of the logs, where studies do not say otherwise."""


class Setting(NamedTuple):
    """A task and the tier of its logs."""

    task: str
    tier: str


class Arm(NamedTuple):
    """One side of a comparison, the same on every setting."""

    name: str
    method: str = "ppo-dap"
    preset: str = "paper"
    options: Mapping[str, Any] = {}
    fit: Mapping[str, Any] = {}
    """Of the prior: coverage, or fields of its settings, over what the preset's priors have (`FITS`)."""
    axes: Mapping[str, Any] = {}
    """What a figure puts on an axis: more labels."""


class Entry(NamedTuple):
    """A cell with its labels: task, logs, arm, method, preset, seed, steps, part, and the axes of its arm."""

    cell: Cell
    labels: dict[str, Any]


@dataclass(frozen=True)
class Study:
    """A declared grid."""

    name: str
    title: str
    epochs: float
    """T of ALC@T: 40, or what the shorter runs last."""
    entries: tuple[Entry, ...]

    def cells(self) -> list[Cell]:
        """Everything to be made, each cell once and after what it needs; the first seed of all before the second."""
        by_seed = sorted(self.entries, key=lambda entry: entry.labels.get("seed", 0))
        return in_order(entry.cell for entry in by_seed)


@dataclass(frozen=True)
class Scale:
    """How large studies are."""

    early_steps: int = 200_000
    """Of runs that are there for the early efficiency: 40 epochs."""
    full_steps: int = 1_000_000
    """Of runs that are there for the final return (Table 2)."""
    many: Sequence[int] = tuple(range(8))
    """Seeds of early runs that a claim rests on: fewer cannot reach p < 0.01."""
    few: Sequence[int] = tuple(range(3))
    """Seeds of the others; the paper has 3 to 5."""
    rows: int = 100_000
    """Of logs, at least."""
    behaviour_steps: int = 1_000_000
    behaviour_seed: int = 100
    """Of behaviours; no run of a study has it, or one of the two after it."""
    run_options: Mapping[str, Any] = field(default_factory=lambda: {"tensorboard": False})
    guided_options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of runs with a prior."""
    fit_options: Mapping[str, Any] = field(default_factory=dict)
    reliability: Mapping[str, Any] = field(default_factory=lambda: {"states": 64, "rollouts": 8})
    task: str | None = None
    """Stands for every task, for studies that are to be small."""
    presets: Sequence[str] = ("paper", "tuned")
    """Of arms that are there in each."""
    brief: bool = False
    """Of each axis the two ends alone."""

    @property
    def epochs(self) -> float:
        """T of ALC@T."""
        return min(40.0, self.early_steps / EPOCH, self.full_steps / EPOCH)

    def ends(self, values: Sequence[Any]) -> list[Any]:
        """The values of an axis."""
        return [values[0], values[-1]] if self.brief else list(values)

    def settings(self, settings: Iterable[Setting]) -> list[Setting]:
        """The settings, with the task that stands for all."""
        found = list(settings)
        if self.task is None:
            return found
        # One tier for all saves what is slowest; logs of several gaits are a matter of their own.
        return [Setting(self.task, "mixed" if found[0].tier == "mixed" else "medium-expert")]

    def logs(self, setting: Setting) -> Cell:
        """Logs of the setting."""
        return cells.logs(*setting, self.rows, self.behaviour_seed, self.behaviour_steps)

    def prior(self, setting: Setting, kind: str, fit: Mapping[str, Any]) -> Cell:
        """The prior of an arm."""
        return cells.prior(self.logs(setting), kind, **{**self.fit_options, **fit})

    def run(self, setting: Setting, arm: Arm, seed: int, steps: int) -> Cell:
        """A run of an arm."""
        method = get_method(arm.method)
        started = configs.make(arm.preset, **arm.options).warm.warm_start != "none"
        guided, warm = method.prior != "none", method.needs_logs or started
        options = {**self.run_options, **(self.guided_options if guided else {}), **arm.options}
        return cells.run(
            setting.task,
            arm.method,
            arm.preset,
            prior=self.prior(setting, method.prior, {**FITS.get(arm.preset, {}), **arm.fit}) if guided else None,
            logs=self.logs(setting) if warm else None,
            seed=seed,
            steps=steps,
            **options,
        )

    def grid(
        self, settings: Iterable[Setting], arms: Iterable[Arm], seeds: Iterable[int], steps: int, part: str
    ) -> Iterator[Entry]:
        """Every arm on every setting with every seed."""
        arms, seeds = list(arms), list(seeds)
        for setting in self.settings(settings):
            for arm in arms:
                for seed in seeds:
                    labels = {"part": part, "task": setting.task, "logs": setting.tier, "arm": arm.name}
                    labels |= {"method": arm.method, "preset": arm.preset, "seed": seed, "steps": steps}
                    yield Entry(self.run(setting, arm, seed, steps), labels | dict(arm.axes))

    def early(self, settings: Iterable[Setting], arms: Iterable[Arm], seeds: Sequence[int] | None = None):
        """A grid of early runs, part `early`."""
        return self.grid(settings, arms, self.few if seeds is None else seeds, self.early_steps, "early")

    def full(self, settings: Iterable[Setting], arms: Iterable[Arm]):
        """A grid of full runs, part `full`."""
        return self.grid(settings, arms, self.few, self.full_steps, "full")

    def of_presets(self, *arms: Arm) -> list[Arm]:
        """Each arm in each preset."""
        return [arm._replace(name=_named(arm.name, p), preset=p) for arm in arms for p in self.presets]


def _named(name: str, preset: str) -> str:
    return name if preset == "paper" else f"{name} ({preset})"
