"""Eq. 7's weights and Eq. 8's drift, against numbers by hand and finite differences."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import norm

from dap.dap_made import filled, slope_q
from ppo_dap.config import ProposalConfig
from ppo_dap.dap.guidance import (
    alpha_schedule,
    beta_schedule,
    clip_norm,
    effective_sample_size,
    energy_weights,
    farthest,
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
        jax.jit(lambda x: q_drift(lambda actions: q(features, actions), 5.0, config)(x, jnp.float32(2.0)))(x)
    )
    value = jax.jit(lambda x: q(features, x))
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


_farthest = jax.jit(farthest, static_argnums=1)
_weights = jax.jit(energy_weights)


def greedy(points, num):
    """Indices of `num` of the points (k, act), by the definition of Gonzalez's rule."""
    chosen = [0]
    while len(chosen) < num:
        nearest = [min(np.linalg.norm(p - points[c]) for c in chosen) for p in points]
        chosen.append(int(np.argmax(nearest)))
    return chosen


def radius(points, chosen):
    """How far the farthest point is from the nearest chosen one."""
    return max(min(np.linalg.norm(p - points[c]) for c in chosen) for p in points)


@pytest.mark.parametrize("num", [1, 2, 4, 8])
def test_farthest_is_the_greedy_choice_and_covers_as_it_must(num):
    points = np.random.default_rng(0).uniform(-1, 1, (30, 8, 3))
    chosen = np.asarray(_farthest(jnp.asarray(points, jnp.float32), num))
    assert chosen.shape == (30, num)
    assert (chosen[:, 0] == 0).all()
    for row, indices in zip(points, chosen.tolist(), strict=True):
        assert indices == greedy(row, num)
        assert len({*indices}) == num
        best = min(radius(row, subset) for subset in itertools.combinations(range(8), num))
        assert radius(row, indices) <= 2 * best + 1e-6  # Gonzalez's theorem


def test_farthest_takes_both_of_two_clusters_and_copies_last():
    rng = np.random.default_rng(1)
    label = np.array([rng.permutation([0, 0, 0, 0, 0, 0, 0, 1, 1, 1]) for _ in range(50)])
    points = np.array([[0.5, 0.4], [-0.5, -0.3]])[label] + 0.05 * rng.standard_normal((50, 10, 2))
    two = np.asarray(_farthest(jnp.asarray(points, jnp.float32), 2))
    assert (np.take_along_axis(label, two, axis=1).sum(axis=1) == 1).all()
    # Two different points and copies of them: the two are taken before any copy.
    copies = jnp.asarray(np.repeat(points[:1, :1], 4, axis=1), jnp.float32).at[0, 2].add(0.1)
    assert np.asarray(_farthest(copies, 2)).tolist() == [[0, 2]]


def test_energy_weights_with_a_log_density_are_its_softmax():
    rng = np.random.default_rng(3)
    q, log_density = rng.standard_normal((20, 6)), 3 * rng.standard_normal((20, 6))
    kept = rng.random((20, 6)) < 0.7
    kept[:, 2] = True
    args = jnp.asarray(q, jnp.float32), jnp.float32(1.5), jnp.float32(0.4), jnp.asarray(kept)
    weights = np.asarray(_weights(*args, jnp.asarray(log_density, jnp.float32)))
    expected = softmax(np.where(kept, 1.5 * q / 0.4 + log_density, -np.inf), axis=1)
    np.testing.assert_allclose(weights, expected, atol=1e-5)
    assert np.abs(weights - softmax(np.where(kept, 1.5 * q / 0.4, -np.inf), axis=1)).max() > 0.1


@pytest.mark.parametrize("kappa", [0.5, 1.0, 2.0])
def test_without_q_the_weights_are_a_power_of_the_policy(kappa):
    mean, std = np.array([0.2, -0.1]), np.array([0.3, 0.6])
    actions = np.random.default_rng(4).uniform(-1, 1, (20, 6, 2))
    density = norm.pdf(actions, mean, std).prod(-1)
    q, exponent = 50 * NOISE[0, :1, :].repeat(20, 0), jnp.asarray(kappa * np.log(density), jnp.float32)
    weights = _weights(q, jnp.float32(0), jnp.float32(1), jnp.ones((20, 6), bool), exponent)
    expected = density**kappa / (density**kappa).sum(1, keepdims=True)
    np.testing.assert_allclose(weights, expected, atol=1e-5)


def test_a_policy_far_away_from_all_proposals_leaves_weights_that_sum_to_1():
    far = f32([-3e4, -3e4 + 1, -3e38], [-1e30, -1e30, -1e30])
    ones = jnp.ones((2, 3), bool)
    weights = np.asarray(_weights(jnp.zeros((2, 3)), jnp.float32(1), jnp.float32(1), ones, far))
    np.testing.assert_allclose(weights, [[1 / (1 + np.e), np.e / (1 + np.e), 0], [1 / 3] * 3], atol=1e-3)
