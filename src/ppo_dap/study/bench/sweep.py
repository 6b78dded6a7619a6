"""`ppo-dap bench --sweep`: what the method costs against each of its knobs, as a table and a figure."""

from __future__ import annotations

import csv
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ppo_dap.study.bench.bench import train_for
from ppo_dap.training.recording import read_table

KNOBS: dict[str, tuple[str, Sequence[float]]] = {
    "K, proposals a state": ("--num-proposals", (5, 10, 20, 40)),
    "N_steps, denoising steps": ("--sampler-steps", (5, 10, 20, 40)),
    "share of states with proposals": ("--proposal-fraction", (0.1, 0.2, 0.4, 1.0)),
    "r, rank of the adapters": ("--adapter-rank", (2, 8, 32, 64)),
    "f, PET steps per 100 updates": ("--pet-frequency", (5, 10, 20, 40)),
    "environments": ("--num-envs", (4, 8, 16, 32)),
}
ACTION_SIZES = {"Hopper-v5": 3, "Walker2d-v5": 6, "Ant-v5": 8, "HumanoidStandup-v5": 17}
DEVICE = ("proposals", "pet", "audit")
ROWS, STEPS = 20_000, 2048 * 16


def sweep(task: str, table: Path, say: Callable[[str], None]) -> None:
    """Write `table` (a row a setting) and the figure beside it; one run a setting, all else as in preset `paper`.

    A row is written as soon as it is measured.
    """
    settings = [(task, knob, value, (option, str(value))) for knob, (option, every) in KNOBS.items() for value in every]
    settings += [(other, "action dimensions", size, ()) for other, size in ACTION_SIZES.items()]
    rows: list[dict[str, Any]] = []
    table.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="ppo-dap-sweep-") as name, open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, ["task", "knob", "value", *DEVICE, "iteration"])
        writer.writeheader()
        priors = {each: _prior(Path(name), each) for each in {task, *ACTION_SIZES}}
        for on, knob, value, options in settings:
            rows.append(_row(Path(name), on, priors[on], knob, value, options))
            writer.writerow(rows[-1])
            file.flush()
            say(_line(rows[-1]))
    draw(rows, table.with_suffix(".png"))
    say(f"{table} and {table.with_suffix('.png')}")


def _prior(folder: Path, task: str) -> Path:
    """A prior on logs of an untrained policy: its cost does not depend on what it has learned."""
    behaviour, logs, prior = (folder / f"{task}-{part}" for part in ("behaviour", "logs.npz", "prior"))
    train_for(behaviour, task, ("--method", "ppo"), 2048)
    from ppo_dap.logs import load_logs
    from ppo_dap.logs.npz import save_npz
    from ppo_dap.priors import fit_prior
    from ppo_dap.training.collect import collect_logs
    from ppo_dap.training.run import load_run

    save_npz(collect_logs(load_run(behaviour).policy, task, ROWS), logs)
    fit_prior(load_logs(logs), max_steps=200).save(prior)
    return prior


def _row(folder: Path, task: str, prior: Path, knob: str, value: float, options: Sequence[str]) -> dict[str, Any]:
    run = folder / f"{task}-{knob}-{value}".replace(" ", "_")
    train_for(run, task, ("--prior", str(prior), *options), STEPS)
    metrics = read_table(run, "metrics")[2:]
    milliseconds = {name: 1e3 * statistics.median(row[f"seconds_{name}"] for row in metrics) for name in DEVICE}
    whole = 1e3 * statistics.median(row["seconds_iteration"] for row in metrics)
    return (
        {"task": task, "knob": knob, "value": value}
        | {k: round(v, 2) for k, v in milliseconds.items()}
        | {"iteration": round(whole, 1)}
    )


def _line(row: Mapping[str, Any]) -> str:
    costs = ", ".join(f"{name} {row[name]:.1f}" for name in (*DEVICE, "iteration"))
    return f"{row['task']}, {row['knob']} = {row['value']:g}: {costs} ms"


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """A panel a knob: milliseconds an iteration against the knob, both axes logarithmic, with the slope of linear."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from ppo_dap.study.plots.curves import STYLES

    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    figure, axes = pyplot.subplots(2, 4, figsize=(12, 5.4), layout="constrained", sharey=True)
    for axis, knob in zip(axes.flat, knobs, strict=False):
        own = [row for row in rows if row["knob"] == knob]
        values = [row["value"] for row in own]
        for name, (colour, dash) in zip(DEVICE, STYLES, strict=False):
            axis.plot(values, [row[name] for row in own], color=colour, linestyle=dash, marker="o", ms=3, label=name)
        first = own[0]["proposals"]
        axis.plot(values, [first * v / values[0] for v in values], color="0.7", linewidth=0.8, label="linear")
        axis.set(xscale="log", yscale="log", xlabel=knob)
        axis.set_xticks(values, [f"{value:g}" for value in values])
        axis.minorticks_off()
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("ms an iteration")
    for axis in axes.flat[len(knobs) :]:
        axis.axis("off")
    axes.flat[len(knobs)].legend(*axes.flat[0].get_legend_handles_labels(), frameon=False, loc="center")
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
