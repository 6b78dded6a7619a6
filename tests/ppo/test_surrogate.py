import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from ppo_dap.nets.actor import log_prob
from ppo_dap.ppo.surrogate import clipped_surrogate, importance_ratio, normalise, share, weighted_mean

SURROGATE = jax.jit(jax.value_and_grad(lambda *rows: clipped_surrogate(*rows, 0.2)))


def array(*values):
    return jnp.asarray(values, jnp.float32)


def test_ratio_is_the_quotient_of_densities():
    actions = np.array([[0.3, -1.0], [2.0, 0.1]])
    new, old = (norm(m, s).pdf(actions).prod(1) for m, s in ((0.2, 1.1), (-0.1, 0.9)))
    ratio = importance_ratio(array(*np.log(new)), array(*np.log(old)))
    np.testing.assert_allclose(ratio, new / old, rtol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected", "slope"),
    [
        (1.1, 2.0, 2.2, 2.0),
        (1.5, 2.0, 2.4, 0.0),  # clipped at 1.2
        (0.5, 2.0, 1.0, 2.0),  # worse than before: not clipped
        (0.5, -2.0, -1.6, 0.0),  # clipped at 0.8
        (1.5, -2.0, -3.0, -2.0),
        (1.1, 0.0, 0.0, 0.0),
    ],
)
def test_clipped_surrogate_of_one_row(ratio, advantage, expected, slope):
    value, gradient = SURROGATE(array(ratio), array(advantage), array(1.0))
    assert float(value) == pytest.approx(expected, rel=1e-6)
    assert float(gradient[0]) == pytest.approx(slope)


def test_surrogate_is_the_mean_over_the_rows_with_weight():
    ratio, advantages = array(1.1, 1.5, 7.0), array(2.0, 2.0, 50.0)
    assert float(SURROGATE(ratio, advantages, array(1, 1, 0))[0]) == pytest.approx((2.2 + 2.4) / 2)
    assert float(SURROGATE(ratio, advantages, array(0, 0, 0))[0]) == 0


def test_gradient_in_the_policys_mean_by_finite_differences():
    rng = np.random.default_rng(0)
    actions, old_mean, advantages = rng.standard_normal((20, 1)), 0.1, rng.standard_normal(20)
    weights = (np.arange(20) < 15).astype(float)

    def reference(mean):
        ratio = norm(mean, 1).pdf(actions[:, 0]) / norm(old_mean, 1).pdf(actions[:, 0])
        rows = [min(r * a, min(max(r, 0.8), 1.2) * a) for r, a in zip(ratio, advantages, strict=True)]
        return np.mean(rows[:15])

    def ours(mean):
        means = jnp.broadcast_to(mean, (20, 1))
        old = array(*norm(old_mean, 1).logpdf(actions[:, 0]))
        ratio = importance_ratio(log_prob(jnp.asarray(actions, jnp.float32), means, jnp.zeros(1)), old)
        return clipped_surrogate(ratio, array(*advantages), array(*weights), 0.2)

    slopes = [(reference(m + 1e-6) - reference(m - 1e-6)) / 2e-6 for m in (0.1, 0.4)]
    assert slopes[0] != pytest.approx(slopes[1], rel=0.05)  # some rows are clipped at 0.4
    slope = jax.jit(jax.grad(ours))
    np.testing.assert_allclose([slope(jnp.float32(m)) for m in (0.1, 0.4)], slopes, rtol=1e-3)


def test_weighted_mean_and_normalise_see_only_rows_with_weight():
    values, weights = np.array([1.0, 2.0, 4.0, 1e4]), np.array([1.0, 1, 1, 0])
    assert float(weighted_mean(array(*values), array(*weights))) == pytest.approx(7 / 3)
    assert float(weighted_mean(array(*values), jnp.zeros(4))) == 0
    seen = values[:3]
    np.testing.assert_allclose(
        normalise(array(*values), array(*weights))[:3], (seen - seen.mean()) / seen.std(), rtol=1e-5
    )
    np.testing.assert_array_equal(normalise(array(3, 3), array(1, 1)), 0)  # no spread: nothing to divide by


@pytest.mark.parametrize("rows", [41.0, 47.0, 55.0])
def test_a_share_of_all_is_exactly_1_however_a_device_divides(rows):
    whole = jnp.float32(rows)

    def under_jit(function, part):
        """With the whole a constant, by whose rounded reciprocal XLA multiplies."""
        return float(jax.jit(lambda part: function(part, whole))(jnp.float32(part)))

    assert under_jit(jnp.divide, rows) == pytest.approx(1)
    assert under_jit(jnp.divide, rows) != 1  # the planted fault
    assert [under_jit(share, part) for part in (rows, 0.0)] == [1, 0]
    assert under_jit(share, rows - 1) == pytest.approx(1 - 1 / rows)
    assert [float(jax.jit(share)(jnp.float32(part), whole)) for part in (rows, 0.0)] == [1, 0]
