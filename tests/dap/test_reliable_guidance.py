"""What makes guidance reliable (5.6) in D_syn: gate, diversity, mode seeking, pessimism, calibration, closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import chisquare, norm

from dap.dap_made import OBS, bits, filled, slope_q
from dap.test_proposals import FOUR, MIXED, SAME, SLOPE, chosen_of, made, resampled, run, states
from ppo_dap.dap.calibration import Calibration
from ppo_dap.nets.actor import Actor
from ppo_dap.nets.critic import QFunction
from ppo_dap.nets.mlp import MLP, Linear
from ppo_dap.prior_config import BehaviourConfig
from ppo_dap.priors.behaviour import ClonedGaussian

FEW = MIXED[:400]
Q_OF_FEW = np.tanh(FEW @ SLOPE)
ENERGY = {"guidance": "energy", "q_scale": "none"}


def mean_ess(logits):
    return np.mean(1 / (softmax(logits, axis=1) ** 2).sum(1))


# --- the gate: trust in Q by its rank correlation -------------------------------------------------------------------


def gated(rank, **options):
    return made(rank=rank, guidance_gate=True, q_scale="none", sampler_steps=2, **options)


@pytest.mark.parametrize("rank", [0.0, -0.7])
def test_a_q_that_ranks_no_better_than_chance_does_not_guide(rank):
    proposals, metrics = gated(rank)
    assert float(metrics["guided_displacement"]) == 0
    assert float(metrics["ess"]) == pytest.approx(4, rel=1e-6)
    # Every action is one of those that the prior gives unguided.
    free = np.asarray(made(guidance="none", sampler_steps=2)[0].actions)
    gaps = np.abs(np.asarray(proposals.actions)[:, :, None] - free[:, None]).max(-1).min(-1)
    assert gaps.max() < 1e-6


@pytest.mark.as_shipped
def test_a_q_that_ranks_perfectly_guides_as_without_a_gate():
    open_gate, ungated = gated(1.0), made(q_scale="none", sampler_steps=2)
    assert bits(open_gate) == bits(ungated)
    assert float(ungated[1]["guided_displacement"]) > 0.01
    assert bits(gated(0.6)) != bits(ungated)


def test_half_the_trust_is_half_the_temperature():
    half = resampled(FEW, rank=0.5, beta=4.0, guidance_gate=True, **ENERGY)
    assert bits(half) == bits(resampled(FEW, rank=1.0, beta=2.0, guidance_gate=True, **ENERGY))
    assert float(half[1]["ess"]) == pytest.approx(mean_ess(2 * Q_OF_FEW), rel=1e-4)
    # Ungated, the rank is not looked at.
    whole = resampled(FEW, rank=0.5, beta=4.0, **ENERGY)
    assert float(whole[1]["ess"]) == pytest.approx(mean_ess(4 * Q_OF_FEW), rel=1e-4)


def test_the_trust_shortens_the_steps_of_the_gradient_too():
    """A slope so small that no step meets the cap: the steps are proportional to the trust."""
    flat = {"q": slope_q(SLOPE, scale=1e-3)}
    whole, half = (float(gated(rank, **flat)[1]["guided_displacement"]) for rank in (1.0, 0.5))
    assert half == pytest.approx(whole / 2, rel=1e-3)


# --- diversity ------------------------------------------------------------------------------------------------------


def far_pair(candidates):
    """The first action of each state and the one farthest from it."""
    distance = np.linalg.norm(candidates - candidates[:, :1], axis=-1)
    return np.stack([candidates[:, 0], np.take_along_axis(candidates, distance.argmax(1)[:, None, None], 1)[:, 0]], 1)


def test_keep_diverse_leaves_the_actions_that_lie_far_apart():
    proposals, metrics = resampled(FEW, guidance="none", keep_diverse=2)
    np.testing.assert_array_equal(proposals.actions, far_pair(FEW))
    np.testing.assert_allclose(proposals.proxy_mean, far_pair(FEW).mean(1), atol=1e-6)
    assert float(metrics["ess"]) == pytest.approx(2)


def test_weights_are_over_the_actions_that_were_kept():
    proposals, metrics = resampled(FEW, beta=3.0, keep_diverse=2, **ENERGY)
    kept = far_pair(FEW)
    assert proposals.actions.shape == (400, 2, 2)
    assert float(metrics["ess"]) == pytest.approx(mean_ess(3 * np.tanh(kept @ SLOPE)), rel=1e-4)
    weights = softmax(3 * np.tanh(kept @ SLOPE), axis=1)
    drawn = chosen_of(proposals.actions, kept)
    assert drawn.mean() == pytest.approx(weights[:, 1].mean(), abs=4 * 0.5 / np.sqrt(drawn.size))


# --- the policy's own mode ------------------------------------------------------------------------------------------


def actor_at(mean, std):
    """A policy whose mean is the same in every state."""
    blank = jax.tree.map(jnp.zeros_like, filled(lambda rng: Actor.create(rng, OBS, 2, 8), 0))
    last = Linear(blank.mlp.layers[-1].weight, jnp.asarray(mean, jnp.float32))
    mlp = MLP((*blank.mlp.layers[:-1], last), "tanh")
    return Actor(mlp, jnp.full(2, np.log(std), jnp.float32))


def blind(actor):
    """`actor` as it is on the states of `resampled`, which have 8 numbers: it reads the first of them alone."""
    first, *rest = actor.mlp.layers
    weight = jnp.zeros((first.weight.shape[0], 8)).at[:, :OBS].set(first.weight)
    return Actor(MLP((Linear(weight, first.bias), *rest), "tanh"), actor.log_std)


@pytest.mark.parametrize("mode", range(4))
def test_proposals_at_the_policys_mode_dominate(mode):
    actor = blind(actor_at(FOUR[mode], 0.1))
    proposals, _ = resampled(SAME[:400], beta=1.0, actor=actor, mode_seeking=1.0, **ENERGY)
    counts = np.bincount(chosen_of(proposals.actions, SAME[:400]).ravel(), minlength=4)
    assert counts[mode] > 0.99 * counts.sum()


def test_mode_seeking_weights_are_energy_times_a_power_of_the_policy():
    actor, kappa, beta = blind(actor_at([0.1, 0.1], 0.6)), 0.5, 2.0
    log_density = kappa * norm.logpdf(FOUR, [0.1, 0.1], 0.6).sum(-1)
    for options, logits in ((ENERGY, beta * np.tanh(FOUR @ SLOPE) + log_density), ({"guidance": "none"}, log_density)):
        proposals, metrics = resampled(SAME, beta=beta, actor=actor, mode_seeking=kappa, **options)
        counts = np.bincount(chosen_of(proposals.actions, SAME).ravel(), minlength=4)
        assert chisquare(counts, counts.sum() * softmax(logits)).pvalue > 1e-3
        assert float(metrics["ess"]) == pytest.approx(mean_ess(logits[None]), rel=1e-4)
        # The test can tell: Eq. 7's own weights are refused.
        assert chisquare(counts, counts.sum() * softmax(beta * np.tanh(FOUR @ SLOPE))).pvalue < 1e-9


def test_the_policys_density_is_that_at_the_state_as_the_policy_sees_it():
    actor = blind(filled(lambda rng: Actor.create(rng, OBS, 2, 8), 7))
    _, metrics = resampled(FEW, beta=1.0, actor=actor, mode_seeking=0.3, **ENERGY)
    given = states(FEW.reshape(400, 8))

    def ess_at(observations):
        mean, std = np.asarray(actor(observations))[:, None], np.exp(np.asarray(actor.log_std))
        return mean_ess(Q_OF_FEW + 0.3 * norm.logpdf(FEW, mean, std).sum(-1))

    assert float(metrics["ess"]) == pytest.approx(ess_at(given.observations), rel=1e-4)
    assert float(metrics["ess"]) != pytest.approx(ess_at(given.raw_observations), rel=1e-3)


# --- pessimism and calibration --------------------------------------------------------------------------------------


def test_pessimism_lowers_what_heads_do_not_agree_on():
    heads = slope_q(SLOPE), slope_q([-0.5, 2.0])
    twin = QFunction(None, tuple(q.heads[0] for q in heads))
    values = np.stack([Q_OF_FEW, np.tanh(FEW @ [-0.5, 2.0])])
    for pessimism in (0.0, 0.8):
        lower = values.mean(0) - pessimism * values.std(0)
        _, metrics = resampled(FEW, beta=3.0, q=twin, q_pessimism=pessimism, **ENERGY)
        assert float(metrics["ess"]) == pytest.approx(mean_ess(3 * lower), rel=1e-3)
        assert float(metrics["q_spread"]) == pytest.approx(np.sqrt(lower.var(1).mean()), rel=1e-3)


def test_the_identity_calibrates_nothing_and_another_map_does():
    plain = resampled(FEW, beta=2.0, **ENERGY)
    same = resampled(FEW, beta=2.0, calibration=Calibration.identity(), **ENERGY)
    np.testing.assert_array_equal(same[0].actions, plain[0].actions)
    for name, value in plain[1].items():
        assert float(same[1][name]) == pytest.approx(float(value), rel=1e-5)
    # A line of slope 3: three times the temperature.
    line = Calibration(Calibration.identity().q, 3 * Calibration.identity().returns - 7)
    steep = resampled(FEW, beta=2.0, calibration=line, **ENERGY)
    assert float(steep[1]["ess"]) == pytest.approx(mean_ess(6 * Q_OF_FEW), rel=1e-4)
    assert float(plain[1]["ess"]) == pytest.approx(mean_ess(2 * Q_OF_FEW), rel=1e-4)


# --- a prior whose Gaussian is known --------------------------------------------------------------------------------


def clone():
    """N(mean, std) with mean (0.3, -0.2) and free log-spreads -1 and -3 at every state: the floor is felt in them."""
    fresh = ClonedGaussian.create(
        np.random.default_rng(0), BehaviourConfig(width=8), jnp.zeros(OBS), jnp.ones(OBS), jnp.asarray(0.5), 2
    )
    *first, last = fresh.net.layers
    last = Linear(jnp.zeros_like(last.weight), jnp.asarray([0.3, -0.2, -1.0, -3.0], jnp.float32))
    return dataclasses.replace(fresh, net=MLP((*first, last), fresh.net.activation))


def test_a_prior_that_knows_its_gaussian_is_its_own_proxy_unless_weights_draw():
    given = states(np.random.default_rng(4).standard_normal((50, OBS)))
    own, _ = run(given, clone(), guidance="none")
    free, floor = np.array([-1.0, -3.0]), -2.0
    std = np.exp(floor + np.logaddexp(0, free - floor))
    np.testing.assert_allclose(own.proxy_mean, np.broadcast_to([0.3, -0.2], (50, 2)), atol=1e-6)
    np.testing.assert_allclose(own.proxy_std, np.broadcast_to(std, (50, 2)), rtol=1e-5)
    actions = np.asarray(own.actions)
    assert np.abs(actions.mean(1) - own.proxy_mean).max() > 0.05  # four samples do not have its moments
    drawn, _ = run(given, clone(), guidance="energy", q_scale="none", proxy_std_floor=0.15)
    actions = np.asarray(drawn.actions)
    np.testing.assert_allclose(drawn.proxy_mean, actions.mean(1), atol=1e-6)
    np.testing.assert_allclose(drawn.proxy_std, np.maximum(actions.std(1), 0.15), rtol=1e-4, atol=1e-6)


def test_that_gaussian_is_at_the_state_as_the_prior_reads_it():
    prior = ClonedGaussian.create(
        np.random.default_rng(1), BehaviourConfig(width=8), jnp.ones(OBS), 2 * jnp.ones(OBS), jnp.asarray(0.5), 2
    )
    prior = dataclasses.replace(prior, net=jax.tree.map(lambda x: 4 * x, prior.net))
    given = states(np.random.default_rng(4).standard_normal((50, OBS)))
    proxy = run(given, prior, guidance="none")[0]
    hidden = (np.asarray(given.raw_observations, np.float64) - 1) / 2
    for i, layer in enumerate(prior.net.layers):
        hidden = hidden if i == 0 else hidden / (1 + np.exp(-hidden))
        hidden = hidden @ np.asarray(layer.weight, np.float64).T + np.asarray(layer.bias, np.float64)
    np.testing.assert_allclose(proxy.proxy_mean, hidden[:, :2], atol=1e-5)
    np.testing.assert_allclose(proxy.proxy_std, np.exp(-2 + np.logaddexp(0, hidden[:, 2:] + 2)), rtol=1e-4)
    assert hidden[:, :2].std() > 0.05
