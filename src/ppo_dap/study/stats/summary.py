"""One row for each run of a set: what it learned, what it cost, whether it was fair."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from ppo_dap import config as configs
from ppo_dap.methods import get_method, resolve
from ppo_dap.study.stats.measures import COMPILED_AFTER, EPOCH, alc
from ppo_dap.tasks import CATALOGUE
from ppo_dap.training.run import Run

AROUND = {field.name for field in dataclasses.fields(configs.RunConfig)} - {"checkpoint_every"}
"""Settings that do not tell one method from another; where environments restart does."""
AUDIT = {(True, True): "strictly on-policy", (False, True): "not, as declared", (False, False): "VIOLATED"}
"""(strictly on-policy, as its method's row says) -> what a table says."""


def summarise(runs: Sequence[Run], epochs: float = 40) -> list[dict[str, Any]]:
    """A row a run; `x_ppo` and `wall_x_ppo` compare it with the plain PPO run of the same task, seed and steps."""
    return beside_ppo([run_row(run, epochs) for run in runs])


def beside_ppo(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of `run_row`, each with `x_ppo` and `wall_x_ppo` added."""
    base = {_pair(row): row for row in rows if row["method"] == "ppo"}
    for row in rows:
        ppo = base.get(_pair(row))
        row["x_ppo"] = row["alc"] / ppo["alc"] if ppo and ppo["alc"] and row["alc"] is not None else None
        row["wall_x_ppo"] = row["seconds"] / ppo["seconds"] if ppo and ppo["seconds"] else None
    return rows


def _pair(row: dict[str, Any]) -> tuple:
    return row["task"], row["seed"], row["steps"]


def run_row(run: Run, epochs: float = 40) -> dict[str, Any]:
    """What `summarise` says of one run without its PPO; `alc` is None for a run that ends before `epochs`."""
    evaluations, config = run.evaluations, run.config["config"]
    strictly, declared = run.verdict()
    reached = bool(evaluations) and evaluations[-1]["env_steps"] >= epochs * EPOCH
    return {
        "run": str(run.folder),
        "task": run.config["task"],
        "method": run.config["method"],
        "label": label(run.config),
        "preset": run.config["preset"],
        "warm_start": config["warm_start"],
        "seed": config["seed"],
        "steps": config["steps"],
        "finished": run.finished,
        "alc": alc(evaluations, epochs) if reached else None,
        "last_return": evaluations[-1]["return_mean"] if evaluations else None,
        "seconds": sum((row["seconds_iteration"] for row in run.metrics[COMPILED_AFTER:]), 0.0),
        "audit": strictly,
        "declared": declared,
    }


def label(stored: Mapping[str, Any]) -> str:
    """What a run is called beside others: its method, its preset, and the settings that differ from what both say.

    `stored` is the run's config.json. Seed, steps, evaluation and the rest of what surrounds the learning are not part
    of it, nor are settings that this version does not have.
    """
    preset, method = stored["preset"], get_method(stored["method"])
    randomly = stored.get("prior_hash") == "random"
    spec = CATALOGUE.get(stored["task"])
    of_task = {} if spec is None or spec.gamma is None else {"gamma": spec.gamma}
    preset_of = preset if preset in configs.PRESETS else "paper"
    usual = resolve(method, configs.make(preset_of, **of_task), {}, "random" if randomly else None)
    differ = {"prior": "random"} if randomly else {}
    for name, value in configs.flatten(usual).items():
        if name not in AROUND and stored["config"].get(name, value) != value:
            differ[name] = stored["config"][name]
    name = method.name if preset == "paper" else f"{method.name} ({preset})"
    return name + "".join(f" + {key}={value}" for key, value in differ.items())


def columns(epochs: float) -> list[str]:
    """Heads of the `cells`."""
    return ["task", "seed", "method", f"ALC@{epochs:g}", "x PPO", "last return", "training", "x PPO", "audit"]


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of `summarise` in words, under `columns`."""

    def number(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:,.{digits}f}"

    plain = row["preset"] == "paper" or row["method"] == "ppo"
    return [
        row["task"],
        str(row["seed"]),
        row["method"] if plain else f"{row['method']} ({row['preset']})",
        number(row["alc"], 0),
        number(row["x_ppo"], 2),
        number(row["last_return"], 0),
        number(row["seconds"], 0) + " s",
        number(row["wall_x_ppo"], 2),
        AUDIT[row["audit"], row["declared"]],
    ]


def print_summary(rows: Sequence[dict[str, Any]], epochs: float, title: str | None = None) -> None:
    """The rows as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for column in columns(epochs):
        table.add_column(column, justify="left" if column in ("task", "method", "audit") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*cells(row))
    Console(width=120).print(table)
    for row in rows:
        if not row["finished"]:
            print(f"not finished: {row['run']}, which is to have {row['steps']:,} steps")
