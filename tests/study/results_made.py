"""Results of a study that are made up: every run has the numbers that a function gives to its labels."""

import math
from dataclasses import dataclass

from ppo_dap.study.results import Results
from ppo_dap.study.stats.measures import EPOCH
from ppo_dap.study.store.cells import Cell
from ppo_dap.study.store.grids import Scale

HOLDS = {"strictly_on_policy": True, "as_declared": True, "oglr": 0.0, "spr": 1.0, "pgshare": 0.95, "batch_fresh": 1.0}
COST = {"env_steps": 1000, "seconds_iteration": 2.0, "seconds_env": 1.5, "peak_mib": 400.0}
KLS = {"policy_kl": 0.02, "prior_kl": 0.001}


def made(study, numbers):
    """`numbers` takes an entry's labels and gives what differs from the above, None for a run that is not finished.

    `alc` is the height of a flat evaluation curve, so the area under it at any T.
    """
    results = Results()
    for entry in study.entries:
        own = numbers(entry.labels)
        if own is None:
            continue
        if entry.cell.kind == "reliability":
            results.reports[entry.cell.name] = {"of": entry.cell.needs["run"].name} | own
            continue
        row = {name: entry.labels[name] for name in ("task", "logs", "method", "preset", "seed", "steps")}
        row |= {"options": "", "last_return": 0.0, "last_length": 1000.0, "seconds": 9.0} | HOLDS | COST | KLS
        height = own.pop("alc", 0.0)
        results.runs[entry.cell.name] = row | own
        results.curves[entry.cell.name] = [
            {"env_steps": steps, "return_mean": height, "length_mean": 1000.0}
            for steps in (0, math.ceil(study.epochs * EPOCH))
        ]
    return results


@dataclass(frozen=True)
class Light(Scale):
    """The grids as they are declared, with cells that are named by their labels: settings take a minute to resolve."""

    def run(self, setting, arm, seed, steps):
        settings = {"task": setting.task, "arm": arm.name, "seed": seed, "steps": steps}
        return Cell("run", settings, {"prior": Cell("prior", {"seed": 0})})
