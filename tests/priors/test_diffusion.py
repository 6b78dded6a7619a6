import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.nets.mlp import Linear
from ppo_dap.priors.diffusion import (
    Denoiser,
    DiffusionConfig,
    LossDraws,
    denoising_loss,
    noise_features,
    spread_sigmas,
)
from ppo_dap.priors.fit import Rows, train_network

SD = 0.2


def zero_output(config, sigma_data, action_size=3):
    """A denoiser whose network says 0, so that D(x; sigma) = c_skip x: Bayes-optimal for N(0, sigma_data^2) data."""
    moments = jnp.zeros(2), jnp.ones(2), jnp.asarray(sigma_data)
    denoiser = Denoiser.create(np.random.default_rng(0), config, *moments, action_size)
    silent = Linear(jnp.zeros_like(denoiser.out.weight), jnp.zeros_like(denoiser.out.bias))
    return Denoiser(**{**vars(denoiser), "out": silent})


def loss_of_silent_network(rows=50_000, **options):
    config = DiffusionConfig(width=4, depth=1, **options)
    actions = SD * jax.random.normal(jax.random.key(5), (rows, 3))
    inputs = jnp.zeros((rows, 2)), jnp.zeros((rows, 0)), actions
    loss = jax.jit(denoising_loss, static_argnames="config")
    draws = LossDraws.make(np.random.default_rng(6), rows, 3)
    return float(loss(zero_output(config, SD), None, *inputs, draws, config))


def test_edm_weighting_makes_every_level_count_one_per_dimension():
    """The posterior variance sd^2 sigma^2 / (sd^2 + sigma^2) is the inverse of the weight: 3 dimensions give 3."""
    assert loss_of_silent_network() == pytest.approx(3.0, rel=0.02)


def test_equation_6_as_printed_has_its_closed_form():
    """The mean of sd^2 sigma^2 / (sd^2 + sigma^2) over log-uniform sigma, integrated by hand."""
    low, high = 0.05, 2.0
    options = {"loss_weighting": "none", "noise_distribution": "loguniform", "sigma_min": low, "sigma_max": high}
    mean = SD**2 * np.log((high**2 + SD**2) / (low**2 + SD**2)) / (2 * np.log(high / low))
    assert loss_of_silent_network(**options) == pytest.approx(3 * mean, rel=0.02)


def test_sigmas_follow_their_distribution():
    def draw(**options):
        config = DiffusionConfig(sigma_min=0.01, sigma_max=10.0, **options)
        uniform = jnp.asarray(np.random.default_rng(0).random(4000, dtype=np.float32))
        return np.log(np.asarray(spread_sigmas(uniform, jnp.asarray(0.5), config), np.float64))

    uniform = stats.uniform(np.log(0.01), np.log(1000))
    assert stats.kstest(draw(noise_distribution="loguniform"), uniform.cdf).pvalue > 0.05
    inner = draw(noise_distribution="lognormal")
    # Karras et al.'s N(-1.2, 1.2^2) for data of spread 0.5.
    assert stats.kstest(inner[np.abs(inner) < 4.5], stats.norm(-1.193, 1.2).cdf).pvalue > 0.05


@pytest.fixture(scope="module")
def gaussian_fit():
    """A denoiser fitted to a ~ N(m(s), SD^2) with m(s) = 0.3 sin(2 s), well inside the box."""
    rng = np.random.default_rng(0)
    # So many rows that chance in the rows is well below what the tests allow, whatever the seed of the fit.
    states = rng.uniform(-1, 1, (60_000, 1))
    actions = 0.3 * np.sin(2 * states) + SD * rng.standard_normal(states.shape)
    rows = Rows(*(jnp.asarray(a, jnp.float32) for a in (states, np.zeros((len(states), 0)), actions)))
    config = DiffusionConfig(width=64, depth=1, batch_size=512, max_steps=1500, chunk_steps=300, ema_decay=0.995)
    held_out = Rows(*(a[54_000:] for a in rows))
    denoiser, _ = train_network(Denoiser, Rows(*(a[:54_000] for a in rows)), held_out, config, 0)
    return denoiser, config


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.7, 3.0])
def test_fitted_denoiser_is_the_posterior_mean(gaussian_fit, sigma):
    denoiser, _ = gaussian_fit
    rng = np.random.default_rng(1)
    states = rng.uniform(-0.9, 0.9, (100, 1)).astype(np.float32)
    mean = 0.3 * np.sin(2 * states)[:, None]
    x = (mean + np.hypot(SD, sigma) * rng.standard_normal((100, 8, 1))).astype(np.float32)
    embedding = denoiser.embed(jnp.asarray(states), jnp.zeros((100, 0)))
    denoised = np.asarray(denoiser(jnp.asarray(x), embedding, jnp.asarray(sigma, jnp.float32)))
    exact = (SD**2 * x + sigma**2 * mean) / (SD**2 + sigma**2)
    error = np.sqrt(np.mean((denoised - exact) ** 2))
    assert error < 0.1 * SD
    # What ignores the state, or the noisy action, is far off at the levels where that matters.
    ignorant = SD**2 * x / (SD**2 + sigma**2) if sigma > SD else mean
    assert error < 0.4 * np.sqrt(np.mean((ignorant - exact) ** 2))


def test_a_level_for_each_action_equals_one_level_for_all(gaussian_fit):
    denoiser, _ = gaussian_fit
    x = jax.random.normal(jax.random.key(0), (5, 4, 1))
    embedding = denoiser.embed(jnp.ones((5, 1)) * 0.3, jnp.zeros((5, 0)))
    one = denoiser(x, embedding, jnp.asarray(0.4))
    np.testing.assert_allclose(denoiser(x, embedding, jnp.full((5, 4), 0.4)), one, rtol=1e-5, atol=1e-6)


def test_the_network_is_its_formula_in_plain_numpy():
    """FiLM: state and noise level shift the first layer, and scale and shift each hidden one."""
    config = DiffusionConfig(width=6, depth=2, state_width=5)
    denoiser = Denoiser.create(np.random.default_rng(3), config, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), 3)
    rng = np.random.default_rng(0)
    denoiser = jax.tree.map(lambda leaf: jnp.asarray(0.5 * rng.standard_normal(leaf.shape), jnp.float32), denoiser)
    denoiser = dataclasses.replace(
        denoiser, observation_mean=jnp.zeros(2), observation_std=jnp.ones(2), sigma_data=jnp.asarray(0.5)
    )
    states, x, sigma = rng.standard_normal((4, 2)), rng.standard_normal((4, 7, 3)), 0.3

    def linear(layer, h):
        return h @ np.asarray(layer.weight, np.float64).T + np.asarray(layer.bias, np.float64)

    def silu(h):
        return h / (1 + np.exp(-h))

    h = states
    for layer in denoiser.state_net.layers[:-1]:
        h = silu(linear(layer, h))
    features = np.asarray(noise_features(jnp.asarray(sigma)), np.float64)
    conditioning = linear(denoiser.state_net.layers[-1], h) + linear(denoiser.noise_in, features)
    shift, scale_1, shift_1, scale_2, shift_2 = conditioning.reshape(4, 1, 5, 6).transpose(2, 0, 1, 3)
    total = sigma**2 + 0.5**2
    h = silu(linear(denoiser.action_in, x / np.sqrt(total)) + shift)
    for layer, scale, shift in zip(denoiser.hidden, (scale_1, scale_2), (shift_1, shift_2), strict=True):
        h = silu(linear(layer, h) * (1 + scale) + shift)
    expected = 0.5**2 / total * x + sigma * 0.5 / np.sqrt(total) * linear(denoiser.out, h)

    embedding = denoiser.embed(jnp.asarray(states, jnp.float32), jnp.zeros((4, 0)))
    got = denoiser(jnp.asarray(x, jnp.float32), embedding, jnp.asarray(sigma))
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_observations_are_normalised_and_clipped():
    config = DiffusionConfig(width=8, depth=1)
    denoiser = Denoiser.create(
        np.random.default_rng(0), config, jnp.asarray([5.0]), jnp.asarray([2.0]), jnp.asarray(0.5), 1
    )
    none = jnp.zeros((1, 0))
    np.testing.assert_array_equal(
        denoiser.embed(jnp.asarray([[25.0]]), none), denoiser.embed(jnp.asarray([[1e6]]), none)
    )
    assert np.any(denoiser.embed(jnp.asarray([[24.0]]), none) != denoiser.embed(jnp.asarray([[25.0]]), none))


def test_moments_of_the_logs_do_not_move(gaussian_fit):
    denoiser, config = gaussian_fit
    inputs = jnp.ones((8, 1)), jnp.zeros((8, 0)), jnp.ones((8, 1))
    loss = jax.jit(denoising_loss, static_argnames="config")
    draws = LossDraws.make(np.random.default_rng(0), 8, 1)
    gradient = jax.grad(loss)(denoiser, None, *inputs, draws, config)
    assert float(gradient.sigma_data) == 0
    assert not np.any(gradient.observation_mean)
    assert not np.any(gradient.observation_std)
    assert np.any(gradient.out.weight)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width must be"),
        ({"max_steps": -1}, "max_steps must be"),
        ({"sigma_min": 6.0}, "must be below sigma_max"),
        ({"sigma_max": float("nan")}, "sigma_max must be"),
        ({"validation_fraction": 1.5}, "below 1"),
    ],
)
def test_impossible_settings_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        DiffusionConfig(**options)


def test_settings_of_the_wrong_type_are_refused():
    """In a process of its own, since the tests' type checker would speak first."""
    code = """
from ppo_dap.errors import InputError
from ppo_dap.prior_config import DiffusionConfig
for options in ({"noise_distribution": "log-normal"}, {"width": "64"}, {"depth": 1.5}, {"rho": True}):
    try:
        DiffusionConfig(**options)
    except InputError as error:
        print(error)
"""
    lines = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 4
    assert "did you mean 'lognormal'" in lines[0]
    assert lines[1] == "width must be an integer above 0, not '64'"
    assert lines[2] == "depth must be an integer above 0, not 1.5"
    assert lines[3] == "rho must be a number above 0, not True"
