"""Statistics of runs (5.1.3), and those that careful reports of RL add: Agarwal et al. 2021, "Deep Reinforcement
Learning at the Edge of the Statistical Precipice". Tests on pairs are in `pairing`.

Every score is one run's (a seed's), higher is better, and what cannot be told is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.tasks.catalogue import CATALOGUE, NAMESPACED

COMPILED_AFTER = 2
"""Iterations in which programs are compiled; they do not count as cost."""
EPOCH = 5_000
"""Environment steps of one epoch (5.1.1)."""
REPS = 2_000
"""Resamples of a bootstrap interval."""

Values = Sequence[float | int] | Float[np.ndarray, " _"]
"""A score a run."""
Scores = Mapping[Any, Float[np.ndarray, "_ ..."]]
"""Stratum (a task) -> a row a seed."""


class Interval(NamedTuple):
    """A figure and its interval; low and high are NaN where a stratum has one row or a resample has no figure."""

    value: float
    low: float
    high: float


def alc(evaluations: Sequence[Mapping[str, Any]], epochs: float = 40) -> float:
    """ALC@T: mean height of the evaluation curve over the first `epochs` of 5k steps, by the trapezoidal rule.

    The curve is cut at T by linear interpolation; a run that ends before T raises `ValueError`.
    """
    steps = np.array([row["env_steps"] for row in evaluations], float)
    returns = np.array([row["return_mean"] for row in evaluations], float)
    end = epochs * EPOCH
    if len(steps) < 2 or steps[-1] < end:
        raise ValueError(f"the evaluations end at {steps[-1] if len(steps) else 0:.0f} steps, before {end:.0f}")
    inside = steps < end
    steps, returns = np.append(steps[inside], end), np.append(returns[inside], np.interp(end, steps, returns))
    return float(np.trapezoid(returns, steps) / end)


def late_return(evaluations: Sequence[Mapping[str, Any]]) -> float:
    """Mean of the evaluations in the last tenth of a run's steps: of more episodes than the last evaluation alone.

    Learning rates are at most a tenth by then, so these policies differ little. Raises `ValueError` without any.
    """
    if not evaluations:
        raise ValueError("a run without evaluations has no return")
    begin = 0.9 * evaluations[-1]["env_steps"]
    return float(np.mean([row["return_mean"] for row in evaluations if row["env_steps"] >= begin]))


def finite(name: str, values: Values) -> Float[np.ndarray, " _"]:
    """`values` as float64; raises `InputError` for none at all, more than one axis, or one that is not finite."""
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or not found.size:
        raise InputError(f"{name} must be one number a run, at least one, not of shape {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"{name} must be finite, not {found[~np.isfinite(found)][0]} (run {_first_not_finite(found)})")
    return found


def _first_not_finite(values: Float[np.ndarray, " _"]) -> int:
    return int(np.argmin(np.isfinite(values)))


def require_level(level: float) -> None:
    """Raise `InputError` unless `level` can be that of an interval."""
    if not 0 < level < 1:
        raise InputError(f"level must be above 0 and below 1, such as 0.95, not {level}")


def normalised_score(task: str, value: float) -> float:
    """(value - random) / (expert - random): 0 plays as random actions do, 1 as D4RL's expert (Fu et al. 2020).

    Raises `InputError` for a task of which the catalogue does not know both returns.
    """
    spec = CATALOGUE.get(NAMESPACED.get(task, task))
    if spec is None or spec.random_return is None or spec.expert_return is None:
        known = ", ".join(normalised_tasks())
        raise InputError(
            f"task {task!r} has no normalised score, its random or expert return is not known: try {known}"
        )
    return (value - spec.random_return) / (spec.expert_return - spec.random_return)


def normalised_tasks() -> list[str]:
    """The tasks that have a normalised score."""
    return [t for t, spec in CATALOGUE.items() if spec.random_return is not None and spec.expert_return is not None]


def mean_interval(values: Values, level: float = 0.95) -> tuple[float, float]:
    """Mean and half-width of its Student-t interval (5.1.3: mean +- 95%); the half-width of one value is NaN.

    The interval takes runs for independent and normal; at n = 3 it is 2.5 standard deviations to each side.
    """
    from scipy.special import stdtrit

    require_level(level)
    found = finite("values", values)
    n = len(found)
    if n == 1:
        return float(found[0]), math.nan
    return float(found.mean()), float(stdtrit(n - 1, (1 + level) / 2) * found.std(ddof=1) / math.sqrt(n))


def interquartile_mean(values: Values) -> float:
    """IQM (Agarwal et al. 2021): the mean without the lowest and the highest floor(n / 4) of all runs together."""
    return float(interquartile_means(finite("values", values)))


def interquartile_means(values: Float[np.ndarray, "... n"]) -> Any:
    """`interquartile_mean` along the last axis."""
    # Not scipy's trim_mean: it checks its arguments for longer than a whole bootstrap takes.
    found, cut = np.sort(values, axis=-1), values.shape[-1] // 4
    return found[..., cut : values.shape[-1] - cut].mean(-1)


def stratified_bootstrap(
    scores: Scores,
    statistic: Callable[[Mapping[Any, Float[np.ndarray, "_ ..."]]], Any],
    reps: int = REPS,
    seed: int = 0,
    level: float = 0.95,
    at_once: bool = False,
) -> Interval:
    """`statistic` of `scores` with its percentile interval; seeds are resampled within each stratum (Agarwal et al.).

    A stratum's rows are drawn with replacement along its first axis, so what stands in one row stays together; strata
    are drawn independently. Percentile intervals of few seeds are too narrow: a nominal 95% covers the mean of 5
    in some 83% of cases, and where every run of one method beats every run of the other the interval is a point.
    `at_once`: the statistic takes all resamples in one call, each array with one more axis in front.
    """
    require_level(level)
    if reps < 1:
        raise InputError(f"reps must be a number of resamples from 1 on, not {reps}")
    if not scores or any(len(rows) == 0 for rows in scores.values()):
        raise InputError(f"scores must have a run in every task, not { ({k: len(v) for k, v in scores.items()}) }")
    value, rng = float(statistic(scores)), np.random.default_rng(seed)
    if any(len(rows) == 1 for rows in scores.values()):
        return Interval(value, math.nan, math.nan)
    picks = {name: rng.integers(len(rows), size=(reps, len(rows))) for name, rows in scores.items()}
    if at_once:
        drawn = statistic({name: rows[picks[name]] for name, rows in scores.items()})
    else:
        drawn = [statistic({name: rows[picks[name][i]] for name, rows in scores.items()}) for i in range(reps)]
    if not np.isfinite(drawn).all():
        return Interval(value, math.nan, math.nan)
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return Interval(value, float(low), float(high))


def probability_of_improvement(
    x: Mapping[str, Values], y: Mapping[str, Values], reps: int = REPS, seed: int = 0, level: float = 0.95
) -> Interval:
    """P(X > Y) of Agarwal et al. 2021, averaged over tasks, with its stratified bootstrap interval.

    `x` and `y` hold the runs of two methods by task. In a task it is the Mann-Whitney U of a run of X against one of Y
    over the number of such pairs, a tie counting half; seeds are not matched. Raises `InputError` unless both have the
    same tasks.
    """
    if not x or x.keys() != y.keys():
        raise InputError(f"x and y must have the same tasks, not {sorted(x)} and {sorted(y)}")
    sides = {"x": x, "y": y}
    scores: dict[Hashable, Any] = {
        (task, side): finite(f"{side} of {task}", runs[task]) for side, runs in sides.items() for task in x
    }

    def over_tasks(scores: Mapping[Any, Any]) -> Any:
        return sum(_improvement(scores[task, "x"], scores[task, "y"]) for task in x) / len(x)

    return stratified_bootstrap(scores, over_tasks, reps, seed, level, at_once=True)


def _improvement(x: Float[np.ndarray, "... a"], y: Float[np.ndarray, "... b"]) -> Any:
    return (np.sign(x[..., :, None] - y[..., None, :]).mean((-2, -1)) + 1) / 2


def relative_change(x: Values, y: Values, reps: int = REPS, seed: int = 0, level: float = 0.95) -> Interval:
    """(mean x - mean y) / |mean y|, with a bootstrap interval that resamples pairs.

    `x` and `y` are matched run by run. Over |mean y|, more is better for negative returns too; where mean y is 0, or
    could be in a resample, it is NaN. Raises `InputError` if they differ in length.
    """
    return mean_relative_change({"": matched(x, y)}, reps, seed, level)


def mean_relative_change(
    pairs: Mapping[str, Float[np.ndarray, "_ 2"]], reps: int = REPS, seed: int = 0, level: float = 0.95
) -> Interval:
    """`relative_change` in each task, of columns of matched runs, and its mean over the tasks; pairs are resampled
    within their task.
    """

    def over_tasks(scores: Mapping[Any, Any]) -> Any:
        return sum(map(_change, scores.values())) / len(scores)

    return stratified_bootstrap(pairs, over_tasks, reps, seed, level, at_once=True)


def _change(pairs: Float[np.ndarray, "... n 2"]) -> Any:
    x, y = np.moveaxis(pairs.mean(-2), -1, 0)
    return np.divide(x - y, np.abs(y), out=np.full(np.shape(y), np.nan), where=y != 0)


def median_ratio(x: Values, y: Values, reps: int = REPS, seed: int = 0, level: float = 0.95) -> Interval:
    """Median over matched runs of x / y, with a bootstrap interval that resamples pairs; NaN unless every y is above 0.

    For costs: one run that had to share its core can be ten times as long as it should, and a mean is then its alone.
    Raises `InputError` if `x` and `y` differ in length.
    """
    pairs = matched(x, y)
    if not (pairs[:, 1] > 0).all():
        return Interval(math.nan, math.nan, math.nan)
    ratios = {"": pairs[:, 0] / pairs[:, 1]}
    return stratified_bootstrap(ratios, lambda drawn: np.median(drawn[""], axis=-1), reps, seed, level, at_once=True)


def matched(x: Values, y: Values) -> Float[np.ndarray, "n 2"]:
    """Two columns of matched runs; raises `InputError` if they differ in length."""
    x, y = finite("x", x), finite("y", y)
    if len(x) != len(y):
        raise InputError(f"x and y must be matched run by run, not {len(x)} and {len(y)} runs")
    return np.stack([x, y], 1)
