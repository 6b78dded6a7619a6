"""D_syn: what is resampled, what is carried along, what is logged, and what guidance does to it."""

import itertools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare

from dap.dap_made import OBS, bits, slope_q, small_denoiser
from ppo_dap.config import ProposalConfig
from ppo_dap.dap.proposals import (
    ProposalDraws,
    Proposer,
    States,
    acceptance,
    choose_states,
    gaussian_proxy,
    high_q_rate,
    propose,
    resample,
)
from ppo_dap.nets.adapters import init_adapters

SLOPE = np.array([1.0, -0.5])
Q = slope_q(SLOPE)


N = 256
_propose = jax.jit(propose, static_argnames="config")


def states(raw):
    ids = np.arange(len(raw), dtype=np.int32) + 7
    seen = np.random.default_rng(3).standard_normal(raw.shape)
    return States(*(jnp.asarray(x) for x in (ids, np.float32(raw), np.float32(seen), np.zeros((len(raw), 8), "f4"))))


def proposer(prior, adapters=None, q=Q, spread=1.0, rank=0.0, calibration=None, actor=None):
    return Proposer(prior, jnp.zeros(0), adapters, q, jnp.float32(spread), jnp.float32(rank), calibration, None, actor)


def run(given, prior=None, seed=0, beta=1.0, **options):
    of_proposer = {name: options.pop(name) for name in Proposer._fields if name in options}
    of_proposer |= {name: options.pop(name) for name in ("spread", "rank") if name in options}
    config = ProposalConfig(**{"num_proposals": 4, "sampler_steps": 4, **options})
    prior = prior or small_denoiser()
    count = len(given.state_ids)
    draws = ProposalDraws.make(np.random.default_rng(seed), count, count, prior, config)
    return _propose(proposer(prior, **of_proposer), given, draws, jnp.float32(beta), config=config)


def made(**options):
    """Proposals of the prior on N states."""
    return run(states(np.random.default_rng(4).standard_normal((N, OBS))), **options)


@dataclass(frozen=True)
class PlantedSettings:
    num_conditions: int = 0
    sigma_max: float = 5.0


SETTINGS = PlantedSettings()


class Planted(eqx.Module):
    """A prior whose actions at a state are that state's numbers."""

    count: int = eqx.field(static=True)
    config: PlantedSettings = eqx.field(static=True)

    def noise_shape(self, solver, states, num):
        return (states, num, 2)

    def sample(self, observations, condition, noise, solver, adapters=None, drift=None, displacement_cap=None):
        return observations.reshape(-1, self.count, 2), jnp.zeros((observations.shape[0], self.count))


def resampled(candidates, **options):
    """D_syn from `candidates` (n, 4, 2) in place of the prior's samples: they come in as what the prior reads."""

    planted = candidates.reshape(len(candidates), -1)
    return run(states(planted), Planted(candidates.shape[1], SETTINGS), **options)


def chosen_of(actions, planted):
    """Index of the candidate that each action of D_syn is, found by comparing (planted ones are all different)."""
    same = (np.asarray(actions)[:, :, None] == np.asarray(planted, np.float32)[:, None]).all(-1)
    assert (same.sum(-1) == 1).all()
    return same.argmax(-1)


FOUR = np.array([[0.9, 0.0], [0.1, 0.2], [-0.3, 0.4], [-0.8, -0.8]])
SAME = np.broadcast_to(FOUR, (2000, 4, 2))
MIXED = np.random.default_rng(0).uniform(-1, 1, (2000, 4, 2)).astype(np.float32)


@pytest.mark.parametrize(
    ("options", "temperature"),
    [({"q_scale": "none"}, 2.0), ({"q_scale": "running"}, 2.0 / 0.5), ({"q_scale": "none", "top_k": 2}, 2.0)],
)
def test_resampling_follows_the_energy_weights(options, temperature):
    proposals, _ = resampled(SAME, beta=2.0, spread=0.5, guidance="energy", **options)
    energy = np.exp(temperature * np.tanh(FOUR @ SLOPE))
    if "top_k" in options:
        energy[np.argsort(energy)[:2]] = 0
    counts = np.bincount(chosen_of(proposals.actions, SAME).ravel(), minlength=4)
    expected = counts.sum() * energy / energy.sum()
    assert (counts[expected == 0] == 0).all()
    assert chisquare(counts[expected > 0], expected[expected > 0]).pvalue > 1e-3
    # The same draws are not what other weights would give: the test can tell.
    assert chisquare(counts).pvalue < 1e-9


RESAMPLE_WEIGHTS = np.array([[0.0, 0.1, 0.0, 0.6, 0.3, 0.0], [0.5, 0, 0, 0, 0, 0.5], [0, 0, 1.0, 0, 0, 0]], np.float32)


def test_resample_has_the_frequencies_of_the_weights():
    uniform = np.random.default_rng(0).random((3, 20_000), dtype=np.float32)
    chosen = np.asarray(resample(jnp.asarray(RESAMPLE_WEIGHTS), jnp.asarray(uniform)))
    for row, weights in zip(chosen, RESAMPLE_WEIGHTS, strict=True):
        counts = np.bincount(row, minlength=6)
        assert (counts[weights == 0] == 0).all()
        np.testing.assert_allclose(counts / 20_000, weights, atol=5 * np.sqrt(0.25 / 20_000))
        # Equally many of other weights would not pass for these.
        assert chisquare(counts).pvalue < 1e-9


@pytest.mark.parametrize("scale", [1.0, 1e-3, 0.99999994, 1.0000001])
def test_resample_is_right_at_the_ends_of_the_interval(scale):
    """0, the largest float32 below 1, and weights whose sum rounding has left a little off 1."""
    ends = jnp.broadcast_to(jnp.asarray([0.0, np.nextafter(np.float32(1), np.float32(0))]), (3, 2))
    chosen = resample(jnp.asarray(scale * RESAMPLE_WEIGHTS), ends)
    np.testing.assert_array_equal(chosen, [[1, 4], [0, 5], [2, 2]])


def test_resample_never_lands_on_weight_0_whatever_the_rounding():
    """Sums of many weights of all sizes round; the first and the last candidates have none."""
    rng = np.random.default_rng(1)
    weights = np.exp(8 * rng.standard_normal((2000, 30)))
    weights[:, :3] = weights[:, -3:] = 0
    weights *= rng.random(weights.shape) < 0.7
    weights[:, 10] += 1e-6
    weights = np.float32(weights / weights.sum(1, keepdims=True))
    below = 1 - np.float32(2.0**-24) * np.arange(1, 9)
    ends = np.broadcast_to(np.float32([0.0, *below, 1e-30, 0.5]), (2000, 11))
    between = np.minimum(np.cumsum(weights, axis=1), below[0])  # where one candidate's share ends and the next begins
    chosen = np.asarray(resample(jnp.asarray(weights), jnp.asarray(np.concatenate([ends, between], axis=1))))
    assert (np.take_along_axis(weights, chosen, axis=1) > 0).all()


def test_beta_0_resamples_evenly():
    proposals, metrics = resampled(SAME, beta=0.0, q=slope_q(SLOPE, scale=50.0), guidance="energy", q_scale="none")
    assert chisquare(np.bincount(chosen_of(proposals.actions, SAME).ravel(), minlength=4)).pvalue > 1e-3
    assert float(metrics["ess"]) == pytest.approx(4)


def test_without_energy_guidance_every_candidate_is_kept_as_it_is():
    for guidance in ("none", "gradient"):
        proposals, metrics = resampled(MIXED, guidance=guidance)
        np.testing.assert_array_equal(proposals.actions, MIXED)
        assert float(metrics["acceptance"]) == 1
        assert float(metrics["ess"]) == pytest.approx(4)


def test_the_filter_works_without_energy_weights():
    kept = chosen_of(resampled(MIXED, guidance="none", top_k=2)[0].actions, MIXED)
    ranks = np.argsort(np.argsort(-MIXED @ SLOPE, axis=1), axis=1)
    counts = np.bincount(np.take_along_axis(ranks, kept, axis=1).ravel(), minlength=4)
    assert (counts[2:] == 0).all()
    assert chisquare(counts[:2]).pvalue > 1e-3


def test_metrics_are_the_brute_force_ones_and_provenance_is_carried():
    proposals, metrics = resampled(MIXED, beta=3.0, guidance="energy", q_scale="none")
    q = np.tanh(MIXED @ SLOPE)
    high, used, sizes = 0, 0, []
    for row, values in zip(chosen_of(proposals.actions, MIXED), q, strict=True):
        high += sum(values[i] >= np.percentile(values, 90) for i in row)
        used += len({*row.tolist()})
        weights = np.exp(3.0 * values) / np.exp(3.0 * values).sum()
        sizes.append(1 / (weights**2).sum())
    assert float(metrics["high_q_rate"]) == pytest.approx(high / q.size)
    assert float(metrics["acceptance"]) == pytest.approx(used / q.size)
    assert float(metrics["ess"]) == pytest.approx(np.mean(sizes), rel=1e-4)
    assert float(metrics["q_spread"]) == pytest.approx(np.sqrt(q.var(1).mean()), rel=1e-4)
    # The proxy is that of D_syn, not of the candidates; ids and states are those that came in.
    np.testing.assert_allclose(proposals.proxy_mean, np.asarray(proposals.actions).mean(1), atol=1e-6)
    assert np.abs(np.asarray(proposals.proxy_mean) - MIXED.mean(1)).mean() > 0.1
    for name in ("state_ids", "raw_observations", "observations"):
        np.testing.assert_array_equal(getattr(proposals, name), getattr(states(MIXED.reshape(2000, 8)), name))


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


def test_each_guidance_does_what_it_says():
    q, mean_q, displacement = slope_q(SLOPE, scale=3.0), {}, {}
    for guidance in ("none", "energy", "gradient", "energy+gradient"):
        proposals, metrics = made(guidance=guidance, q=q, q_scale="none")
        assert np.abs(np.asarray(proposals.actions)).max() <= 1
        mean_q[guidance] = float(np.mean(3 * np.tanh(np.asarray(proposals.actions) @ SLOPE)))
        displacement[guidance] = float(metrics["guided_displacement"])
    assert displacement["none"] == displacement["energy"] == 0
    assert displacement["gradient"] == pytest.approx(displacement["energy+gradient"])
    assert displacement["gradient"] > 0.1
    assert mean_q["energy"] > mean_q["none"] + 0.2
    assert mean_q["gradient"] > mean_q["none"] + 0.05
    assert mean_q["energy+gradient"] > max(mean_q["energy"], mean_q["gradient"]) + 0.02


@pytest.mark.parametrize("sampler", ["ancestral", "dpmpp_2m"])
def test_displacement_cap(sampler):
    free, capped = (
        float(made(guidance="gradient", displacement_cap=cap, sampler=sampler, q=slope_q(SLOPE, scale=1000.0))[1][
            "guided_displacement"
        ])
        for cap in (None, 0.15)
    )  # fmt: skip
    assert 0.2 < free <= 0.3001  # at most c at each of 4 steps but the first, where alpha is 0
    assert 0.14 < capped <= 0.15001


def test_no_gradient_of_a_proposal_reaches_the_prior(monkeypatch):
    adapters = jax.tree.map(lambda x: x + 0.1, init_adapters(np.random.default_rng(1), small_denoiser(), "lora", 2))
    given = states(np.ones((4, OBS)))
    config = ProposalConfig(num_proposals=3, sampler_steps=2, q_scale="none")
    draws = jax.tree.map(jnp.asarray, ProposalDraws.make(np.random.default_rng(0), 4, 4, small_denoiser(), config))

    def gradients():
        def total(prior):
            proposals, metrics = propose(proposer(*prior), given, draws, jnp.float32(1), config=config)
            return jnp.sum(proposals.actions**3 + proposals.proxy_std[:, None]) + metrics["ess"]

        return [np.any([np.any(x) for x in jax.tree.leaves(part)]) for part in jax.jit(jax.grad(total))(prior)]

    prior = (small_denoiser(), adapters)
    assert gradients() == [False, False]
    # The same without the block, so that the zeros above mean something.
    monkeypatch.setattr(jax.lax, "stop_gradient", lambda x: x)
    assert gradients() == [True, True]


def test_proposals_are_reproducible_and_differ_by_draws():
    first, again, other = (bits(made(seed=seed, guidance="energy", q_scale="none")[0].actions) for seed in (1, 1, 2))
    assert first == again != other


def test_states_are_chosen_evenly_without_repeats_from_the_rows_with_weight():
    weights = jnp.asarray([1.0, 0, 1, 1, 0, 1, 1, 1])
    uniform = jnp.asarray(np.random.default_rng(0).random((4000, 8), dtype=np.float32))
    drawn = np.asarray(jax.vmap(lambda u: choose_states(weights, u, 3))(uniform))
    assert all(len({*row}) == 3 for row in drawn[:200].tolist())
    counts = np.bincount(drawn.ravel(), minlength=8)
    assert (counts[[1, 4]] == 0).all()
    assert np.abs(counts[[0, 2, 3, 5, 6, 7]] / 4000 - 0.5).max() < 0.05  # 6 sigma
    pairs = [sum({a, b} <= {*row} for row in drawn.tolist()) / 4000 for a, b in itertools.combinations((0, 2, 3), 2)]
    assert pairs == pytest.approx([0.2] * 3, abs=0.05)
