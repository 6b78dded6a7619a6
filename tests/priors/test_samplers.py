import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths import TwoModes, energy, moment_matched, two_sample_p

from ppo_dap.errors import InputError
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors.diffusion import Denoiser, sample_actions
from ppo_dap.priors.samplers import SAMPLERS, Solver, ancestral, centred_start, dpmpp_2m, karras_sigmas

STATE = np.array([[0.3, -0.6]])
CONFIG = DiffusionConfig(width=16, depth=1)


def sigmas_of(steps):
    return karras_sigmas(steps, CONFIG.sigma_min, CONFIG.sigma_max, CONFIG.rho)


def exact_samples(sampler, steps, num, seed=0):
    noise = jax.random.normal(jax.random.key(seed), (steps + 1, 1, num, 2))
    denoise, sigmas = TwoModes().denoiser(STATE), sigmas_of(steps)

    @jax.jit
    def run(noise):
        noise = noise if sampler == "ancestral" else centred_start(denoise, sigmas[0], noise[0])[None]
        return SAMPLERS[sampler](denoise, sigmas, noise)[0]

    return np.asarray(run(noise)[0], np.float64)


def small_denoiser(observation_size=3, action_size=2, depth=1):
    moments = jnp.zeros(observation_size), jnp.ones(observation_size), jnp.asarray(0.5)
    config = dataclasses.replace(CONFIG, depth=depth)
    return Denoiser.create(np.random.default_rng(0), config, *moments, action_size)


def test_karras_sigmas_end_points_and_spacing():
    sigmas = np.asarray(karras_sigmas(11, 0.02, 5.0, 7.0))
    assert sigmas.shape == (12,)
    assert sigmas[[0, 10]] == pytest.approx([5.0, 0.02], rel=1e-5)
    assert sigmas[-1] == 0.0
    steps = np.diff(sigmas[:-1] ** (1 / 7))  # even in the seventh root is what rho = 7 means
    assert steps == pytest.approx(steps[0], rel=1e-3)


@pytest.mark.parametrize(("sampler", "steps"), [("ancestral", 100), ("dpmpp_2m", 20)])
def test_exact_denoiser_gives_the_true_distribution(sampler, steps):
    truth = TwoModes().sample(STATE, 800, np.random.default_rng(0))[0]
    x = exact_samples(sampler, steps, 800)
    assert two_sample_p(x, truth) > 0.02
    share = np.mean(x[:, 0] > 0)  # the modes lie on either side of 0
    assert abs(share - 0.3) < 3 * np.sqrt(0.3 * 0.7 / 800)


@pytest.mark.parametrize(("steps", "spread"), [(20, 0.083), (200, 0.096)])
def test_eq_8_narrows_a_gaussian_by_what_its_variances_say(steps, spread):
    """N(0.2, 0.1^2), whose denoiser is a line: the variance after each step is known from the one before."""
    levels, variance = np.asarray(sigmas_of(steps), np.float64), sigmas_of(steps)[0].astype(float) ** 2
    for level, below in itertools.pairwise(levels):
        shrink, share = 0.01 / (0.01 + level**2), (below / level) ** 2
        variance = (shrink + share * (1 - shrink)) ** 2 * variance + below**2 * (1 - share)
    assert np.sqrt(variance) == pytest.approx(spread, abs=5e-4)

    def denoise(x, sigma):
        return 0.2 + 0.01 / (0.01 + sigma**2) * (x - 0.2)

    noise = jax.random.normal(jax.random.key(1), (steps + 1, 1, 20_000, 1))
    x, _ = jax.jit(lambda noise: ancestral(denoise, sigmas_of(steps), noise))(noise)
    assert float(jnp.std(x)) == pytest.approx(float(np.sqrt(variance)), rel=0.03)


def test_the_two_sample_test_rejects_what_is_wrong():
    truth = TwoModes().sample(STATE, 800, np.random.default_rng(0))[0]
    again = TwoModes().sample(STATE, 800, np.random.default_rng(1))[0]
    assert two_sample_p(again, truth) > 0.02
    assert two_sample_p(moment_matched(truth, np.random.default_rng(2)), truth) == 0.005
    other_shares = TwoModes(share=0.45).sample(STATE, 800, np.random.default_rng(3))[0]
    assert two_sample_p(other_shares, truth) < 0.02


def test_second_order_solver_needs_half_the_steps():
    """Over six samples of 1000: the mean distance to the truth, against that of a Gaussian with the right moments."""
    rng = np.random.default_rng(0)
    truths = [TwoModes().sample(STATE, 1000, rng)[0] for _ in range(6)]
    scale = np.mean([energy(moment_matched(truth, rng), truth) for truth in truths])

    def quality(sampler, steps):
        x = exact_samples(sampler, steps, 6000).reshape(6, 1000, 2)
        return np.mean([energy(part, truth) for part, truth in zip(x, truths, strict=True)])

    half, full = quality("dpmpp_2m", 10), quality("ancestral", 20)
    assert half < full + 0.005 * scale  # the distance of six such samples of the truth itself has this spread
    assert max(half, full) < 0.03 * scale
    assert quality("dpmpp_2m", 4) > 0.06 * scale  # too few steps show


def test_the_start_lies_around_the_mean_of_the_actions():
    sigma = jnp.asarray(CONFIG.sigma_max)
    truth = TwoModes()
    noise = jax.random.normal(jax.random.key(0), (1, 40_000, 2))
    offset = np.asarray(sigma * (centred_start(truth.denoiser(STATE), sigma, noise) - noise))[0].mean(0)
    expected = np.array([truth.share, 1 - truth.share]) @ truth.means(STATE)[0]
    np.testing.assert_allclose(offset, expected, atol=0.02)


@pytest.mark.parametrize(("sd", "steps"), [(0.0, 8), (0.1, 160)])
def test_ancestral_has_the_marginal_spread_at_every_level(sd, steps):
    """x_sigma ~ N(m, sd^2 + sigma^2): at any step size for sd = 0, where the step is exact, else at fine steps."""
    sigmas = jnp.geomspace(0.15, 0.02, steps + 1)
    noise = jax.random.normal(jax.random.key(1), (steps + 1, 1, 4000, 1))
    # The start is pure noise: for sd > 0 it gets the data's share of the spread, so that every level can be exact.
    noise = noise.at[0].mul(float(np.hypot(sd, sigmas[0]) / sigmas[0]))

    def denoise(x, sigma):
        return (sd**2 * x + sigma**2 * 0.0) / (sd**2 + sigma**2)

    for i in (steps // 4, steps // 2, steps):
        x, _ = ancestral(denoise, sigmas[: i + 1], noise[: i + 1])
        expected = np.hypot(sd, float(sigmas[i]))
        assert np.std(np.asarray(x)) == pytest.approx(expected, rel=0.045)  # 4 standard errors
        assert abs(np.mean(np.asarray(x))) < 4 * expected / np.sqrt(4000)


def test_dpmpp_2m_is_second_order():
    """dx/dsigma = (x - D)/sigma with Gaussian data: x shrinks as sqrt(sd^2 + sigma^2), exactly."""
    sd, start, end = 0.1, 0.3, 0.03
    exact = start * np.sqrt((sd**2 + end**2) / (sd**2 + start**2))
    counts, errors = np.array([8, 16, 32, 64]), []
    for steps in counts:
        sigmas = jnp.geomspace(start, end, int(steps) + 1)
        x, _ = dpmpp_2m(lambda x, sigma: sd**2 * x / (sd**2 + sigma**2), sigmas, jnp.ones((1, 1, 1, 1)))
        errors.append(abs(float(x[0, 0, 0]) - exact))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert order > 1.7


@pytest.mark.parametrize(("sampler", "kept"), [(ancestral, 0.25), (dpmpp_2m, 0.5)])
def test_drift_is_added_after_each_step_at_the_steps_own_level(sampler, kept):
    """Data at 0, levels 0.4, 0.2, 0.1: a step keeps (sigma'/sigma)^2 of x in Eq. 8 and sigma'/sigma in the ODE."""
    levels = jnp.asarray([0.4, 0.2, 0.1])
    direction = jnp.asarray([0.6, 0.8])

    def drift(x, sigma):
        return sigma * jnp.broadcast_to(direction, x.shape)

    noise = jnp.zeros((3, 2, 5, 2))
    x, displacement = sampler(lambda x, sigma: jnp.zeros_like(x), levels, noise, drift)
    expected = np.broadcast_to((0.4 * kept + 0.2) * np.array([0.6, 0.8]), (2, 5, 2))
    np.testing.assert_allclose(x, expected, rtol=1e-6)
    np.testing.assert_allclose(displacement, np.full((2, 5), 0.6), rtol=1e-6)


def test_drift_sees_the_sample_before_the_step():
    levels = jnp.asarray([0.4, 0.0])
    noise = jnp.zeros((2, 1, 1, 1)).at[0].set(1.0)
    x, displacement = ancestral(lambda x, sigma: 0.1 + 0 * x, levels, noise, lambda x, sigma: 0.5 * x)
    assert float(x[0, 0, 0]) == pytest.approx(0.1 + 0.5 * 0.4)
    assert float(displacement[0, 0]) == pytest.approx(0.2)


@pytest.mark.as_shipped
@pytest.mark.parametrize("sampler", [ancestral, dpmpp_2m])
def test_displacement_cap(sampler):
    noise = jax.random.normal(jax.random.key(0), (11, 3, 4, 2))

    def run(cap, drift):
        return sampler(TwoModes().denoiser(np.zeros((3, 2))), sigmas_of(10), noise, drift, cap)

    def push(x, sigma):
        return jnp.full_like(x, 0.1 / np.sqrt(2))

    free, norm = run(None, push)
    np.testing.assert_allclose(norm, np.ones((3, 4)), rtol=1e-5)  # 10 steps of 0.1
    _, capped = run(0.25, push)
    np.testing.assert_allclose(capped, np.full((3, 4), 0.25), rtol=1e-6)
    loose, _ = run(1.5, push)
    np.testing.assert_allclose(loose, free, atol=1e-6)
    unguided, zero = run(None, None)
    np.testing.assert_array_equal(run(0.0, push)[0], unguided)
    np.testing.assert_array_equal(zero, np.zeros((3, 4)))


@pytest.mark.parametrize("sampler", [ancestral, dpmpp_2m])
def test_samples_stay_in_the_box(sampler):
    noise = jax.random.normal(jax.random.key(0), (6, 2, 50, 3))
    x, _ = sampler(lambda x, sigma: 3 * x, sigmas_of(5), noise, lambda x, sigma: 0.1 + 0 * x)
    assert np.abs(x).max() == 1.0


def walk(jaxpr, inside=False):
    """(equation, whether it is in a loop) for every equation of a program and of the programs in it."""
    for equation in jaxpr.eqns:
        yield equation, inside
        for value in equation.params.values():
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from walk(inner, inside or equation.primitive.name in ("scan", "while"))


def random_draws(program):
    return [e for e, _ in walk(program.jaxpr) if e.primitive.name.startswith(("random", "threefry"))]


@pytest.mark.parametrize("sampler", ["ancestral", "dpmpp_2m"])
@pytest.mark.parametrize("depth", [1, 2])
def test_states_are_embedded_once_and_nothing_is_drawn(sampler, depth):
    denoiser, solver = small_denoiser(13, depth=depth), Solver(sampler, 5)
    arguments = jnp.zeros((7, 13)), jnp.zeros((7, 0)), jnp.zeros(solver.noise_shape(7, 6, 2))

    def run(observations, condition, noise):
        return sample_actions(denoiser, None, observations, condition, noise, solver, CONFIG)

    program = jax.make_jaxpr(run)(*arguments)
    products = [(e.invars[0].aval.shape, loop) for e, loop in walk(program.jaxpr) if e.primitive.name == "dot_general"]
    of_states = [loop for shape, loop in products if len(shape) == 2]
    assert of_states == [False] * 3  # the three layers of the state network, outside the loop
    # A call has a product for each layer that sees the actions and one for the noise level, one row for all of them.
    # The deterministic solver calls once before its loop.
    for shape, count in (((7, 6), 2 + depth), ((1, 1), 1)):
        loops = [loop for found, loop in products if len(found) == 3 and found[:2] == shape]
        assert loops.count(False) == count * (sampler == "dpmpp_2m")
        assert loops.count(True) == count
    assert len(products) == 3 + (3 + depth) * (1 + (sampler == "dpmpp_2m"))
    assert random_draws(program) == []
    assert random_draws(jax.make_jaxpr(jax.random.normal)(jax.random.key(0)))  # planted


def test_sample_actions_repeats_under_the_same_noise_only():
    denoiser = small_denoiser()
    observations, condition = jnp.ones((4, 3)), jnp.zeros((4, 0))
    sample = jax.jit(sample_actions, static_argnums=(5, 6))

    def run(seed, sampler="ancestral", num_steps=20):
        solver = Solver(sampler, num_steps)
        noise = jax.random.normal(jax.random.key(seed), solver.noise_shape(4, 6, 2))
        return sample(denoiser, None, observations, condition, noise, solver, CONFIG)[0]

    np.testing.assert_array_equal(run(0), run(0))
    assert np.abs(np.asarray(run(0) - run(1))).max() > 0.01
    assert run(0, sampler="dpmpp_2m", num_steps=3).shape == (4, 6, 2)
    assert Solver("ancestral", 3).noise_shape(4, 6, 2) == (4, 4, 6, 2)  # the start and one for each step
    assert Solver("dpmpp_2m", 3).noise_shape(4, 6, 2) == (1, 4, 6, 2)
    with pytest.raises(InputError, match="did you mean 'ancestral'"):
        run(0, sampler="ancestrel")
