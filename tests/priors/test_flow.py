import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ppo_dap.prior_config import FlowConfig
from ppo_dap.priors.fit import fit_prior
from ppo_dap.priors.flow import Flow, kept_dimensions

STATES = np.array([[0.3, -0.6], [-0.5, 0.5], [0.8, 0.1]])


def rough(action_size, couplings=4, seed=0):
    """An unfitted flow far from the identity: every weight is moved."""
    rng = np.random.default_rng(seed)
    config = FlowConfig(width=16, state_width=16, couplings=couplings)
    flow = Flow.create(rng, config, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), action_size)
    moved = jax.tree.map(lambda w: jnp.asarray(np.asarray(w) + 0.15 * rng.standard_normal(w.shape), w.dtype), flow)
    return dataclasses.replace(moved, observation_std=jnp.ones(2), spread=flow.spread)


def at(state, rows):
    return jnp.asarray(np.tile(state, (rows, 1)), jnp.float32), jnp.zeros((rows, 0))


log_prob, forward, inverse = (jax.jit(method) for method in (Flow.log_prob, Flow.forward, Flow.inverse))


def cells(num):
    """Middles of a grid of num x num cells over the box."""
    edges = np.linspace(-1, 1, num + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    return edges, np.stack(np.meshgrid(middle, middle, indexing="ij"), axis=-1).reshape(-1, 2)


def density(flow, state, points):
    return np.exp(np.asarray(log_prob(flow, *at(state, len(points)), jnp.asarray(points, jnp.float32)), np.float64))


@pytest.mark.parametrize("action_size", [1, 3])
def test_inverse_undoes_forward(action_size):
    flow = rough(action_size)
    noise = jnp.clip(jax.random.normal(jax.random.key(0), (3, 50, action_size)), -2.0, 2.0)
    states = jnp.asarray(STATES, jnp.float32), jnp.zeros((3, 0))
    actions = forward(flow, *states, noise)
    assert np.abs(actions).max() < 0.999  # else single precision has no way back
    back, _ = inverse(flow, *states, actions)
    np.testing.assert_allclose(back, noise, atol=5e-3)
    np.testing.assert_allclose(forward(flow, *states, back), actions, atol=1e-5)


def test_log_determinant_is_that_of_the_whole_jacobian():
    flow, action_size = rough(3), 3
    noise = 0.7 * jax.random.normal(jax.random.key(1), (20, action_size))

    def one(z):
        return forward(flow, *at(STATES[0], 1), z[None, None])[0, 0]

    jacobians = np.asarray(jax.jit(jax.vmap(jax.jacfwd(one)))(noise), np.float64)
    actions = jax.jit(jax.vmap(one))(noise)
    expected = stats.norm.logpdf(np.asarray(noise)).sum(-1) - np.linalg.slogdet(jacobians)[1]
    np.testing.assert_allclose(log_prob(flow, *at(STATES[0], 20), actions), expected, atol=2e-3)
    # Every number of the action depends on every number of the noise.
    assert np.all(np.abs(jacobians).max(axis=0) > 1e-4)


@pytest.mark.parametrize("action_size", [2, 3, 6])
def test_couplings_take_turns(action_size):
    kept = kept_dimensions(4, action_size)
    assert np.all(kept.any(axis=1) & ~kept.all(axis=1))
    np.testing.assert_array_equal((~kept).sum(axis=0), 2)


def test_density_integrates_to_1_over_the_box(fitted):
    """On a grid in atanh(a), since a density may be steep at the box's edges: da = (1 - a^2) d atanh(a)."""
    edges = np.linspace(-6.5, 6.5, 221)
    points = np.tanh(np.stack(np.meshgrid(edges, edges, indexing="ij"), axis=-1).reshape(-1, 2))
    area = np.prod(1 - points**2, axis=1) * (edges[1] - edges[0]) ** 2
    for flow, states in ((fitted("flow").network, [*STATES[:2], np.array([7.0, -7.0])]), (rough(2), STATES[:1])):
        for state in states:
            assert np.sum(density(flow, state, points) * area) == pytest.approx(1, abs=3e-3)


def test_log_prob_is_the_density_of_the_samples(fitted):
    flow, num, rows = fitted("flow").network, 25, 200_000
    edges, points = cells(num * 8)
    for state in STATES[:2]:
        noise = jax.random.normal(jax.random.key(2), (1, rows, 2))
        samples = np.asarray(forward(flow, *at(state, 1), noise)[0])
        counted = np.histogram2d(*samples.T, bins=[edges[::8]] * 2)[0] / rows
        expected = density(flow, state, points).reshape(num, 8, num, 8).mean(axis=(1, 3)) * 4 / num**2
        # Of 200,000 draws in about 100 cells that hold anything: half of sqrt(2 / pi) sqrt(100 / 200,000) is 0.01.
        assert 0.5 * np.abs(counted - expected).sum() < 0.02


def test_log_prob_of_a_gaussian_target(logs, small):
    rng, sd = np.random.default_rng(0), np.array([0.15, 0.1])
    states = rng.uniform(-1, 1, logs.observations.shape)
    mean = 0.4 * states[:, ::-1]
    scaled = mean + sd * rng.standard_normal(mean.shape)
    units = scaled * np.array([2.0, 0.5]) + np.array([0.0, 0.5])
    flow = fit_prior(dataclasses.replace(logs, observations=states, actions=units), "flow", **small["flow"]).network
    states = rng.uniform(-1, 1, (2000, 2))
    mean = 0.4 * states[:, ::-1]
    scaled = mean + sd * rng.standard_normal(mean.shape)
    inputs = (jnp.asarray(a, jnp.float32) for a in (states, np.zeros((2000, 0)), scaled))
    gap = stats.norm.logpdf(scaled, mean, sd).sum(-1) - np.asarray(log_prob(flow, *inputs))
    assert gap.mean() == pytest.approx(0.0, abs=0.04)  # the KL divergence, in nats
    assert np.abs(gap).mean() < 0.15


def test_actions_at_a_bound(logs, small):
    """Their atanh is infinite; the flow puts them next to the bound, and its likelihoods stay finite."""
    actions = np.array(logs.actions)
    actions[:, 0] = 2.0
    prior = fit_prior(dataclasses.replace(logs, actions=actions), "flow", **small["flow"])
    samples = np.asarray(prior.sample(STATES, jax.random.key(0), 300))
    assert np.quantile(samples[..., 0], 0.02) > 1.96
    # The other dimension keeps its modes.
    assert np.mean(samples[..., 1] < 0.5, axis=1) == pytest.approx(0.3, abs=0.1)
    corners = jnp.asarray([[1.0, 1.0], [-1.0, 1.0], [1.0, 0.0]])
    assert np.all(np.isfinite(log_prob(prior.network, *at(STATES[0], 3), corners)))
