import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from truths import TwoModes, energy, moment_matched

from ppo_dap.prior_config import VAEConfig
from ppo_dap.priors.fit import fit_prior
from ppo_dap.priors.samplers import Solver
from ppo_dap.priors.vae import VAE

STATES = np.array([[0.3, -0.6], [-0.5, 0.5], [0.8, 0.1]])
SOLVER = Solver("ancestral", 1)


def sampled(network, k, limit=np.inf):
    noise = jax.random.normal(jax.random.key(0), network.noise_shape(SOLVER, 3, k))
    inputs = jnp.asarray(STATES, jnp.float32), jnp.zeros((3, 0)), jnp.clip(noise, -limit, limit)
    return np.asarray(network.sample(*inputs, SOLVER)[0], np.float64)


def test_autoencoder_has_the_mean_of_the_logs_and_less_than_their_spread(fitted):
    """With BCQ's weight its decoder stands for noise of spread 0.35, which a sample lacks: the logs' spread shrinks."""
    truths = TwoModes().sample(STATES, 1000, np.random.default_rng(5))
    for x, truth in zip(sampled(fitted("vae").network, 1000), truths, strict=True):
        np.testing.assert_allclose(x.mean(axis=0), truth.mean(axis=0), atol=0.1)
        assert np.all(x.std(axis=0) < truth.std(axis=0))
        # Worse than a diffusion prior or a flow, of which the same test wants 0.1.
        assert energy(x, truth) > 0.1 * energy(moment_matched(truth, np.random.default_rng(6)), truth)


def test_a_small_kl_weight_brings_the_modes_back(logs, small):
    """0.02 stands for a decoder's noise of spread 0.07, the modes' own: it is the weight that costs the spread."""
    prior = fit_prior(logs, "vae", seed=3, kl_weight=0.02, **small["vae"])
    truths = TwoModes().sample(STATES, 1000, np.random.default_rng(5))
    for x, truth in zip(sampled(prior.network, 1000), truths, strict=True):
        assert np.mean(x[:, 0] > 0) == pytest.approx(0.3, abs=0.1)
        assert energy(x, truth) < 0.4 * energy(moment_matched(truth, np.random.default_rng(6)), truth)


def test_clipping_the_code_would_shrink_the_spread(fitted):
    network = fitted("vae").network
    assert network.noise_shape(SOLVER, 3, 7) == (3, 7, 4)
    assert np.all(sampled(network, 2000, limit=0.5).std(axis=1) < 0.8 * sampled(network, 2000).std(axis=1))


def test_loss_is_the_error_plus_the_weighted_divergence():
    rng = np.random.default_rng(0)
    vae = VAE.create(rng, VAEConfig(width=8), jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), 3)
    # Far from its start, where the divergence is near 0.
    vae = dataclasses.replace(vae, encoder=jax.tree.map(lambda w: jnp.asarray(2 * np.asarray(w) + 0.3), vae.encoder))
    actions, draws = (jnp.asarray(rng.uniform(-1, 1, (3, n)), jnp.float32) for n in (3, 6))
    inputs = jnp.asarray(STATES, jnp.float32), jnp.zeros((3, 0)), actions, draws

    def loss(weight):
        return float(dataclasses.replace(vae, config=VAEConfig(width=8, kl_weight=weight)).loss(*inputs))

    mean, log_std = (np.asarray(x) for x in vae.encode(inputs[0], actions))
    codes = mean + np.exp(log_std) * rng.standard_normal((200_000, 3, 6))
    divergence = np.mean(stats.norm.logpdf(codes, mean, np.exp(log_std)) - stats.norm.logpdf(codes))
    assert loss(1.5) - loss(0.5) == pytest.approx(divergence, rel=0.01)
    # The error is that of what `sample` decodes from the same codes.
    code = jnp.asarray(mean + np.exp(log_std) * np.asarray(draws))[:, None]
    decoded = np.asarray(vae.sample(*inputs[:2], code, SOLVER)[0])[:, 0]
    assert loss(1e-9) == pytest.approx(np.mean((decoded - np.asarray(actions)) ** 2), rel=1e-4)
