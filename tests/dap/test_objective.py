"""Eq. 9's last two terms against Monte Carlo and finite differences, and the gate in front of them by hand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import norm

from dap.dap_made import bits, changed, filled
from ppo_dap.config import ObjectiveConfig
from ppo_dap.dap.objective import (
    Batch,
    GatedProposals,
    Weights,
    added_gradient,
    added_terms,
    admit,
    admit_proposals,
    advantage_weighted_loss,
    proposal_terms,
    provenance,
)
from ppo_dap.dap.proposals import Proposals
from ppo_dap.nets.actor import Actor
from ppo_dap.ppo.update import Rows

N, K = 5, 4
_WIDE, _FLAT = jnp.zeros((N, 3)), jnp.zeros(N)
ROWS = Rows(jnp.arange(N), _WIDE, _WIDE, jnp.zeros((N, 2)), _FLAT, jnp.zeros((N, 2)), _FLAT, _FLAT, _FLAT, _FLAT)


def numbers(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def gated_of(gate=(1, 1, 1, 1, 1), dtype=jnp.float32):
    """Proposals without any pattern; the gate says which count."""
    parts = numbers(N, 3, seed=1), numbers(N, K, 2, seed=2), numbers(N, 2, seed=3), np.exp(0.3 * numbers(N, 2, seed=4))
    states, actions, mean, std = (jnp.asarray(p, dtype) for p in parts)
    return GatedProposals(
        Proposals(jnp.arange(N, dtype=jnp.int32), states, states, actions, mean, std), jnp.asarray(gate, dtype)
    )


def weights_of(kl, aux, dtype=jnp.float32):
    return Weights(jnp.asarray(kl, dtype), jnp.asarray(aux, dtype), jnp.zeros((), dtype))


@pytest.fixture(scope="module")
def actor():
    return filled(lambda rng: Actor.create(rng, 3, 2, 4), 7)


terms = jax.jit(proposal_terms)
_added = jax.jit(partial(added_gradient, config=ObjectiveConfig()))


def gradient_of(actor, gated, weights):
    return _added(actor, ROWS, gated, weights)


def test_value_by_monte_carlo_and_scipy(actor):
    gated = gated_of(gate=(1, 0, 1, 1, 0))
    proposals, used = gated.proposals, [0, 2, 3]
    means, std = np.asarray(actor(proposals.observations)), np.exp(np.asarray(actor.log_std))
    samples = means[:, None] + std * np.random.default_rng(0).standard_normal((N, 200_000, 2))
    mean, spread = np.asarray(proposals.proxy_mean)[:, None], np.asarray(proposals.proxy_std)[:, None]
    log_ratio = (norm.logpdf(samples, means[:, None], std) - norm.logpdf(samples, mean, spread)).sum(-1)
    nll = -norm.logpdf(np.asarray(proposals.actions), means[:, None], std).sum(-1)
    loss, metrics = terms(actor, gated, weights_of(2.0, 3.0))
    assert float(metrics["kl_loss"]) == pytest.approx(log_ratio[used].mean(), rel=0.01)
    assert float(metrics["aux_loss"]) == pytest.approx(nll[used].mean(), rel=1e-4)
    assert float(loss) == pytest.approx(2 * log_ratio[used].mean() + 3 * nll[used].mean(), rel=0.01)


def test_gradient_is_the_finite_difference_in_every_parameter(actor):
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), actor)
        gated, weights = gated_of((1, 0, 1, 1, 1), jnp.float64), weights_of(0.7, 1.3, jnp.float64)
        flat, restore = ravel_pytree(wide)
        gradient = ravel_pytree(gradient_of(wide, gated, weights)[0])[0]
        values = jax.jit(jax.vmap(lambda p: proposal_terms(restore(p), gated, weights)[0]))
        steps = 1e-5 * jnp.eye(len(flat))
        here = jnp.broadcast_to(flat, steps.shape)
        slopes = (values(here + steps) - values(here - steps)) / 2e-5
    np.testing.assert_allclose(gradient, slopes, atol=1e-8)
    assert (np.asarray(gradient) != 0).all()


@pytest.mark.parametrize(("floor", "moved"), [(0.0, [1, 1]), (0.5, [0, 1]), (0.9, [0, 0])])
def test_spreads_at_or_below_the_floor_are_left_alone_and_the_means_moved_as_before(actor, floor, moved):
    actor = changed(actor, log_std=jnp.log(jnp.asarray([0.5, 0.8])))
    weights, config = weights_of(0.7, 1.3), ObjectiveConfig(std_floor=floor)
    both, told = gradient_of(actor, gated_of(), weights)
    gradient, metrics = jax.jit(partial(added_gradient, config=config))(actor, ROWS, gated_of(), weights)
    assert np.asarray(both.log_std).all()
    np.testing.assert_allclose(gradient.log_std, both.log_std * np.asarray(moved), rtol=1e-5)
    np.testing.assert_allclose(*(ravel_pytree(g.mlp)[0] for g in (gradient, both)), rtol=1e-4, atol=1e-6)
    assert float(metrics["kl_loss"]) == pytest.approx(float(told["kl_loss"]), rel=1e-5)


def test_weights_are_linear_and_switch_their_term_off(actor):
    def gradient(kl, aux):
        return np.asarray(ravel_pytree(gradient_of(actor, gated_of(), weights_of(kl, aux))[0])[0])

    kl, aux = gradient(1, 0), gradient(0, 1)
    np.testing.assert_allclose(gradient(0.5, 3), 0.5 * kl + 3 * aux, rtol=1e-4, atol=1e-5)
    assert np.linalg.norm(kl - aux) > 0.1
    assert not gradient(0, 0).any()


def test_what_the_gate_stops_counts_nowhere(actor):
    weights = weights_of(1.0, 1.0)
    half, none = gated_of((1, 1, 0, 0, 0)), gated_of((0, 0, 0, 0, 0))
    assert float(terms(actor, none, weights)[0]) == 0
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(gradient_of(actor, none, weights)[0]))
    poisoned = changed(half.proposals, actions=half.proposals.actions.at[2:].set(50.0))
    assert bits(terms(actor, GatedProposals(poisoned, half.gate), weights)) == bits(terms(actor, half, weights))
    opened = GatedProposals(poisoned, gated_of().gate)
    assert float(terms(actor, opened, weights)[0]) > 10 * float(terms(actor, half, weights)[0])


def test_no_gradient_reaches_the_proposals(actor):
    def loss(parts):
        gated = gated_of()
        gated = GatedProposals(changed(gated.proposals, actions=parts[0], proxy_mean=parts[1]), gated.gate)
        return proposal_terms(actor, gated, weights_of(1.0, 1.0))[0]

    proposals = gated_of().proposals
    gradient = jax.grad(loss)((proposals.actions, proposals.proxy_mean))
    assert not any(np.any(leaf) for leaf in gradient)


# --- the gate -----------------------------------------------------------------------------------------------------


STATES = numbers(4, 3, seed=8)
BATCH = Batch(jnp.asarray(200, jnp.int32), jnp.asarray(STATES), jnp.asarray([1.0, 1.0, 0.0, 1.0]), jnp.asarray(STATES))
STRANGE = STATES[3] + np.float32([0, 0, 1e-6])
CASES = [
    ("first row", 200, STATES[0], 1),
    ("last row", 203, STATES[3], 1),
    ("masked row", 202, STATES[2], 0),
    ("id before the batch, of an earlier iteration", 199, STATES[3], 0),
    ("id after the batch", 204, STATES[0], 0),
    ("id of the logs", -1, STATES[3], 0),
    ("id of an earlier iteration, the state of the row it had there", 100, STATES[0], 0),
    ("id of another row of the batch", 201, STATES[0], 0),
    ("its id, a state that is nearly its own", 203, STRANGE, 0),
]


def test_provenance_by_hand():
    ids = jnp.asarray([case[1] for case in CASES], jnp.int32)
    gate = provenance(ids, jnp.asarray(np.stack([case[2] for case in CASES])), BATCH)
    assert {case[0]: int(g) for case, g in zip(CASES, gate, strict=True)} == {case[0]: case[3] for case in CASES}


def test_admit_takes_the_weight_of_every_other_row_and_nothing_else():
    n = len(CASES)
    ids = jnp.asarray([case[1] for case in CASES], jnp.int32)
    states = jnp.asarray(np.stack([case[2] for case in CASES]))
    one, two = jnp.ones(n), jnp.ones((n, 2))
    rows = Rows(ids, states, states, two, one, two, one, one, one, 0.5 * one)
    admitted = admit(rows, BATCH)
    np.testing.assert_array_equal(admitted.weights, [0.5 * case[3] for case in CASES])
    assert bits(changed(admitted, weights=rows.weights)) == bits(rows)
    proposals = Proposals(ids, states, states, jnp.ones((n, K, 2)), two, two)
    np.testing.assert_array_equal(admit_proposals(proposals, BATCH).gate, [case[3] for case in CASES])


def test_a_stale_batch_is_refused_as_a_whole():
    ids = jnp.asarray([200, 201, 203], jnp.int32)
    states = jnp.asarray(STATES[[0, 1, 3]])
    assert np.asarray(provenance(ids, states, BATCH)).all()
    assert not np.asarray(provenance(ids, states, BATCH._replace(first_id=jnp.asarray(204, jnp.int32)))).any()


# --- advantage-weighted imitation -----------------------------------------------------------------------------------


def awr_rows(weights=(1, 1, 0, 1, 1), dtype=jnp.float32, **columns):
    """Rows whose actions, advantages and observations have no pattern."""
    made = {
        "observations": numbers(N, 3, seed=11),
        "actions": numbers(N, 2, seed=12),
        "advantages": numbers(N, seed=13),
    }
    made = {name: jnp.asarray(columns.get(name, value), dtype) for name, value in made.items()}
    return changed(ROWS, **made, weights=jnp.asarray(weights, dtype))


def awr_by_hand(actor, rows, temperature, cap):
    """Row by row, over those with weight; also the rows' importance."""
    kept = [i for i in range(N) if rows.weights[i] > 0]
    advantages = np.asarray(rows.advantages, np.float64)[kept]
    means, std = np.asarray(actor(rows.observations))[kept], np.exp(np.asarray(actor.log_std))
    importance = [min(np.exp((a - advantages.mean()) / advantages.std() / temperature), cap) for a in advantages]
    logs = norm.logpdf(np.asarray(rows.actions)[kept], means, std).sum(-1)
    return -np.mean(np.array(importance) * logs), np.array(importance)


awr = jax.jit(advantage_weighted_loss, static_argnums=(2, 3))


@pytest.mark.parametrize(("temperature", "cap", "capped"), [(1.0, 20.0, 0), (0.5, 2.0, 1), (0.1, 1e-3, 3)])
def test_advantage_weighted_imitation_by_hand(actor, temperature, cap, capped):
    rows = awr_rows()
    expected, importance = awr_by_hand(actor, rows, temperature, cap)
    assert (importance == cap).sum() >= capped
    assert (importance == cap).any() == (capped > 0)
    assert float(awr(actor, rows, temperature, cap)) == pytest.approx(expected, rel=1e-4)


def test_its_gradient_is_the_finite_difference_in_every_parameter(actor):
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), actor)
        flat, restore = ravel_pytree(wide)
        value = jax.jit(lambda p: advantage_weighted_loss(restore(p), awr_rows(dtype=jnp.float64), 0.7, 3.0))
        gradient, steps = jax.jit(jax.grad(value))(flat), 1e-5 * jnp.eye(len(flat))
        slopes = [float(value(flat + step) - value(flat - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(gradient, slopes, atol=1e-8)
    assert (np.asarray(gradient) != 0).all()


def test_rows_without_weight_have_no_influence_whatever_their_action_is(actor):
    gradient = jax.jit(jax.value_and_grad(advantage_weighted_loss), static_argnums=(2, 3))
    clean = gradient(actor, awr_rows(), 1.0, 20.0)
    for poison in (50.0, np.nan, np.inf):
        actions = np.array(awr_rows().actions)
        actions[2] = poison
        assert bits(gradient(actor, awr_rows(actions=actions), 1.0, 20.0)) == bits(clean)
    advantages = np.array(awr_rows().advantages)
    advantages[2] = 1e3
    np.testing.assert_allclose(awr(actor, awr_rows(advantages=advantages), 1.0, 20.0), clean[0], rtol=1e-6)
    # With weight it counts.
    actions[2] = 50.0
    assert bits(gradient(actor, awr_rows(actions=actions, weights=(1, 1, 1, 1, 1)), 1.0, 20.0)) != bits(clean)
    none = gradient(actor, awr_rows(weights=(0, 0, 0, 0, 0)), 1.0, 20.0)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(none))


def test_no_gradient_passes_through_the_advantages(actor):
    def loss(advantages):
        return advantage_weighted_loss(actor, changed(awr_rows(), advantages=advantages), 1.0, 20.0)

    advantages = awr_rows().advantages
    assert not np.any(jax.grad(loss)(advantages))
    assert abs(float(loss(advantages[::-1]) - loss(advantages))) > 1e-3  # they do matter


def test_without_proposals_it_is_all_that_is_added(actor):
    config = ObjectiveConfig(lambda_awr=0.3, awr_temperature=0.7, awr_weight_cap=3.0)
    weights, rows = Weights(*(jnp.float32(x) for x in (5.0, 7.0, 0.2))), awr_rows()
    expected, _ = awr_by_hand(actor, rows, 0.7, 3.0)
    loss, metrics = added_terms(actor, rows, (), weights, config=config)
    assert {name: float(value) for name, value in metrics.items()} == {"awr_loss": pytest.approx(expected, rel=1e-4)}
    # lambda_awr in the config says whether, the weight of this iteration how much.
    assert float(loss) == pytest.approx(0.2 * expected, rel=1e-4)
    both, metrics = added_terms(actor, rows, gated_of(), weights, config=config)
    alone, _ = added_terms(actor, rows, gated_of(), weights, config=ObjectiveConfig())
    assert float(both - alone) == pytest.approx(0.2 * expected, rel=1e-3)
    assert metrics.keys() == {"kl_loss", "aux_loss", "awr_loss"}
