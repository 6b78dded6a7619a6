"""Eq. 7's weights and Eq. 8's drift, against numbers by hand and finite differences."""

import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import filled, quick_jit, slope_q
from ppo_dap.config import ProposalConfig
from ppo_dap.dap.guidance import (
    alpha_schedule,
    beta_schedule,
    clip_norm,
    effective_sample_size,
    energy_weights,
    guidance_step,
    top_k_mask,
    within_state_spread,
)
from ppo_dap.dap.proposals import q_drift
from ppo_dap.nets.critic import QFunction

NOISE = jnp.asarray(np.random.default_rng(2).standard_normal((5, 3, 6)), jnp.float32)


def f32(*values):
    return jnp.asarray(values, jnp.float32)


def weights_of(q, beta=1.0, scale=1.0, kept=None):
    q = jnp.atleast_2d(jnp.asarray(q, jnp.float32))
    kept = jnp.ones(q.shape, bool) if kept is None else jnp.atleast_2d(jnp.asarray(kept))
    return np.asarray(energy_weights(q, jnp.float32(beta), jnp.float32(scale), kept))


def test_energy_weights_by_hand():
    q = np.log([1.0, 2.0, 5.0])  # exp(q) = 1, 2, 5
    np.testing.assert_allclose(weights_of(q), [[1 / 8, 2 / 8, 5 / 8]], rtol=1e-5)
    np.testing.assert_allclose(weights_of(q, beta=2.0), [[1 / 30, 4 / 30, 25 / 30]], rtol=1e-5)
    np.testing.assert_allclose(weights_of(3 * q, scale=3.0), [[1 / 8, 2 / 8, 5 / 8]], rtol=1e-5)
    np.testing.assert_allclose(weights_of(q, kept=[True, False, True]), [[1 / 6, 0, 5 / 6]], rtol=1e-5)
    np.testing.assert_allclose(weights_of(q, beta=0.0), [[1 / 3, 1 / 3, 1 / 3]], rtol=1e-6)
    # States do not mix: each row is what it is alone.
    np.testing.assert_allclose(weights_of([q, 0 * q]), [[1 / 8, 2 / 8, 5 / 8], [1 / 3, 1 / 3, 1 / 3]], rtol=1e-5)


def test_energy_weights_take_any_q():
    q = np.random.default_rng(0).standard_normal((50, 10))
    weights = weights_of(q, beta=2.0)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-5)
    np.testing.assert_allclose(weights_of(q + np.linspace(-30, 30, 50)[:, None], beta=2.0), weights, rtol=1e-3)
    np.testing.assert_allclose(weights_of([1e30, 1e30, -1e30]), [[0.5, 0.5, 0]])
    np.testing.assert_allclose(weights_of([-1e30, 0.0, 1.0], kept=[True, False, False]), [[1, 0, 0]])


def test_effective_sample_size_by_hand():
    rows = jnp.asarray([[0.25, 0.25, 0.25, 0.25], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.7, 0.1, 0.1, 0.1]], jnp.float32)
    np.testing.assert_allclose(effective_sample_size(rows), [4, 1, 2, 1 / 0.52], rtol=1e-6)


@pytest.mark.parametrize(("spread", "ess"), [(0.1, 9.9), (1.0, 5.6), (5.0, 1.6), (20.0, 1.1)])
def test_raw_q_leaves_few_effective_proposals(spread, ess):
    """Decision 5's figures, the reason for the running scale."""
    q = spread * np.random.default_rng(1).standard_normal((4000, 10))
    assert float(jnp.mean(effective_sample_size(jnp.asarray(weights_of(q))))) == pytest.approx(ess, abs=0.1)
    scaled = float(jnp.mean(effective_sample_size(jnp.asarray(weights_of(q, scale=spread)))))
    assert scaled == pytest.approx(5.6, abs=0.1)


def test_within_state_spread_ignores_what_states_differ_by():
    q = f32([1.0, 3.0], [100.0, 100.0])  # variances 1 and 0
    assert float(within_state_spread(q)) == pytest.approx(np.sqrt(0.5))


def test_beta_schedule():
    values = [beta_schedule(p, 2.0, 0.3) for p in (0.0, 0.15, 0.3, 0.9, 1.0)]
    assert values == pytest.approx([0, 1, 2, 2, 2])


def test_top_k_keeps_the_best_and_the_first_of_equals():
    q = f32([3.0, 1.0, 2.0, 0.0], [1.0, 5.0, 5.0, 5.0], [7.0, 7.0, 7.0, 7.0])
    t, f = True, False
    np.testing.assert_array_equal(top_k_mask(q, 2), [[t, f, t, f], [f, t, t, f], [t, t, f, f]])
    np.testing.assert_array_equal(top_k_mask(q, None), np.ones((3, 4), bool))
    assert np.asarray(top_k_mask(q, 4)).all()


def test_alpha_schedule():
    values = [float(alpha_schedule(jnp.float32(s), 5.0, 0.3)) for s in (5.0, 2.5, 0.0)]
    assert values == pytest.approx([0, 0.15, 0.3])


@pytest.mark.parametrize("own_trunk", [False, True])
def test_drift_is_alpha_times_the_finite_difference_gradient_of_q(own_trunk):
    q = filled(lambda rng: QFunction.create(rng, 3, 2, 4, 8, own_trunk), 0)
    features, x = NOISE[:, 0, :4], NOISE[..., 4:]
    config = ProposalConfig(guidance_cap=100.0)
    drift = np.asarray(
        quick_jit(lambda x: q_drift(lambda actions: q(features, actions), 5.0, config)(x, jnp.float32(2.0)))(x)
    )
    value = quick_jit(lambda x: q(features, x))
    step = 1e-2
    for d in range(2):
        shift = step * jnp.broadcast_to(jnp.eye(2)[d], x.shape)
        slope = np.asarray(value(x + shift) - value(x - shift)) / (2 * step)
        np.testing.assert_allclose(drift[..., d], 0.3 * (1 - 2.0 / 5.0) * slope, atol=2e-4)
    assert np.abs(drift).max() > 0.02


@pytest.mark.parametrize(("cap_on", "longest"), [("step", 0.1), ("gradient", 0.1 * 0.3 * 0.6)])
def test_cap_bounds_what_it_says(cap_on, longest):
    """Q's slope is 5 and more: with the cap on the step it has norm c, with the cap on the gradient alpha_t c."""
    config = ProposalConfig(cap_on=cap_on)
    q, features = slope_q([3.0, -4.0], scale=2.0), jnp.zeros((5, 8))
    drift = q_drift(lambda actions: q(features, actions), 5.0, config)
    x = 0.01 * NOISE[..., :2]
    pushes = np.asarray(drift(x, jnp.float32(2.0)))
    np.testing.assert_allclose(np.linalg.norm(pushes, axis=-1), longest, rtol=1e-4)
    np.testing.assert_allclose(pushes / longest, np.broadcast_to([0.6, -0.8], pushes.shape), rtol=1e-4)
    np.testing.assert_array_equal(drift(x, jnp.float32(5.0)), np.zeros_like(pushes))


def test_cap_leaves_short_vectors_alone():
    vectors = f32([[3.0, 4.0], [0.03, 0.04], [0.0, 0.0]])
    np.testing.assert_allclose(clip_norm(vectors, 0.1), [[[0.06, 0.08], [0.03, 0.04], [0, 0]]], rtol=1e-6)
    short = guidance_step(f32([[0.1, 0.0]]), jnp.float32(0.3), 0.1, "step")
    np.testing.assert_allclose(short, [[[0.03, 0.0]]], rtol=1e-6)
