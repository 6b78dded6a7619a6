"""Figures of made-up results, and what is read back off them."""

import numpy as np

from ppo_dap.study.figures.studies import figures_of
from ppo_dap.study.store.studies import make_study, only
from study.figures.levels_made import made_results

REPS = 8


def drawn(name, seeds=(0, 1, 2), done=lambda labels: True, wanted=None, change=None):
    """A study, made-up results of it, and its figures; `change` puts other figures into a run's row, by its labels."""
    study = make_study(name, seeds=seeds)
    study = only(study, wanted) if wanted else study
    results = made_results(study, done=done)
    for entry in study.entries if change else ():
        if entry.cell.name in results.runs:
            results.runs[entry.cell.name] |= change(entry.labels)
    return study, results, figures_of(results, study)


def line(axes, label):
    """The line of that label in the legend."""
    (found,) = [line for line in axes.lines if str(line.get_label()).partition(" (n =")[0] == label]
    return found


def columns(rows, arm, metric, task=None):
    """A metric of an arm's runs by seed."""
    own = [row for row in rows if row["label"] == arm and task in (None, row["task"])]
    return np.array([row[metric] for row in sorted(own, key=lambda row: row["seed"])])
