"""Q's part of step 4: what Q is regressed on, when it is judged, and the calibration that comes of it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import spearmanr

from dap.dap_made import ACT, OBS, bits, changed, filled, learner_of, small_config
from ppo_dap.dap.calibration import Calibration
from ppo_dap.dap.guide import Judged, OnPolicy, learn_q, recalibrated
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.update import draw_orders

ROWS, EPOCHS = 16, 1500
OPTIONS = {
    "num_envs": 4, "rollout_steps": ROWS, "minibatch_size": ROWS, "q_epochs": EPOCHS, "q_learning_rate": 1e-2,
    "q_hidden_size": 32, "q_calibration": "affine",
}  # fmt: skip
RNG = np.random.default_rng(0)
COLUMNS = {"td": RNG.normal(2, 1, ROWS), "gae": RNG.normal(-2, 1, ROWS), "advantage": RNG.normal(0, 1, ROWS)}
WEIGHTS = (np.arange(ROWS) % 4 != 3).astype(np.float32)
KEPT = WEIGHTS > 0


def f32(*arrays):
    return (jnp.asarray(a, jnp.float32) for a in arrays)


STATES, ACTIONS = f32(RNG.standard_normal((ROWS, OBS)), RNG.uniform(-1, 1, (ROWS, ACT)))
OLD, NEW = (filled(lambda rng: Critic.create(rng, OBS, 8), seed) for seed in (21, 22))
"""V before and after this iteration's PPO."""


def fresh_rows(**columns):
    td, gae, advantages = f32(*COLUMNS.values())
    ids = jnp.arange(ROWS, dtype=jnp.int32)
    rows = OnPolicy(ids, STATES, STATES, ACTIONS, td, jnp.asarray(WEIGHTS), advantages, gae)
    return changed(rows, **columns) if columns else rows


def guide_of(**options):
    config = small_config(**OPTIONS | options)
    return changed(learner_of(config).guide, q_rank=jnp.float32(0.5)), config


def q_values(q, critic):
    return np.asarray(q(critic.features(STATES), ACTIONS[:, None, :]))[:, 0]


def learned_on(**options):
    guide, config = guide_of(**options)
    stage = jax.jit(partial(learn_q, config=config))
    orders = draw_orders(np.random.default_rng(1), EPOCHS, ROWS)
    return guide, stage(guide, NEW, OLD, fresh_rows(), orders)


@pytest.fixture(scope="module", params=list(COLUMNS))
def learned(request):
    return request.param, *learned_on(q_target=request.param)


def test_q_is_regressed_on_the_column_that_it_is_told(learned):
    name, _, after = learned
    values = q_values(after.q, NEW)  # it learns with the features of the V that is there by then
    assert np.abs(values - COLUMNS[name])[KEPT].max() < 0.1
    for other in COLUMNS.keys() - {name}:
        assert np.abs(values - COLUMNS[other])[KEPT].mean() > 0.5
    # Rows without weight taught it nothing.
    assert np.abs(values - COLUMNS[name])[~KEPT].mean() > 0.2


def test_q_is_judged_before_it_learns_from_the_rows(learned):
    name, guide, after = learned
    before = q_values(guide.q, OLD)  # what it guided by: its old self on the features of the old V
    np.testing.assert_allclose(after.judged.values, before, atol=1e-5)
    np.testing.assert_array_equal(after.judged.targets, COLUMNS[name].astype(np.float32))
    np.testing.assert_array_equal(after.judged.weights, WEIGHTS)
    assert np.abs(before - q_values(after.q, NEW))[KEPT].mean() > 0.3
    # V is what GAE's returns are above its advantages; a Q that stands for advantages has no V to take off.
    ranked = before if name == "advantage" else before - (COLUMNS["gae"] - COLUMNS["advantage"])
    rank = spearmanr(ranked[KEPT], COLUMNS["advantage"][KEPT]).statistic
    assert float(after.metrics["q_rank"]) == pytest.approx(rank, abs=1e-5)
    assert float(after.q_rank) == pytest.approx(0.9 * 0.5 + 0.1 * rank, abs=1e-5)


def test_rows_of_another_ppo_have_no_advantages_to_judge_by():
    guide, config = guide_of(q_epochs=1)
    stage = jax.jit(partial(learn_q, config=config))
    rows, orders = (
        fresh_rows(advantages=None, returns=None),
        jnp.asarray(draw_orders(np.random.default_rng(1), 1, ROWS)),
    )
    after = stage(guide, NEW, OLD, rows, orders)
    assert after.metrics.keys() == {"q_loss"}
    assert bits(after.judged) == bits(guide.judged)
    assert float(after.q_rank) == 0.5
    for target in ("gae", "advantage"):
        other, config = guide_of(q_epochs=1, q_target=target)
        with pytest.raises(ValueError, match=f"without advantages cannot give the q_target '{target}'"):
            learn_q(other, NEW, OLD, rows, orders, config=config)


def judged_guide(weights):
    """A guide that said 0 to 15 where it should have said 3 - those that have weight - half as much plus 1."""
    guide, config = guide_of()
    values = np.arange(ROWS)
    targets = np.where(KEPT, 0.5 * values + 1, 1e6)
    return changed(guide, judged=Judged(*f32(values, targets, weights))), config


def test_the_calibration_is_fitted_on_the_rows_with_weight():
    guide, config = judged_guide(WEIGHTS)
    asked = jnp.asarray([[-20.0, 0.0, 3.0, 40.0]])
    after = recalibrated(guide, config.q)
    np.testing.assert_allclose(after.calibration(asked), 0.5 * np.asarray(asked) + 1, rtol=1e-4, atol=1e-4)
    assert bits(changed(after, calibration=guide.calibration)) == bits(guide)
    # With weight, the others would have turned the line.
    everything = recalibrated(judged_guide(np.ones(ROWS))[0], config.q)
    assert np.abs(np.asarray(everything.calibration(asked)) - 0.5 * np.asarray(asked) - 1).min() > 100


def test_it_is_the_identity_before_the_first_iteration_and_none_when_switched_off():
    guide, config = guide_of()
    first = recalibrated(guide, config.q)
    assert bits(first) == bits(guide)
    assert bits(first.calibration) == bits(Calibration.identity())
    assert first.judged.values.shape == (ROWS,)
    off, config = guide_of(q_calibration="none")
    assert (off.calibration, off.judged) == (None, None)
    assert recalibrated(off, config.q) is off
