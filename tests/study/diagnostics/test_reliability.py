"""The measures of 5.7 on planted data: values known beforehand, scipy's, or counted one by one."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ppo_dap.dap.guidance import energy_weights
from ppo_dap.dap.proposals import high_q_rate
from ppo_dap.study.diagnostics.reliability import (
    affine_map,
    bias,
    calibration_curve,
    calibrations,
    expected_calibration_error,
    high_q_hit_rate,
    isotonic_map,
    mean_absolute_error,
    mean_and_interval,
    measure,
    rank_ceiling,
    rank_correlation,
    rank_correlation_per_state,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def g(rng):
    return rng.standard_normal((40, 10)) + 5 * rng.standard_normal((40, 1))


def test_a_perfect_q(g):
    found = measure(g, g)
    assert (found["rho"], found["rho_low"], found["rho_high"], found["rho_pooled"]) == pytest.approx((1, 1, 1, 1))
    assert (found["mae"], found["bias"], found["ece"]) == (0, 0, 0)
    assert found["rho_states"] == 40


def test_a_flipped_q_ranks_backwards(g):
    assert measure(-g, g)["rho"] == pytest.approx(-1)


def test_a_shuffled_q_ranks_nothing(g, rng):
    found = measure(rng.permuted(g, axis=1), g)
    assert abs(found["rho"]) < 3 / np.sqrt(40 * 9)  # three standard errors: rho's variance is 1 / (k - 1) a state
    assert found["rho_low"] < 0 < found["rho_high"]
    assert found["rho_pooled"] > 0.9  # what is known of the states says nothing of the actions


def test_a_biased_q_is_off_by_its_bias(g):
    found = measure(g + 0.75, g)
    assert (found["mae"], found["bias"], found["ece"]) == pytest.approx((0.75, 0.75, 0.75))
    assert measure(g - 0.75, g)["bias"] == pytest.approx(-0.75)
    assert found["rho"] == pytest.approx(1)


def test_rho_is_pearsons_of_ranks_with_ties_shared(rng):
    q, g = rng.integers(0, 4, (20, 8)).astype(float), rng.integers(0, 4, (20, 8)).astype(float)
    q[3], g[5] = 2.0, 1.0
    ours = rank_correlation_per_state(q, g)
    assert np.flatnonzero(np.isnan(ours)).tolist() == [3, 5]
    for i in set(range(20)) - {3, 5}:
        ranks = [np.array([(np.sum(x < v) + np.sum(x <= v) + 1) / 2 for v in x]) for x in (q[i], g[i])]
        assert ours[i] == pytest.approx(np.corrcoef(ranks[0], ranks[1])[0, 1])


def test_one_pair_has_no_rank():
    assert np.isnan(rank_correlation(np.ones(1), np.ones(1)))


def test_the_interval_is_about_two_standard_errors_and_leaves_out_states_without_rho(rng):
    values = rng.standard_normal(200)
    mean, low, high = mean_and_interval(np.append(values, [np.nan] * 5))
    error = values.std() / np.sqrt(200)
    assert mean == pytest.approx(values.mean())
    assert (low, high) == pytest.approx((mean - 1.96 * error, mean + 1.96 * error), abs=0.2 * error)
    assert np.isnan(mean_and_interval(np.array([0.5, np.nan]))).all()


def test_the_ceiling_is_what_the_truth_reaches(rng):
    truth = rng.standard_normal((400, 12))
    returns = truth[..., None] + 2 * rng.standard_normal((400, 12, 8))
    reached = rank_correlation_per_state(truth, returns.mean(2)).mean()
    assert 0.5 < reached < 0.9
    assert rank_ceiling(returns) == pytest.approx(reached, abs=0.02)
    assert rank_ceiling(np.repeat(truth[..., None], 4, axis=2)) == pytest.approx(1)
    assert np.isnan(rank_ceiling(returns[..., :1]))


def test_ece_of_known_bins():
    # Two bins: Q 0, 1 | 2, 3 has means 0.5 and 2.5; G has means 1 and 2: |0.5 - 1| and |2.5 - 2|, half the pairs each.
    q, g = np.array([0.0, 1, 2, 3]), np.array([0.0, 2, 1, 3])
    assert expected_calibration_error(q, g, 2) == pytest.approx(0.5)
    assert expected_calibration_error(q, g, 1) == 0
    assert mean_absolute_error(q, g) == pytest.approx(0.5)
    assert bias(q, g) == 0


def test_bins_hold_as_many_pairs_each_and_equal_values_share_one(rng):
    q, g = rng.standard_normal((2, 1000))
    means, heights, counts = calibration_curve(q, g, 10)
    assert counts.tolist() == [100] * 10
    order = np.argsort(q)
    assert means == pytest.approx(q[order].reshape(10, 100).mean(1))
    assert heights == pytest.approx(g[order].reshape(10, 100).mean(1))
    means, heights, counts = calibration_curve(np.zeros(50), g[:50], 10)
    assert (means.tolist(), counts.tolist()) == ([0], [50])
    assert heights == pytest.approx([g[:50].mean()])


def test_high_q_hit_rate_counts_what_is_at_or_above_the_90th_percentile(rng):
    of_state, q = rng.standard_normal((30, 11)), rng.standard_normal((30, 4))
    hits = [value >= np.sort(row)[9] for row, values in zip(of_state, q, strict=True) for value in values]
    assert high_q_hit_rate(of_state, q) == pytest.approx(np.mean(hits))  # of 11, 0.9 of the way is the tenth
    assert high_q_hit_rate(of_state, of_state.max(1, keepdims=True)) == 1
    assert high_q_hit_rate(of_state, of_state.min(1, keepdims=True)) == 0
    chosen = rng.integers(0, 11, (30, 11))
    inside = high_q_rate(jnp.asarray(of_state, jnp.float32), jnp.asarray(chosen))  # what a run logs
    assert high_q_hit_rate(of_state, np.take_along_axis(of_state, chosen, axis=1)) == pytest.approx(float(inside))


def test_maps_against_scipy_and_a_brute_force(rng):
    q = rng.standard_normal(30)
    g = 2 * q - 1 + 0.3 * rng.standard_normal(30)
    line: Any = stats.linregress(q, g)
    at = np.linspace(-3, 3, 7)
    assert affine_map(q, g)(at) == pytest.approx(line.slope * at + line.intercept)
    # The rising fit at a point, by the minimax formula: the largest over starts of the least over ends of the mean.
    order = np.argsort(q)
    y = g[order]
    rising = [max(min(y[a : b + 1].mean() for b in range(i, 30)) for a in range(i + 1)) for i in range(30)]
    assert isotonic_map(q, g)(q[order]) == pytest.approx(rising)


def test_maps_of_a_q_that_says_nothing():
    q, g = np.full(6, 2.0), np.arange(6.0)
    assert affine_map(q, g)(q) == pytest.approx(np.full(6, 2.5))
    assert isotonic_map(q, g)(q) == pytest.approx(np.full(6, 2.5))


def test_calibration_mends_a_distorted_q_on_states_that_it_has_not_seen(rng):
    g = rng.standard_normal((200, 10))
    found = calibrations(3 * g + 1, g)
    assert found["as it is"]["mae"] == pytest.approx(np.abs(2 * g + 1).mean(), rel=0.01)
    assert found["affine"]["mae"] == pytest.approx(0, abs=1e-9)
    assert found["isotonic"]["ece"] < 0.03
    bent = calibrations(np.exp(g), g)
    assert bent["isotonic"]["mae"] < 0.1 * bent["affine"]["mae"]
    noise = calibrations(rng.standard_normal((200, 10)), g)  # nothing to learn: no map may seem to help beyond the mean
    assert noise["affine"]["mae"] > 0.98 * np.abs(g).mean()


def test_q_minus_v_gives_the_weights_of_q(rng):
    """The advantage-energy baseline with A = Q - V is no other method: Eq. 7 does not see a shift within a state."""
    q, v = rng.standard_normal((20, 10)), 10 * rng.standard_normal((20, 1))

    def weights(x):
        return np.asarray(energy_weights(jnp.asarray(x), jnp.asarray(0.8), jnp.asarray(0.5), jnp.ones((20, 10), bool)))

    assert weights(q - v) == pytest.approx(weights(q), abs=1e-5)
    assert np.abs(weights(q - v * np.arange(10)) - weights(q)).max() > 0.1  # a shift that differs within a state
    assert rank_correlation_per_state(q - v, q) == pytest.approx(np.ones(20))
