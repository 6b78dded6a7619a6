"""Q's calibration against the least-squares line, the minimax formula of monotone regression, and what it is for."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

from ppo_dap.dap.calibration import KNOTS, Calibration, calibrate

KINDS = ("affine", "isotonic")


def f32(values):
    return np.asarray(values, np.float32)


def at(calibration, q):
    """The map's values at numbers `q`."""
    return np.asarray(calibration(jnp.asarray(f32(q))[:, None]))[:, 0]


def monotone(q, y):
    """Values of q, and at each the least-squares monotone fit: max over a <= i of min over b >= i of mean(y[a..b])."""
    values = np.unique(q)
    rows = [y[q == value] for value in values]
    fit = [
        max(min(np.concatenate(rows[a : b + 1]).mean() for b in range(i, len(values))) for a in range(i + 1))
        for i in range(len(values))
    ]
    return values, np.array(fit)


def with_knots_at_its_values(y, first=0.0, step=0.25):
    """16 equidistant values of Q, the outermost twice so that they are the outermost knots as well; `y` has 18 rows."""
    values = first + step * np.arange(KNOTS)
    return f32(np.concatenate([values[:1], values, values[-1:]])), f32(y)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_affine_is_the_least_squares_line(seed):
    rng = np.random.default_rng(seed)
    q = f32(rng.normal(3.0, 2.0, 200))
    y = f32(1.7 * q - 4.0 + rng.normal(0, 1.5, 200))
    (slope, offset), *_ = np.linalg.lstsq(np.stack([q, np.ones_like(q)], axis=1).astype(np.float64), y, rcond=None)
    # Inside the rows' range, and far out of it.
    asked = np.linspace(-30, 30, 41)
    np.testing.assert_allclose(at(calibrate(q, y, "affine"), asked), slope * asked + offset, atol=2e-4)


@pytest.mark.parametrize("seed", range(5))
def test_isotonic_is_the_least_squares_monotone_map(seed):
    rng = np.random.default_rng(seed)
    q, y = with_knots_at_its_values(rng.normal(0, 1, 18) + 0.1 * np.arange(18))
    order = rng.permutation(18)
    calibration = calibrate(q[order], y[order], "isotonic")
    values, expected = monotone(q, y.astype(np.float64))
    np.testing.assert_allclose(calibration.q, values, atol=1e-5)
    np.testing.assert_allclose(calibration.returns, expected, atol=1e-5)
    assert 1 < len(np.unique(expected.round(6))) < KNOTS  # some are pooled, and not all
    # No monotone map nearby does better on the rows.
    error = np.sum((np.interp(q, values, expected) - y) ** 2)
    for _ in range(200):
        other = np.sort(expected + 0.1 * rng.standard_normal(KNOTS))
        assert np.sum((np.interp(q, values, other) - y) ** 2) >= error


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_equal_q_count_with_their_mean_whatever_their_order(kind):
    """Q says 0 of ten rows and 1 of ten others; no map can tell the rows of one value apart."""
    q, y = np.repeat(f32([0, 1]), 10), f32([*np.linspace(-1, 3, 10), *np.linspace(1, 5, 10)])
    for order in (np.arange(20), np.arange(20)[::-1], np.random.default_rng(0).permutation(20)):
        calibration = calibrate(q[order], y[order], kind)
        np.testing.assert_allclose(at(calibration, [0, 0.5, 1]), [1, 2, 3], atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_no_map_ever_falls(kind):
    rng = np.random.default_rng(3)
    for trend in (-2.0, -0.1, 0.0, 0.1, 2.0):
        q = f32(rng.normal(0, 1, 100))
        calibration = calibrate(q, f32(trend * q + rng.normal(0, 1, 100)), kind)
        assert (np.diff(at(calibration, np.linspace(-8, 8, 200))) >= -1e-5).all()


@pytest.mark.parametrize("kind", KINDS)
def test_returns_that_fall_with_q_give_a_flat_map(kind):
    q = np.linspace(-1, 1, 50, dtype=np.float32)
    y = f32(2 - q**3)
    np.testing.assert_allclose(at(calibrate(q, y, kind), np.linspace(-3, 3, 20)), y.mean(), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_constant_q_gives_the_identity(kind):
    q = np.linspace(-40, 40, 33)
    for calibration in (
        Calibration.identity(),
        calibrate(np.full(20, 2.5, np.float32), f32(np.random.default_rng(0).normal(size=20)), kind),
    ):
        np.testing.assert_allclose(at(calibration, q), q, rtol=1e-5, atol=1e-5)


def test_it_is_linear_between_its_knots_and_goes_on_as_its_outermost_pieces():
    rng = np.random.default_rng(4)
    knots, returns = np.sort(rng.normal(0, 2, KNOTS)), np.sort(rng.normal(5, 3, KNOTS))
    calibration = Calibration(jnp.asarray(f32(knots)), jnp.asarray(f32(returns)))
    inside = rng.uniform(knots[0], knots[-1], (7, 5))
    got = np.asarray(calibration(jnp.asarray(f32(inside))))
    assert got.shape == (7, 5)
    np.testing.assert_allclose(got, np.interp(inside, knots, returns), atol=1e-4)
    for end, inner in ((0, 1), (-1, -2)):
        slope = (returns[end] - returns[inner]) / (knots[end] - knots[inner])
        beyond = knots[end] + (1 if end else -1) * np.array([0.5, 3.0])
        expected = returns[end] + slope * (beyond - knots[end])
        np.testing.assert_allclose(at(calibration, beyond), expected, rtol=1e-4, atol=1e-3)


def test_calibration_mends_a_miscalibrated_q_on_rows_it_has_not_seen():
    """Q ranks rightly and says exp(1.5 truth) + 10 where the truth is truth: the error that is left is the noise's."""
    rng = np.random.default_rng(5)
    truth = rng.uniform(-1, 1, 4000)
    q, y = f32(np.exp(1.5 * truth) + 10), f32(truth + 0.3 * rng.standard_normal(4000))
    errors = {
        kind: np.mean((at(calibrate(q[:2000], y[:2000], kind), q[2000:]) - y[2000:]) ** 2) for kind in KINDS
    } | {"none": np.mean((q[2000:] - y[2000:]) ** 2)}  # fmt: skip
    assert errors["none"] > 100
    assert errors["affine"] < 0.2
    assert errors["isotonic"] < 0.09 * 1.1 < errors["affine"]


@pytest.mark.parametrize("rows", [(3, 5), (5, 3)])
def test_rows_of_different_numbers_are_refused(rows):
    q, y = (np.linspace(0, 1, n, dtype=np.float32) for n in rows)
    unchecked = inspect.unwrap(calibrate)  # the tests' type checker would speak first
    with pytest.raises(ValueError, match=r"3.*5|5.*3"):
        unchecked(q, y, "affine")
