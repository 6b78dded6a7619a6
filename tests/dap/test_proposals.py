"""D_syn: what is resampled, what is carried along, what is logged, and what guidance does to it."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare

from dap.dap_made import ACT, DIFFUSION, OBS, bits, slope_q, small_denoiser
from ppo_dap.config import ProposalConfig
from ppo_dap.dap import proposals as module
from ppo_dap.dap.proposals import States, acceptance, choose_states, gaussian_proxy, high_q_rate, propose
from ppo_dap.nets.adapters import init_adapters

SLOPE = np.array([1.0, -0.5])
Q = slope_q(SLOPE)


def states(n):
    keys = jax.random.split(jax.random.key(3))
    raw, seen = (jax.random.normal(k, (n, OBS)) for k in keys)
    return States(jnp.arange(n, dtype=jnp.int32) + 7, raw, seen, jnp.zeros((n, 8)))


def made(n=16, seed=0, beta=1.0, spread=1.0, denoiser=None, adapters=None, q=Q, **options):
    config = ProposalConfig(**{"num_proposals": 4, "sampler_steps": 4, **options})
    denoiser = small_denoiser() if denoiser is None else denoiser
    return propose(
        denoiser, adapters, q, states(n), jax.random.key(seed), jnp.float32(beta), jnp.float32(spread),
        diffusion=DIFFUSION, config=config,
    )  # fmt: skip


@pytest.fixture
def candidates(monkeypatch):
    """Candidates known to the test, in place of the prior's samples; one array for as many states as are asked for."""

    def plant(values):
        values = jnp.asarray(values, jnp.float32)
        monkeypatch.setattr(module, "sample_actions", lambda *a, **k: (values, jnp.zeros(values.shape[:2])))

    return plant


def chosen_of(actions, planted):
    """Index of the candidate that each action of D_syn is, found by comparing (planted ones are all different)."""
    same = (np.asarray(actions)[:, :, None] == np.asarray(planted, np.float32)[:, None]).all(-1)
    assert (same.sum(-1) == 1).all()
    return same.argmax(-1)


FOUR = np.array([[0.9, 0.0], [0.1, 0.2], [-0.3, 0.4], [-0.8, -0.8]])


@pytest.mark.parametrize(
    ("options", "temperature"),
    [({"q_scale": "none"}, 2.0), ({"q_scale": "running"}, 2.0 / 0.5), ({"q_scale": "none", "top_k": 2}, 2.0)],
)
def test_resampling_follows_the_energy_weights(candidates, options, temperature):
    n = 4000
    planted = np.broadcast_to(FOUR, (n, 4, 2))
    candidates(planted)
    proposals, _ = made(n, beta=2.0, spread=0.5, guidance="energy", **options)
    energy = np.exp(temperature * np.tanh(FOUR @ SLOPE))
    if "top_k" in options:
        energy[np.argsort(energy)[:2]] = 0
    counts = np.bincount(chosen_of(proposals.actions, planted).ravel(), minlength=4)
    expected = 4 * n * energy / energy.sum()
    assert (counts[expected == 0] == 0).all()
    assert chisquare(counts[expected > 0], expected[expected > 0]).pvalue > 1e-3
    # The same draws are not what other weights would give: the test can tell.
    assert chisquare(counts, np.full(4, n)).pvalue < 1e-9


def test_without_guidance_every_candidate_is_kept_as_it_is(candidates):
    planted = np.random.default_rng(0).uniform(-1, 1, (16, 4, 2)).astype(np.float32)
    candidates(planted)
    for guidance in ("none", "gradient"):
        proposals, metrics = made(guidance=guidance)
        np.testing.assert_array_equal(proposals.actions, planted)
        assert float(metrics["acceptance"]) == 1
        assert float(metrics["ess"]) == pytest.approx(4)
    assert (np.asarray(made(guidance="energy")[0].actions) != planted).any()
    # The filter works without energy weights too, and evenly over what it keeps.
    filtered = chosen_of(made(guidance="none", top_k=2)[0].actions, planted)
    ranks = np.argsort(np.argsort(-planted @ SLOPE, axis=1), axis=1)
    assert (np.take_along_axis(ranks, filtered, axis=1) < 2).all()


def test_provenance_is_carried(candidates):
    candidates(np.zeros((16, 4, 2)))
    proposals, _ = made()
    given = states(16)
    for name in ("state_ids", "raw_observations", "observations"):
        np.testing.assert_array_equal(getattr(proposals, name), getattr(given, name))


def test_metrics_are_the_brute_force_ones(candidates):
    planted = np.random.default_rng(1).uniform(-1, 1, (40, 4, 2)).astype(np.float32)
    candidates(planted)
    proposals, metrics = made(40, beta=3.0, guidance="energy", q_scale="none")
    q = np.tanh(planted @ SLOPE)
    high, used, sizes = 0, 0, []
    for row, values in zip(chosen_of(proposals.actions, planted), q, strict=True):
        high += sum(values[i] >= np.percentile(values, 90) for i in row)
        used += len({*row.tolist()})
        weights = np.exp(3.0 * values) / np.exp(3.0 * values).sum()
        sizes.append(1 / (weights**2).sum())
    assert float(metrics["high_q_rate"]) == pytest.approx(high / 160)
    assert float(metrics["acceptance"]) == pytest.approx(used / 160)
    assert float(metrics["ess"]) == pytest.approx(np.mean(sizes), rel=1e-4)
    assert float(metrics["q_spread"]) == pytest.approx(np.sqrt(q.var(1).mean()), rel=1e-4)


def test_metrics_by_hand():
    values = jnp.asarray([[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]])
    chosen = jnp.asarray([[3, 3, 0, 3], [0, 1, 2, 3]])
    assert float(high_q_rate(values, chosen)) == 4 / 8
    assert float(acceptance(chosen)) == 6 / 8


def test_proxy_has_the_moments_of_the_proposals_and_a_floor():
    actions = np.random.default_rng(2).normal(0.1, [0.5, 0.01], (30, 10, 2)).astype(np.float32)
    mean, std = gaussian_proxy(jnp.asarray(actions), 0.1)
    np.testing.assert_allclose(mean, actions.mean(1), atol=1e-6)
    np.testing.assert_allclose(std[:, 0], actions[..., 0].std(1), rtol=1e-4)
    np.testing.assert_array_equal(std[:, 1], np.full(30, 0.1, np.float32))


def test_proxy_is_that_of_d_syn_and_not_of_the_candidates(candidates):
    candidates(np.broadcast_to(FOUR, (16, 4, 2)))
    proposals, _ = made(guidance="energy", beta=50.0, q_scale="none")  # nearly always the first one
    np.testing.assert_allclose(proposals.proxy_mean, np.asarray(proposals.actions).mean(1), atol=1e-6)
    assert np.abs(np.asarray(proposals.proxy_mean) - FOUR.mean(0)).max() > 0.3


def test_each_guidance_does_what_it_says():
    q, mean_q, displacement = slope_q(SLOPE, scale=3.0), {}, {}
    for guidance in ("none", "energy", "gradient", "energy+gradient"):
        proposals, metrics = made(256, guidance=guidance, q=q, q_scale="none")
        assert np.abs(np.asarray(proposals.actions)).max() <= 1
        mean_q[guidance] = float(np.mean(3 * np.tanh(np.asarray(proposals.actions) @ SLOPE)))
        displacement[guidance] = float(metrics["guided_displacement"])
    assert displacement["none"] == displacement["energy"] == 0
    assert displacement["gradient"] == displacement["energy+gradient"] > 0.1
    assert mean_q["energy"] > mean_q["none"] + 0.2
    assert mean_q["gradient"] > mean_q["none"] + 0.05
    assert mean_q["energy+gradient"] > max(mean_q["energy"], mean_q["gradient"]) + 0.02


def test_beta_0_is_no_energy_guidance_but_resamples_evenly(candidates):
    planted = np.broadcast_to(FOUR, (2000, 4, 2))
    candidates(planted)
    proposals, metrics = made(2000, beta=0.0, guidance="energy", q=slope_q(SLOPE, scale=50.0), q_scale="none")
    assert chisquare(np.bincount(chosen_of(proposals.actions, planted).ravel(), minlength=4)).pvalue > 1e-3
    assert float(metrics["ess"]) == pytest.approx(4)


@pytest.mark.parametrize("sampler", ["ancestral", "dpmpp_2m"])
def test_displacement_cap(sampler):
    steep = slope_q(SLOPE, scale=100.0)
    free, capped, zero = (
        float(made(q=steep, guidance="gradient", displacement_cap=cap, sampler=sampler)[1]["guided_displacement"])
        for cap in (None, 0.15, 1e-9)
    )
    assert free == pytest.approx(0.3, rel=1e-3)  # c at each of 4 steps but the first, where alpha is 0
    assert capped == pytest.approx(0.15, rel=1e-5)
    assert zero <= 1e-9


def test_no_gradient_of_a_proposal_reaches_the_prior(monkeypatch):
    adapters = init_adapters(jax.random.key(1), small_denoiser(), "lora", 2)

    def total(prior):
        proposals, metrics = made(4, denoiser=prior[0], adapters=prior[1], q_scale="none")
        return jnp.sum(proposals.actions**3) + jnp.sum(proposals.proxy_std + proposals.proxy_mean) + metrics["ess"]

    prior = (small_denoiser(), adapters)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(jax.grad(total)(prior)))
    # The same without the block, so that the zeros above mean something.
    monkeypatch.setattr(jax.lax, "stop_gradient", lambda x: x)
    assert all(any(np.any(leaf) for leaf in jax.tree.leaves(part)) for part in jax.grad(total)(prior))


def test_proposals_are_reproducible_and_differ_by_key():
    assert bits(made(4, seed=1)[0]) == bits(made(4, seed=1)[0])
    assert bits(made(4, seed=1)[0].actions) != bits(made(4, seed=2)[0].actions)
    assert made(4)[0].actions.shape == (4, 4, ACT)


def test_states_are_chosen_evenly_without_repeats_from_the_rows_with_weight():
    weights = jnp.asarray([1.0, 0, 1, 1, 0, 1, 1, 1])
    drawn = np.asarray(jax.vmap(lambda k: choose_states(weights, k, 3))(jax.random.split(jax.random.key(0), 4000)))
    assert all(len({*row}) == 3 for row in drawn[:200].tolist())
    counts = np.bincount(drawn.ravel(), minlength=8)
    assert (counts[[1, 4]] == 0).all()
    assert np.abs(counts[[0, 2, 3, 5, 6, 7]] / 4000 - 0.5).max() < 0.05  # 6 sigma
    pairs = [sum({a, b} <= {*row} for row in drawn.tolist()) / 4000 for a, b in itertools.combinations((0, 2, 3), 2)]
    assert pairs == pytest.approx([0.2] * 3, abs=0.05)
