"""Intervals, means and effect sizes over runs, each against another implementation or a closed form."""

import math
from functools import partial

import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.study.stats.measures import (
    interquartile_mean,
    mean_interval,
    mean_relative_change,
    median_ratio,
    normalised_score,
    normalised_tasks,
    probability_of_improvement,
    relative_change,
    stratified_bootstrap,
)
from ppo_dap.tasks import CATALOGUE


def draws(*shape, seed=0):
    return np.random.default_rng(seed).normal(3, 2, shape)


@pytest.mark.parametrize("n", [2, 3, 5, 10])
@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
def test_mean_interval_against_scipy(n, level):
    values = draws(n, seed=n)
    mean, half = mean_interval(values, level)
    low, high = stats.t.interval(level, n - 1, values.mean(), stats.sem(values))
    assert (mean - half, mean + half) == pytest.approx((low, high), rel=1e-9)


def test_mean_interval_by_the_printed_table():
    """t(0.975) is 4.303 at 2 degrees of freedom; 1, 2, 3 have standard deviation 1."""
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2, 4.303 / math.sqrt(3)), rel=1e-4)


def test_one_run_has_a_mean_and_no_interval():
    mean, half = mean_interval([4.0])
    assert mean == 4
    assert math.isnan(half)


def misses(interval, runs=1500, n=5):
    """Share of samples of standard normals whose 95% interval leaves out their mean, 0."""
    samples = np.random.default_rng(1).normal(size=(runs, n))
    bounds = np.array([interval(sample) for sample in samples])
    return float(((bounds[:, 0] > 0) | (bounds[:, 1] < 0)).mean())


def student(values):
    mean, half = mean_interval(values)
    return mean - half, mean + half


def test_coverage_of_student_t():
    """5% of 1,500 miss, give or take four standard errors; with the normal's 1.96 for the quantile it would be 12%."""
    assert misses(student) == pytest.approx(0.05, abs=0.022)

    def planted(values):
        half = 1.96 * values.std(ddof=1) / math.sqrt(len(values))
        return values.mean() - half, values.mean() + half

    assert misses(planted) > 0.09


def test_coverage_of_the_bootstrap():
    """At n = 30 near its level; at n = 5 too narrow, as its docstring says: 17% miss."""

    def interval(values):
        return stratified_bootstrap({"a": values}, lambda scores: scores["a"].mean(), reps=150)[1:]

    assert misses(interval, runs=250, n=30) == pytest.approx(0.05, abs=0.045)
    assert misses(interval, runs=250, n=5) == pytest.approx(0.17, abs=0.07)


@pytest.mark.parametrize("n", range(1, 26))
def test_interquartile_mean_against_scipy(n):
    values = draws(n, seed=n)
    assert interquartile_mean(values) == pytest.approx(float(stats.trim_mean(values, 0.25)))


def test_interquartile_mean_by_hand():
    """Of nine the two lowest and the two highest go, whatever they are."""
    assert interquartile_mean([9.0, 1, -1e9, 5, 4, 6, 2, 1e9, 7]) == pytest.approx((2 + 4 + 5 + 6 + 7) / 5)


def test_stratified_bootstrap_against_scipy():
    values = draws(40)
    found = stratified_bootstrap({"a": values}, lambda scores: scores["a"].mean(), reps=4000, seed=3)
    theirs = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=4000, rng=np.random.default_rng(0))
    assert found.value == pytest.approx(values.mean())
    assert found[1:] == pytest.approx(theirs.confidence_interval, abs=0.05)


def over_tasks(scores):
    return float(np.mean([rows.mean() for rows in scores.values()]))


def test_resampling_within_tasks_takes_no_heed_of_their_difference():
    """Variance of the mean of task means: a fourth of the sum of each task's; resampling the pool would add theirs."""
    a, b = draws(30), draws(30, seed=1) + 1000
    found = stratified_bootstrap({"a": a, "b": b}, over_tasks, reps=4000)
    spread = math.sqrt((a.var() / 30 + b.var() / 30) / 4)
    assert found.high - found.low == pytest.approx(2 * 1.96 * spread, rel=0.06)
    pooled = stratified_bootstrap({"planted": np.concatenate([a, b])}, over_tasks, reps=500)
    assert pooled.high - pooled.low > 100 * spread


def test_rows_are_resampled_whole():
    """Two columns that differ by 5 in each row do so in each resample."""
    column = draws(8)
    rows = np.stack([column, column + 5], 1)
    found = stratified_bootstrap({"a": rows}, lambda scores: (scores["a"][:, 1] - scores["a"][:, 0]).mean())
    assert found == pytest.approx((5, 5, 5))


def test_a_bootstrap_is_its_seed():
    made = partial(stratified_bootstrap, {"a": draws(6)}, over_tasks, 200)
    assert made(seed=1) == made(seed=1)
    assert made(seed=1) != made(seed=2)


def test_resamples_at_once_are_those_one_by_one():
    """Two strata, two columns that stay together."""
    scores = {"a": draws(4, 2), "b": draws(5, 2, seed=1)}

    def product(scores, axis=0):
        return sum((rows[..., 0] * rows[..., 1]).mean(axis) for rows in scores.values())

    found = stratified_bootstrap(scores, partial(product, axis=-1), 300, at_once=True)
    assert found == pytest.approx(stratified_bootstrap(scores, product, 300))
    assert found.low < found.value < found.high


def test_one_run_of_a_task_has_no_bootstrap_interval():
    found = stratified_bootstrap({"a": draws(5), "b": draws(1)}, over_tasks)
    assert np.isnan(found).tolist() == [False, True, True]


@pytest.mark.parametrize(("a", "b"), [(5, 5), (3, 8), (1, 4)])
def test_probability_of_improvement_against_mann_whitney(a, b):
    x = {"one": draws(a), "two": np.round(draws(a, seed=1))}
    y = {"one": draws(b, seed=2), "two": np.round(draws(b, seed=3))}
    by_task = [stats.mannwhitneyu(x[task], y[task]).statistic / (a * b) for task in x]
    assert probability_of_improvement(x, y, reps=10).value == pytest.approx(np.mean(by_task))


def test_probability_of_improvement_by_hand():
    """1 and 3 against 1, 2: a tie, a loss, two wins."""
    assert probability_of_improvement({"t": [1.0, 3]}, {"t": [1.0, 2]}, reps=10).value == 2.5 / 4
    assert probability_of_improvement({"t": [2.0, 3]}, {"t": [0.0, 1]}) == (1, 1, 1)


def test_interval_of_the_probability_of_improvement():
    """Against the normal limit of the Mann-Whitney U under the null, sqrt((a + b + 1) / (12 a b))."""
    x, y = draws(60), draws(60, seed=4)
    found = probability_of_improvement({"t": x}, {"t": y})
    assert found.high - found.low == pytest.approx(2 * 1.96 * math.sqrt(121 / (12 * 3600)), rel=0.1)


def test_median_ratio_is_of_pairs_and_outlives_one_run_that_had_to_wait():
    found = median_ratio([11.0, 24.0, 900.0], [10.0, 20.0, 30.0])
    # Of three, 7 of the 27 resamples have the lowest as their median, 7 the highest.
    assert found == pytest.approx((1.2, 1.1, 30.0))


def test_median_ratio_against_scipy():
    x, y = np.exp(draws(2, 9))
    low, high = stats.bootstrap(
        (x / y,), np.median, method="percentile", n_resamples=20_000, rng=np.random.default_rng(3)
    ).confidence_interval
    found = median_ratio(x, y, reps=20_000)
    assert found.value == np.median(x / y)
    assert found[1:] == pytest.approx((low, high), rel=0.02)


def test_median_ratio_over_what_is_not_above_zero_is_none():
    assert np.isnan(median_ratio([1.0, 2], [1.0, 0])).all()
    with pytest.raises(InputError, match="2 and 3 runs"):
        median_ratio([1.0, 2], [1.0, 2, 3])


def test_relative_change_of_negative_returns():
    """-10 against -20 is half better, and a ratio would call it half worse."""
    assert relative_change([-11.0, -9], [-22.0, -18]).value == pytest.approx(0.5)
    assert relative_change([-22.0, -18], [-11.0, -9]).value == pytest.approx(-1)
    assert relative_change([3.0, 3], [1.0, 3]).value == pytest.approx(0.5)


def test_relative_change_resamples_pairs():
    """x is 1.5 y in each pair: every resample gives one half, which columns drawn apart would not."""
    y = draws(6) + 10
    assert relative_change(1.5 * y, y) == pytest.approx((0.5, 0.5, 0.5))
    apart = stratified_bootstrap({"x": 1.5 * y, "y": y}, lambda s: s["x"].mean() / s["y"].mean() - 1)
    assert apart.high - apart.low > 0.1


def test_mean_relative_change_weighs_tasks_alike_and_resamples_within_them():
    """+50% on three pairs, -25% on one task of two pairs whose returns are a hundred times as large."""
    y = draws(3) + 10
    pairs = {"small": np.stack([1.5 * y, y], 1), "large": np.array([[-1250.0, -1000], [-2500, -2000]])}
    assert mean_relative_change(pairs) == pytest.approx((0.125, 0.125, 0.125))
    assert np.isnan(mean_relative_change(pairs | {"none": np.array([[1.0, 0.0], [2.0, 0.0]])})).all()


def test_relative_change_from_nothing_is_not_told():
    assert np.isnan(relative_change([1.0, 2], [-1.0, 1])).all()
    assert np.isnan(relative_change([1.0, 2], [0.0, 1])).tolist() == [False, True, True]


@pytest.mark.parametrize("task", normalised_tasks())
def test_normalised_score(task):
    spec = CATALOGUE[task]
    assert [normalised_score(task, r) for r in (spec.random_return, spec.expert_return)] == [0, 1]


def test_normalised_score_by_hand():
    """Random actions get 17.3 on Hopper, D4RL's expert 3234.3."""
    assert normalised_score("Hopper-v5", 1000.0) == pytest.approx((1000 - 17.3) / (3234.3 - 17.3))
    assert normalised_tasks() == ["Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5"]


BAD = {
    "no level": (lambda: mean_interval([1.0], 95.0), "level must be above 0 and below 1", "not 95"),
    "no values": (lambda: mean_interval([]), "values must be one number a run", r"\(0,\)"),
    "not finite": (lambda: mean_interval([1.0, math.nan]), "values must be finite, not nan", "run 1"),
    "no reps": (lambda: stratified_bootstrap({"a": draws(3)}, over_tasks, reps=0), "reps must be", "not 0"),
    "no tasks": (lambda: stratified_bootstrap({}, over_tasks), "scores must have a run in every task"),
    "empty task": (lambda: stratified_bootstrap({"a": draws(0)}, over_tasks), "'a': 0"),
    "other tasks": (lambda: probability_of_improvement({"a": [1.0]}, {"b": [1.0]}), "the same tasks", "'a'", "'b'"),
    "unmatched": (lambda: relative_change([1.0], [1.0, 2]), "matched run by run, not 1 and 2"),
    "no expert": (lambda: normalised_score("Swimmer-v5", 1.0), "'Swimmer-v5' has no normalised score", "Hopper-v5"),
    "no such task": (lambda: normalised_score("Acrobot-v1", 1.0), "'Acrobot-v1' has no normalised score"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    call, *words = BAD[case]
    with pytest.raises(InputError, match=".*".join(words)) as caught:
        call()
    assert "\n" not in str(caught.value)
