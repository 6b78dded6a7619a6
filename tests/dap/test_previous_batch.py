"""A previous batch is used again: Definition 1 says so, statically and in what is measured, and for PPO-ARC alone."""

import copy

import jax
import numpy as np
import pytest

from dap.dap_made import (
    bits,
    iterated,
    learner_of,
    rollout_of,
    schedule_of,
    small_config,
    small_denoiser,
    violated,
)
from ppo_dap.dap import audit
from ppo_dap.training.algorithm import Stages, iterate
from ppo_dap.training.draws import draw
from ppo_dap.training.proof import prove

RATIO, ADVANTAGES, LESS = [row[1] for row in audit.FORBIDDEN[:3]]
ARC = small_config(reuse_batches=1, contest_kl_weight=0.0)
FRESH = audit.MEASURED[0][1]


@pytest.fixture(scope="module")
def arc_stages():
    return Stages(ARC, guided=False)


def iteration(learner, stages, number, config=ARC):
    rollout = rollout_of(learner.ppo.actor, number)
    schedule = schedule_of(number, guided=False)
    learner, metrics = iterated(iterate, learner, None, rollout, schedule, stages, config, number)
    return learner, {name: float(value) for name, value in metrics.items()}


@pytest.mark.parametrize("guided", [False, True])
def test_a_reused_batch_violates_the_claims_on_ppos_gradient_and_no_other(frozen, guided):
    stages = Stages(ARC, guided=guided)
    claims = prove(learner_of(ARC, guided), frozen if guided else None, ARC, stages)
    assert violated(claims) == {RATIO, ADVANTAGES, LESS}
    broken = [claim for claim in claims if not claim.holds]
    assert {claim.clause for claim in broken} == {"(i)"}
    assert {claim.evidence for claim in broken} == {"reached by previous"}


@pytest.mark.parametrize("surrogate", ["clip", "authentic_boundary", "generalised_clip"])
def test_without_reuse_every_claim_holds_whatever_the_surrogate(surrogate):
    config = small_config(surrogate=surrogate)
    claims = prove(learner_of(config, guided=False), None, config, Stages(config, guided=False))
    assert len(claims) == 7
    assert violated(claims) == set()


@pytest.mark.as_shipped
def test_the_first_iteration_is_ppos_bit_for_bit(arc_stages):
    plain = small_config()
    ppo_stages = copy.copy(arc_stages)
    ppo, ppo_metrics = iteration(learner_of(plain, guided=False), ppo_stages, 0, plain)
    arc, metrics = iteration(learner_of(ARC, guided=False), arc_stages, 0)
    assert bits(arc.ppo) == bits(ppo)
    assert ppo.previous is None
    assert metrics["arc_reused"] == 0
    assert {name: metrics[name] for name in ppo_metrics} == ppo_metrics
    # The batch is kept, as it was collected.
    assert bits(arc.previous) == bits(rollout_of(learner_of(ARC, guided=False).ppo.actor, 0))


def test_the_share_of_fresh_rows_falls_where_the_old_ones_won(arc_stages):
    learner, rows, old_valid = learner_of(ARC, guided=False), [], None
    for number in range(12):
        actor = learner.ppo.actor
        learner, metrics = iteration(learner, arc_stages, number)
        valid = np.asarray(rollout_of(actor, number).valid).sum()
        expected = valid / (valid + old_valid) if metrics["arc_reused"] else 1
        assert metrics["batch_fresh"] == pytest.approx(expected)
        assert all(np.isfinite([*metrics.values()]))
        rows.append(metrics)
        old_valid = valid
    won = {row["arc_reused"] for row in rows}
    assert won == {0, 1}
    for row in rows:
        assert violated(audit.measured_claims([row], guided=False)) == ({FRESH} if row["arc_reused"] else set())


def test_the_second_candidates_orders_leave_every_other_draw_as_it_was(config):
    for guided in (False, True):
        plain, arc = (draw(c, 3, small_denoiser() if guided else None) for c in (config, small_config(reuse_batches=1)))
        assert plain.reuse == ()
        assert bits(arc._replace(reuse=())) == bits(plain)
        assert jax.tree.map(np.shape, arc.reuse) == jax.tree.map(np.shape, arc.actor)
        assert np.any(np.asarray(arc.reuse.rows) != np.asarray(arc.actor.rows))
        assert bits(draw(small_config(reuse_batches=1), 3, small_denoiser() if guided else None)) == bits(arc)
