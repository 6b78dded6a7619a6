"""PET: what moves, what it is drawn from, and how many steps it takes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import ACT, OBS, bits, small_denoiser
from ppo_dap.config import AdaptationConfig
from ppo_dap.dap.adaptation import ADAM, PETData, PETDraws, adapt, steps_until
from ppo_dap.dap.objective import Batch, provenance
from ppo_dap.nets.adapters import init_adapters

ROWS = 32
WEIGHTS = np.tile([1.0, 1.0, 1.0, 0.0], ROWS // 4)


@pytest.fixture(scope="module")
def states():
    return np.random.default_rng(0).standard_normal((ROWS, OBS)).astype(np.float32)


@pytest.fixture(scope="module")
def rows(states):
    actions = np.random.default_rng(1).uniform(-1, 1, (ROWS, ACT))
    parts = states, actions, WEIGHTS
    return PETData(jnp.arange(64, 64 + ROWS, dtype=jnp.int32), *(jnp.asarray(p, jnp.float32) for p in parts))


@pytest.fixture(scope="module")
def pet(states):
    """(rows, steps, kind) -> start, result of `adapt`; D_on is `states` with ids from 64 on.

    From step `changed` on the random numbers are others.
    """
    batch = Batch(jnp.asarray(64, jnp.int32), *map(jnp.asarray, (states, WEIGHTS.astype(np.float32), states)))
    config = AdaptationConfig(pet_minibatch_size=16, pet_learning_rate=1e-3)
    run = jax.jit(partial(adapt, config=config, check=lambda ids, seen: provenance(ids, seen, batch)))

    def adapted(rows, steps, kind="lora", changed=None):
        start = init_adapters(np.random.default_rng(1), small_denoiser(), kind, 2)
        draws = PETDraws.make(np.random.default_rng(2), small_denoiser(), 400, config)  # 40 steps
        if changed is not None:
            draws = jax.tree.map(lambda x: np.concatenate([x[:changed], 1 - x[changed:]]), draws)
        return start, run(small_denoiser(), start, ADAM.init(start), rows, draws, jnp.asarray(steps, jnp.int32))

    return adapted


@pytest.mark.parametrize("kind", ["lora", "bottleneck"])
def test_no_step_leaves_the_bits_and_steps_move_both_factors(pet, rows, kind):
    start, (same, optimizer, metrics) = pet(rows, 0, kind)
    assert bits(same) == bits(start)
    assert bits(optimizer) == bits(ADAM.init(start))
    assert {name: float(value) for name, value in metrics.items()} == {"pet_loss": 0, "pet_spr": 1}
    start, (moved, optimizer, metrics) = pet(rows, 5, kind)
    assert all(a != b for a, b in zip(bits(moved), bits(start), strict=True))  # every leaf: both factors, each layer
    assert int(optimizer.count) == 5
    assert float(metrics["pet_loss"]) > 0
    # Adam's step is at most a little above its rate: five steps of 1e-3.
    assert max(np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (moved, start)), strict=True)) < 6e-3


def test_only_adapters_come_back(pet, rows):
    """The backbone is an argument and nothing that is returned has its structure."""
    start, (adapters, optimizer, _) = pet(rows, 1)
    assert jax.tree.structure(adapters) == jax.tree.structure(start)
    assert jax.tree.structure(optimizer.mu) == jax.tree.structure(start)
    assert jax.tree.structure(optimizer.nu) == jax.tree.structure(start)


def test_each_step_uses_its_own_draws(pet, rows):
    (_, (plain, *_)), (_, (same, *_)), (_, (other, *_)) = (pet(rows, 3, changed=c) for c in (None, 3, 2))
    assert bits(same) == bits(plain)
    assert bits(other) != bits(plain)


def poisoned(rows, index):
    return PETData(rows.state_ids, rows.observations, rows.actions.at[index].set(jnp.nan), rows.weights)


def test_rows_without_weight_are_never_drawn(pet, rows):
    _, (clean, *_) = pet(rows, 40)
    _, (ignoring, *_) = pet(poisoned(rows, slice(3, None, 4)), 40)
    assert bits(ignoring) == bits(clean)
    for last in (0, 30):  # the first and the last row with weight are drawn
        _, (hit, *_) = pet(poisoned(rows, last), 40)
        assert not np.isfinite(hit.layers[0].up).all()


def test_pet_spr_is_the_worst_share_of_a_minibatch_from_d_on(pet, rows, states):
    assert float(pet(rows, 20)[1][2]["pet_spr"]) == 1
    logged = jnp.asarray(np.random.default_rng(5).standard_normal((8, OBS)), jnp.float32)
    with_logs = PETData(rows.state_ids, rows.observations.at[:8].set(logged), rows.actions, rows.weights)
    assert 0 < float(pet(with_logs, 20)[1][2]["pet_spr"]) < 0.75  # 6 of 24 rows: a mean share of 0.75
    stale = PETData(rows.state_ids - 64, rows.observations, rows.actions, rows.weights)
    assert float(pet(stale, 1)[1][2]["pet_spr"]) == 0


def test_pet_spr_of_fresh_rows_is_exactly_1_for_a_minibatch_whose_reciprocal_is_rounded(rows):
    config = AdaptationConfig(pet_minibatch_size=41)
    assert float(jax.jit(jnp.mean)(jnp.ones(41))) != 1  # the planted fault: what it must not be
    start = init_adapters(np.random.default_rng(1), small_denoiser(), "lora", 2)
    draws = PETDraws.make(np.random.default_rng(2), small_denoiser(), 10, config)
    run = jax.jit(partial(adapt, config=config, check=lambda ids, seen: jnp.ones(len(ids))))
    assert float(run(small_denoiser(), start, ADAM.init(start), rows, draws, jnp.asarray(1))[2]["pet_spr"]) == 1


@pytest.mark.parametrize(("frequency", "updates", "each"), [(10, 80, 8), (5, 80, 4), (100, 80, 80), (0, 80, 0)])
def test_steps_of_an_iteration(frequency, updates, each):
    totals = [steps_until(i, frequency, updates) for i in range(5)]
    assert np.diff(totals).tolist() == [each] * 4


@pytest.mark.parametrize(("frequency", "updates"), [(1, 80), (3, 7), (1, 1)])
def test_fractions_of_a_step_are_not_lost(frequency, updates):
    each = np.diff([steps_until(i, frequency, updates) for i in range(101)])
    assert each.sum() == frequency * updates  # f per 100 updates, over 100 iterations
    assert each.max() - each.min() <= 1


@pytest.mark.parametrize(("frequency", "updates"), [(10, 80), (0, 80), (1, 80), (3, 7), (1, 1), (7, 30)])
def test_every_step_has_draws_of_its_own(frequency, updates):
    most = max(np.diff([steps_until(i, frequency, updates) for i in range(101)]))
    config = AdaptationConfig(pet_frequency=frequency, pet_minibatch_size=4)
    draws = PETDraws.make(np.random.default_rng(0), small_denoiser(), updates, config)
    steps, *rest = draws.rows.shape
    assert steps >= most
    assert [x.shape for x in jax.tree.leaves(draws)] == [(steps, 4), (steps, 4), (steps, 4, ACT)]
    assert rest == [4]
    assert len(np.unique(draws.rows)) == draws.rows.size
