import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from truths import TwoModes, energy, moment_matched

from ppo_dap.errors import InputError
from ppo_dap.nets.mlp import MLP
from ppo_dap.prior_config import BehaviourConfig
from ppo_dap.priors.behaviour import ClonedGaussian
from ppo_dap.priors.samplers import Solver

STATES = np.array([[0.3, -0.6], [-0.5, 0.5], [0.8, 0.1]])
SOLVER = Solver("ancestral", 1)


def sampled(network, k):
    noise = jax.random.normal(jax.random.key(0), network.noise_shape(SOLVER, 3, k))
    return np.asarray(network.sample(jnp.asarray(STATES, jnp.float32), jnp.zeros((3, 0)), noise, SOLVER)[0])


def gaussian(network):
    return (np.asarray(x) for x in network.gaussian(jnp.asarray(STATES, jnp.float32), jnp.zeros((3, 0))))


def with_log_std(network, value):
    """The network whose free log standard deviations are `value` in every state."""
    *first, last = network.net.layers
    weight, bias = np.array(last.weight), np.array(last.bias)
    half = len(bias) // 2
    weight[half:], bias[half:] = 0.0, value
    last = dataclasses.replace(last, weight=jnp.asarray(weight), bias=jnp.asarray(bias))
    return dataclasses.replace(network, net=MLP((*first, last), network.net.activation))


def fresh(**options):
    config = BehaviourConfig(width=8, **options)
    return ClonedGaussian.create(np.random.default_rng(0), config, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), 3)


def test_clone_is_the_gaussian_with_the_moments_of_the_logs(fitted):
    truth = TwoModes()
    first, second = np.moveaxis(truth.means(STATES), 1, 0)
    mean, std = gaussian(fitted("behaviour").network)
    np.testing.assert_allclose(mean, truth.share * first + (1 - truth.share) * second, atol=0.05)
    variance = truth.sd**2 + truth.share * (1 - truth.share) * (first - second) ** 2
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=0.1)


def test_spread_is_that_of_the_gaussians(fitted):
    prior = fitted("behaviour")
    states = jnp.asarray(prior.probe_observations, jnp.float32)
    mean, std = (np.asarray(x) for x in prior.network.gaussian(states, jnp.zeros((len(states), 0))))
    # A normal variable that is cut off where the task's actions end, as what is executed is.
    cut = stats.norm(mean, std)
    low, high = cut.cdf(-1), cut.sf(1)
    inside = stats.truncnorm((-1 - mean) / std, (1 - mean) / std, mean, std)
    first = inside.mean() * (1 - low - high) + high - low
    second = inside.moment(2) * (1 - low - high) + high + low
    np.testing.assert_allclose(prior.spread(), np.sqrt((second - first**2).mean(axis=0)), rtol=0.03)


def test_clone_cannot_keep_two_modes(fitted):
    truth = TwoModes()
    actual = truth.sample(STATES, 1000, np.random.default_rng(5))
    for x, y, modes in zip(sampled(fitted("behaviour").network, 1000), actual, truth.means(STATES), strict=True):
        # Its dimensions are independent, so it is worse still than the best Gaussian.
        assert energy(x, y) > 0.9 * energy(moment_matched(y, np.random.default_rng(6)), y)
        far = [np.mean(np.linalg.norm(a[:, None] - modes, axis=-1).min(axis=1) > 4 * truth.sd) for a in (x, y)]
        assert far[0] > 0.2
        assert far[1] < 0.01


def test_gaussian_is_what_the_samples_come_from(fitted):
    """By quantiles, which the clipping to the box leaves alone."""
    network = fitted("behaviour").network
    mean, std = gaussian(network)
    low, middle, high = np.quantile(sampled(network, 40_000), stats.norm.cdf([-1.0, 0.0, 1.0]), axis=1)
    np.testing.assert_allclose(middle, mean, atol=0.01)
    np.testing.assert_allclose((high - low) / 2, std, rtol=0.02)


def test_loss_is_the_negative_log_likelihood():
    network = fresh()
    actions = np.random.default_rng(1).uniform(-1, 1, (3, 3))
    mean, std = gaussian(network)
    rows = [stats.multivariate_normal(m, np.diag(s**2)).logpdf(a) for m, s, a in zip(mean, std, actions, strict=True)]
    inputs = (jnp.asarray(x, jnp.float32) for x in (STATES, np.zeros((3, 0)), actions))
    assert float(network.loss(*inputs, ())) == pytest.approx(-np.mean(rows), rel=1e-5)


@pytest.mark.parametrize("floor", [-2.0, -3.5])
def test_spread_stays_above_its_floor_and_finds_back(floor):
    network = fresh(log_std_floor=floor)
    _, std = gaussian(with_log_std(network, -50.0))
    np.testing.assert_allclose(std, np.exp(floor), rtol=1e-5)
    _, std = gaussian(with_log_std(network, 1.0))
    np.testing.assert_allclose(np.log(std), 1.0, atol=0.06)

    def loss(net):
        states, actions = jnp.asarray(STATES, jnp.float32), 0.5 * jnp.ones((3, 3))
        return dataclasses.replace(network, net=net).loss(states, jnp.zeros((3, 0)), actions, ())

    # Below the floor, and actions are far from the mean: the spread is pulled up.
    gradient = jax.grad(loss)(with_log_std(network, floor - 1).net)
    assert np.all(np.asarray(gradient.layers[-1].bias)[3:] < -0.1)


def test_a_floor_above_unit_spread_is_refused():
    with pytest.raises(InputError, match=r"log_std_floor must be a number below 0, not 0\.5"):
        BehaviourConfig(log_std_floor=0.5)
