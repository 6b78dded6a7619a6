"""Equation 14 as a lens on a run (4.8, Appendix A): what each update was worth, beside the terms that should bound it.

J(pi_{k+1}) - J(pi_k) >= L - c1 KL(pi_{k+1} || pi_k) - c2 KL(p_{k+1} || p_k) - c3 eta. All terms but the constants are
in a run's metrics. Everything here is in units of scaled reward, as the networks see it; docs/diagnostics.md says how
far the two sides are the same quantity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ppo_dap.errors import InputError
from ppo_dap.nets.normalizer import RunningMoments
from ppo_dap.storage import read_tensors
from ppo_dap.study.diagnostics.reliability import rank_correlation
from ppo_dap.training.run import Run, load_run
from ppo_dap.training.state import FORMAT

PENALTIES = {"c1": "policy_kl", "c2": "prior_kl", "c3": "eta"}
"""Constants of Eq. 14 and what they weigh."""
SIGMAS = 2.0
"""Standard errors that a drop of the measured return is excused by in `constants_beyond_noise`."""

NOTHING = 1e-9
"""A penalty of this share of its mean is 0: the solver takes it for that too."""


class Anchor(NamedTuple):
    """A measured return: J of the policy before update number `update` (from 0), and its standard error if known."""

    update: int
    value: float
    error: float = float("nan")


class Terms(NamedTuple):
    """The terms of Eq. 14 between measured returns, a row a span; sums over the span's updates."""

    first: Float[np.ndarray, " n"]
    """Number of the span's first update."""
    last: Float[np.ndarray, " n"]
    """Number of the update after its last."""
    delta: Float[np.ndarray, " n"]
    """J after it less J before it."""
    noise: Float[np.ndarray, " n"]
    """Standard error of `delta`."""
    surrogate: Float[np.ndarray, " n"]
    """L."""
    penalties: dict[str, Float[np.ndarray, " n"]]
    """Terms of `PENALTIES` that the run has, without their constants."""


class Constants(NamedTuple):
    """The smallest constants that make Eq. 14 hold."""

    values: dict[str, float]
    infeasible: Bool[np.ndarray, " n"]
    """Spans in which the return fell short of the surrogate although every penalty is 0: no constant helps."""
    binding: Bool[np.ndarray, " n"]
    """Spans in which the two sides are equal."""
    slack: Float[np.ndarray, " n"]
    """Left side less right side."""


def return_noise(returns: Float[np.ndarray, " n"]) -> float:
    """Standard error of each of a series of measured returns whose truth is locally a line: second differences of
    independent errors have six times their variance. NaN for fewer than three.
    """
    return float(np.sqrt(np.mean(np.square(np.diff(returns, 2))) / 6)) if len(returns) > 2 else float("nan")


def training_anchors(rows: Sequence[Mapping[str, Any]]) -> list[Anchor]:
    """Mean return of the training episodes that ended in each iteration, for the policy that the iteration began with.

    Iterations in which none ended measure nothing: their updates belong to one span with what comes next.
    """
    found = [(k, float(row["return_train"])) for k, row in enumerate(rows) if row.get("return_train") is not None]
    error = return_noise(np.array([value for _, value in found]))
    return [Anchor(k, value, error) for k, value in found]


def evaluation_anchors(rows: Sequence[Mapping[str, Any]], evaluations: Sequence[Mapping[str, Any]]) -> list[Anchor]:
    """Evaluations of the deterministic policy, each after the updates of the steps before it."""
    steps = np.array([row["env_steps"] for row in rows])
    found = {}
    for row in evaluations:
        episodes = row.get("episodes", 1)
        error = row["return_std"] / np.sqrt(episodes - 1) if episodes > 1 else float("nan")
        update = int(np.searchsorted(steps, row["env_steps"], side="right"))
        found[update] = Anchor(update, float(row["return_mean"]), float(error))
    return [found[update] for update in sorted(found)]


def terms(rows: Sequence[Mapping[str, Any]], anchors: Sequence[Anchor], gamma: float, reward_std: float) -> Terms:
    """The terms of Eq. 14 between consecutive `anchors`, from the metrics' `rows`.

    Returns are divided by `reward_std`; the surrogate is multiplied by 1 / (1 - gamma), which is what makes a mean
    advantage a difference of discounted returns (A.2, step 1). eta is the root of the Q head's TD loss. Both terms of
    the prior are 0 after the last iteration in which it was in use.

    Raises `InputError` for metrics that lack a term, or fewer than two anchors.
    """
    if len(anchors) < 2:
        raise InputError(f"{len(anchors)} measured returns in the run: Eq. 14 needs two at least")
    guided = "q_loss" in rows[0]
    columns = {name: _column(rows, name) for name in ("surrogate", "policy_kl")}
    if guided:
        in_use = 1 + max(k for k, row in enumerate(rows) if "q_loss" in row)
        rest = np.zeros(len(rows) - in_use)
        columns |= {name: np.append(_column(rows[:in_use], name), rest) for name in ("prior_kl", "q_loss")}
        columns["eta"] = np.sqrt(columns.pop("q_loss"))
    total = {name: np.append(0.0, np.cumsum(values)) for name, values in columns.items()}
    first, last = (np.array([a.update for a in side]) for side in (anchors[:-1], anchors[1:]))
    span = {name: sums[last] - sums[first] for name, sums in total.items()}
    values, errors = (np.array([getattr(a, name) for a in anchors]) / reward_std for name in ("value", "error"))
    horizon = 1 / (1 - gamma) if gamma < 1 else 1.0
    return Terms(
        first.astype(float),
        last.astype(float),
        np.diff(values),
        np.hypot(errors[1:], errors[:-1]),
        horizon * span.pop("surrogate"),
        {name: np.maximum(values, 0.0) for name, values in span.items()},  # a KL of 0 can come out below it
    )


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> Float[np.ndarray, " n"]:
    values = [row.get(name) for row in rows]
    if any(value is None or not np.isfinite(value) for value in values):
        raise InputError(f"the run's metrics.jsonl lacks a finite {name} in some iteration: Eq. 14 needs it in all")
    return np.array(values, float)


def fit_constants(found: Terms, allowance: Float[np.ndarray, " n"] | float = 0.0) -> Constants:
    """Eq. 14: the constants >= 0 with the smallest mean slack for which the inequality holds in every span, by linear
    programming; `allowance` is added to the left side.

    Spans for which no constants can do it are left out and told.
    """
    from scipy.optimize import linprog

    matrix = np.stack(list(found.penalties.values()), axis=1)
    short = found.surrogate - found.delta - allowance
    mean = matrix.mean(0)
    scale, size = np.where(mean > 0, mean, 1.0), max(float(np.abs(short).max()), 1e-12)
    infeasible = (short > 0) & ((matrix / scale).max(1) <= NOTHING)
    rows, needed = matrix[~infeasible], short[~infeasible]
    # Columns and right side near 1, since the solver's tolerances are absolute.
    solved = linprog((mean > 0).astype(float), A_ub=-rows / scale, b_ub=-needed / size, bounds=(0, None))
    values = np.where(mean > 0, solved.x * size / scale, 0.0)
    reached = rows @ values
    wanting = (needed > 0) & (reached > 0)
    if wanting.any():  # by the solver's tolerance
        values = values * max(1.0, float((needed[wanting] / reached[wanting]).max()))
    slack = matrix @ values - short
    named = dict(zip((c for c, name in PENALTIES.items() if name in found.penalties), values.tolist(), strict=True))
    return Constants(named, infeasible, ~infeasible & (slack <= 1e-6 * size), slack)


def fitted_scale(found: Terms) -> float:
    """What L would have to be multiplied by to be nearest to the measured changes, by least squares through 0; NaN
    where L is 0 throughout.
    """
    square = float(np.sum(np.square(found.surrogate)))
    return float(np.sum(found.surrogate * found.delta)) / square if square > 0 else float("nan")


class Bound(NamedTuple):
    """The report, and the terms and constants of each reading that it was made of."""

    report: dict[str, Any]
    readings: dict[str, tuple[Terms, Constants]]


def bound(folder: str | Path) -> Bound:
    """Eq. 14 for the run in `folder`, finished or not: read by training episodes and by evaluations.

    Raises `InputError` for a run without checkpoint (it holds the reward scale) or with too few iterations.
    """
    run = load_run(folder)
    rows, gamma, reward_std = run.metrics, float(run.config["config"]["gamma"]), _reward_std(run)
    anchors = {"training": training_anchors(rows), "evaluation": evaluation_anchors(rows, run.evaluations)}
    if not rows or all(len(found) < 2 for found in anchors.values()):
        raise InputError(f"{folder} has {len(rows)} iterations and no two measured returns: let it run on")
    readings, parts = {}, {}
    for name, found in anchors.items():
        if len(found) > 1:
            measured = terms(rows, found, gamma, reward_std)
            readings[name] = measured, fit_constants(measured)
            parts[name] = _reading(*readings[name])
    head = {"run": str(folder), "task": run.config["task"], "method": run.config["method"], "iterations": len(rows)}
    units = {"gamma": gamma, "reward_std": reward_std, "surrogate_scale": 1 / (1 - gamma) if gamma < 1 else 1.0}
    return Bound(head | units | {"readings": parts}, readings)


def _reward_std(run: Run) -> float:
    tensors, _ = read_tensors(run.folder / "checkpoints" / "last.safetensors", kind="checkpoint", newest=FORMAT)
    moments = RunningMoments(float(tensors["rewards.count"]), tensors["rewards.mean"], tensors["rewards.m2"])
    return float(moments.std[0])


def _reading(found: Terms, constants: Constants) -> dict[str, Any]:
    noise = np.nan_to_num(found.noise)
    beyond = fit_constants(found, SIGMAS * noise)
    names = [name for name in PENALTIES.values() if name in found.penalties]
    weighed = dict(zip(names, constants.values.values(), strict=True))
    return {
        "spans": len(found.delta),
        "drops": int((found.delta < 0).sum()),
        "delta_mean": float(found.delta.mean()),
        "delta_std": float(found.delta.std()),
        "delta_noise": float(found.noise.mean()),
        "surrogate_mean": float(found.surrogate.mean()),
        "surrogate_fitted_scale": fitted_scale(found),
        "rho_surrogate_and_delta": rank_correlation(found.surrogate, found.delta),
        "constants": constants.values,
        "constants_beyond_noise": beyond.values,
        "penalty_means": {name: weighed[name] * float(found.penalties[name].mean()) for name in names},
        "slack_mean": float(constants.slack[~constants.infeasible].mean()) if not constants.infeasible.all() else None,
        "binding": (found.first[constants.binding] + 1).astype(int).tolist(),
        "infeasible": (found.first[constants.infeasible] + 1).astype(int).tolist(),
    }


def print_bound(report: Mapping[str, Any]) -> None:
    """The report in words."""
    print(
        f"{report['task']}, {report['method']}, {report['iterations']} iterations; in units of scaled reward (return / "
        f"{report['reward_std']:.3g}, surrogate x {report['surrogate_scale']:.4g})"
    )
    for name, r in report["readings"].items():
        constants = ", ".join(f"{c} ({PENALTIES[c]}) {value:.4g}" for c, value in r["constants"].items())
        beyond = ", ".join(f"{c} {value:.4g}" for c, value in r["constants_beyond_noise"].items())
        means = ", ".join(f"{part} {value:.3g}" for part, value in r["penalty_means"].items())
        print(
            f"{name}: {r['spans']} changes of return, {r['drops']} of them drops, mean {r['delta_mean']:+.3g}, spread "
            f"{r['delta_std']:.3g}, of that noise {r['delta_noise']:.3g}\n"
            f"  surrogate: mean {r['surrogate_mean']:+.3g}; nearest to the changes when x "
            f"{r['surrogate_fitted_scale']:.3g}; rank correlation with them {r['rho_surrogate_and_delta']:.2f}\n"
            f"  smallest constants: {constants}; beyond {SIGMAS:g} standard errors of the changes: {beyond}\n"
            f"  mean penalties: {means}; binding in iterations {', '.join(map(str, r['binding'])) or 'none'}"
        )
        if r["infeasible"]:
            print(f"  NO constants can hold in iterations {', '.join(map(str, r['infeasible']))}: all penalties are 0")


def bound_figure(found: Bound, path: Path) -> None:
    """The two sides of Eq. 14 over the iterations, and below them what each penalty takes away; by the reading of
    training episodes where the run has one.
    """
    from ppo_dap.study.plots.curves import STYLES
    from ppo_dap.study.plots.png import saved_figure

    reading = next(iter(found.readings))
    measured, constants = found.readings[reading]
    middle, below = (measured.first + measured.last + 1) / 2, np.zeros(len(measured.first))
    taken = dict(zip(measured.penalties, constants.values.values(), strict=True))
    right = measured.surrogate - sum(value * measured.penalties[name] for name, value in taken.items())
    with saved_figure(path, (7.0, 7.5), rows=3) as (top, bottom, each):
        top.plot(middle, measured.delta, "o-", color="black", markersize=3, linewidth=0.8, label="change of return")
        top.plot(middle, measured.surrogate, "--", color="#0072B2", label="surrogate")
        top.plot(middle, right, "-.", color="#D55E00", label="right side")
        for rows, mark, label in (
            (constants.binding, "D", "binding"),
            (constants.infeasible, "x", "no constants hold"),
        ):
            if rows.any():
                top.plot(middle[rows], measured.delta[rows], mark, color="#D55E00", markersize=6, label=label)
        for (name, constant), c, (colour, dash) in zip(taken.items(), constants.values, STYLES, strict=False):
            penalty = measured.penalties[name]
            height = constant * penalty
            label = f"{c} {name} (c = {constant:.3g})"
            bottom.fill_between(middle, below, below + height, color=colour, alpha=0.7, label=label, linewidth=0)
            below = below + height
            shown = np.where(penalty > 0, penalty, np.nan)
            each.plot(middle, shown, color=colour, linestyle=dash, label=name)
        top.set(ylabel="scaled reward", title=f"Eq. 14 on {found.report['task']}, {found.report['method']} ({reading})")
        bottom.set(ylabel="penalties, stacked")
        each.set(ylabel="without constants", xlabel="iteration", yscale="log")
        for axes in (top, bottom, each):
            axes.legend(frameon=False, fontsize=8)
