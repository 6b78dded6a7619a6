"""What a prior is asked for: the condition that stands for a return, and classifier-free guidance towards it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ppo_dap.logs import Logs
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors.diffusion import Denoiser, sample_actions
from ppo_dap.priors.fit import fit_prior
from ppo_dap.priors.samplers import Solver

SHIFT, SD = 0.2, 0.1
SOLVERS = ("ancestral", "dpmpp_2m")


class Known(Denoiser):
    """The denoiser of actions ~ N(SHIFT * label, SD^2); the condition is (label, 1), and zeros ask for no label."""

    def embed(self, observations, condition):
        return condition

    def __call__(self, x, embedding, sigma, adapters=None):
        mean = SHIFT * embedding[:, None, :1]
        return (SD**2 * x + sigma**2 * mean) / (SD**2 + sigma**2)


CONFIG = DiffusionConfig(width=4, condition_on="return")
KNOWN = Known(**vars(Denoiser.create(np.random.default_rng(0), CONFIG, jnp.zeros(2), jnp.ones(2), jnp.asarray(SD), 1)))


def sampled(denoiser, weight, label=1.0, known=1.0, solver="ancestral", steps=20, num=2000):
    solver = Solver(solver, steps, weight)
    noise = jnp.asarray(np.random.default_rng(1).standard_normal(solver.noise_shape(1, num, 1)), jnp.float32)
    condition = jnp.asarray([[label, known]], jnp.float32)
    sample = jax.jit(lambda d, c, n: sample_actions(d, None, jnp.zeros((1, 2)), c, n, solver, d.config)[0])
    return np.asarray(sample(denoiser, condition, noise))[0, :, 0]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0, 2.0, 3.0])
def test_guidance_goes_as_far_beyond_the_unconditioned_prior_as_it_says(solver, weight):
    """u + w (c - u), of denoisers of N(0, SD^2) and N(SHIFT, SD^2), is the one of N(w SHIFT, SD^2)."""
    actions = sampled(KNOWN, weight, solver=solver, steps=200)  # so many that Eq. 8 keeps the spread
    assert actions.mean() == pytest.approx(weight * SHIFT, abs=0.015)
    assert stats.kstest(actions - actions.mean(), stats.norm(0, actions.std()).cdf).pvalue > 1e-3
    assert actions.std() == pytest.approx(SD, rel=0.1)


def fresh():
    """A network without any pattern, which reads the condition."""
    made = Denoiser.create(np.random.default_rng(0), CONFIG, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), 1)
    rng = np.random.default_rng(2)
    return jax.tree.map(lambda x: x + jnp.asarray(0.1 * rng.standard_normal(x.shape), jnp.float32), made)


@pytest.mark.parametrize("solver", SOLVERS)
def test_weight_1_is_the_conditioned_prior_and_weight_0_the_unconditioned_one(solver):
    options = {"solver": solver, "steps": 4, "num": 20}
    plain = Solver(solver, 4)
    assert plain.condition_weight == 1
    conditioned, free = sampled(fresh(), 1.0, **options), sampled(fresh(), 1.0, label=0.0, known=0.0, **options)
    network, noise = fresh(), np.random.default_rng(1).standard_normal(plain.noise_shape(1, 20, 1))
    own = network.sample(jnp.zeros((1, 2)), jnp.ones((1, 2)), jnp.asarray(noise, jnp.float32), plain)[0]
    np.testing.assert_allclose(own[0, :, 0], conditioned, atol=1e-5)
    np.testing.assert_allclose(sampled(fresh(), 0.0, **options), free, atol=1e-6)  # a GPU rounds two programs apart
    assert np.abs(conditioned - free).max() > 0.02
    # Between the two, and beyond.
    assert np.abs(sampled(fresh(), 0.5, **options) - conditioned).max() > 1e-3
    assert np.abs(sampled(fresh(), 2.0, **options) - conditioned).max() > 1e-3


def test_a_prior_without_a_condition_has_nothing_to_be_guided_towards():
    config = DiffusionConfig(width=4)
    network = Denoiser.create(np.random.default_rng(0), config, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5), 1)
    noise = jnp.asarray(np.random.default_rng(1).standard_normal((5, 1, 20, 1)), jnp.float32)
    one, three = (
        network.sample(jnp.zeros((1, 2)), jnp.zeros((1, 0)), noise, Solver("ancestral", 4, weight))[0]
        for weight in (1.0, 3.0)
    )
    np.testing.assert_array_equal(one, three)


# --- fitted to logs in which the best episodes act differently ------------------------------------------------------


# One that is trained, one that denoises and one that is built; `labelled` has the networks of all kinds.
QUICK = {"max_steps": 400, "chunk_steps": 200, "batch_size": 128, "warmup_steps": 50, "ema_decay": 0.98}
OPTIONS = {
    "diffusion": {**QUICK, "width": 32, "state_width": 32},
    "behaviour": {**QUICK, "width": 32},
    "retrieval": {"return_weight": 10.0},
}


def logs_of_good_and_bad():
    """200 episodes of 20 rows: half of them earn about 100 with actions near 0.5, the others about 0 with -0.5."""
    rng = np.random.default_rng(0)
    good = rng.random(200) < 0.5
    returns = 100.0 * good + rng.normal(0, 5, 200)
    actions = np.repeat(np.where(good, 0.5, -0.5), 20)[:, None] + 0.05 * rng.standard_normal((4000, 1))
    ends = np.arange(4000) % 20 == 19
    bounds = {"action_low": -np.ones(1), "action_high": np.ones(1)}
    rewards = (np.repeat(returns, 20) / 20).astype(np.float32)
    states = rng.standard_normal((4000, 2)).astype(np.float32)
    return Logs(states, actions.astype(np.float32), ends, rewards=rewards, **bounds)


LOGS = logs_of_good_and_bad()


@pytest.mark.parametrize("kind", OPTIONS)
def test_asked_for_the_top_it_acts_as_the_good_episodes_did_and_else_as_all(kind):
    prior = fit_prior(LOGS, kind, seed=0, condition_on="return", **OPTIONS[kind])
    train, _ = LOGS.split(prior.config.validation_fraction, 0)
    stops = np.flatnonzero(train.episode_ends) + 1
    per_row = [[rewards.sum()] * len(rewards) for rewards in np.split(train.rewards.astype(float), stops[:-1])]
    returns = np.concatenate(per_row)
    top = (np.percentile(returns, 95) - returns.mean()) / returns.std()
    np.testing.assert_allclose(prior.condition("top"), [top, 1.0], rtol=1e-5)
    np.testing.assert_array_equal(prior.condition("none"), [0.0, 0.0])
    states = np.random.default_rng(3).standard_normal((30, 2)).astype(np.float32)
    best, any_ = (np.asarray(prior.sample(states, jax.random.key(0), 20, asked)) for asked in ("top", "none"))
    assert np.abs(best - 0.5).mean() < 0.15
    assert (best > 0).mean() > 0.97
    assert 0.25 < (any_ > 0).mean() < 0.75
