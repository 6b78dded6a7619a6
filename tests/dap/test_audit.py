"""What every iteration measures of Definition 1, the faults that show in it, and the verdict on what was logged."""

import copy

import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import (
    ACT,
    NORMALISER,
    OBS,
    REWARD_STD,
    ROWS,
    changed,
    iterated,
    learner_of,
    logged_rows_for,
    parts_of,
    rollout_of,
    schedule_of,
    small_config,
    tamper,
    violated,
    with_fault,
)
from ppo_dap.dap import audit, guide, objective
from ppo_dap.training.algorithm import Stages, iterate
from ppo_dap.training.draws import draw

FRESH = "every row of the actor update is of the current batch (share)"
RATIO_1 = "ratio is 1 at the first minibatch (largest error)"
SPR, PET_SPR, OGLR = "SPR, smallest", "share of PET rows from the current batch, smallest", "OGLR, largest"


def measured(learner, frozen, stages, fault=None, iterations=(0,), rollout=rollout_of):
    """Metrics of iterations that all start from `learner`."""
    run = iterate if fault is None else with_fault(fault)
    rows = []
    for i in iterations:
        given = rollout(learner.ppo.actor, i)
        _, metrics = iterated(run, learner, frozen, given, schedule_of(i), stages, small_config(), i)
        rows.append({name: float(value) for name, value in metrics.items()})
    return rows


def again(stages, name):
    """`stages` with the one of that name traced anew: what was patched since is in it."""
    leaking = copy.copy(stages)
    setattr(leaking, name, getattr(Stages(small_config(), guided=True), name))
    return leaking


def test_without_a_fault_every_measured_claim_holds(learner, frozen, stages):
    metrics = measured(learner, frozen, stages, iterations=(0, 1, 5))
    claims = audit.measured_claims(metrics)
    assert [claim.statement for claim in claims] == [FRESH, RATIO_1, SPR, PET_SPR, OGLR]
    assert violated(claims) == set()
    for row in metrics:
        assert row["oglr"] == 0
        assert row["oglr_ungated"] > 1e-3
        assert row["spr"] == row["pet_spr"] == row["batch_fresh"] == 1
        assert row["ratio_error"] < 1e-5
        assert 0 < row["pgshare"] < 10
    assert all(np.isfinite([*row.values()]).all() for row in metrics)


def test_pgshare_is_ppos_gradient_over_the_actors(learner, frozen, stages, config):
    """One minibatch step with weights so small that the share is 1, then so large that it is nearly 0."""
    shares = []
    for weight in (0.0, 1e-9, 1e6):
        schedule = schedule_of(lambda_kl=weight, lambda_aux=weight)
        rollout = rollout_of(learner.ppo.actor)
        metrics = iterated(iterate, learner, frozen, rollout, schedule, stages, config)[1]
        shares.append(float(metrics["pgshare"]))
    assert shares[:2] == pytest.approx([1, 1], rel=1e-4)
    assert shares[2] < 1e-4


def test_an_open_gate_shows_in_oglr(learner, frozen, stages, monkeypatch):
    monkeypatch.setattr(objective, "provenance", lambda ids, *_: jnp.ones(len(ids)))
    (row,) = measured(learner, frozen, again(stages, "leakage"))
    assert violated(audit.measured_claims([row])) == {OGLR}
    assert row["oglr"] == pytest.approx(row["oglr_ungated"], rel=1e-5)


def test_a_stale_batch_is_found(learner, frozen, stages):
    clean = measured(learner, frozen, stages)
    stale = measured(learner, frozen, stages, iterations=(3,), rollout=lambda actor, i: rollout_of(actor, i - 1))
    assert violated(audit.measured_claims(clean + stale)) == {FRESH, SPR, PET_SPR}
    assert stale[0]["batch_fresh"] == stale[0]["spr"] == stale[0]["pet_spr"] == stale[0]["policy_kl"] == 0


def test_a_batch_of_an_older_policy_under_new_ids_is_found(learner, frozen, stages):
    def of_an_older_policy(actor, iteration):
        return rollout_of(changed(actor, log_std=actor.log_std - 0.1), iteration)

    rows = measured(learner, frozen, stages, rollout=of_an_older_policy)
    assert violated(audit.measured_claims(rows)) == {RATIO_1}


def test_offline_rows_in_the_batch_have_no_weight_and_show(learner, frozen, stages):
    def mixed(actor, iteration):
        rollout = rollout_of(actor, iteration)
        return changed(rollout, state_ids=rollout.state_ids.at[:4].set(-1))

    rows = measured(learner, frozen, stages, rollout=mixed)
    assert FRESH in violated(audit.measured_claims(rows))
    valid = np.asarray(rollout_of(learner.ppo.actor).valid)
    assert rows[0]["batch_fresh"] == pytest.approx(valid[4:].sum() / valid.sum())


@pytest.mark.parametrize("keep_id", [True, False])
def test_proposals_for_states_outside_d_on_are_found(learner, frozen, stages, monkeypatch, keep_id):
    """Half the proposals are for states of the logs, under the ids of D_on's states or under ids of their own."""
    real = guide.States

    def half_logged(ids, raw, observations, features):
        half = len(ids) // 2
        raw = raw.at[:half].set(frozen.probe.raw_observations[:half])
        return real(ids if keep_id else ids.at[:half].set(-1), raw, observations, features)

    monkeypatch.setattr(guide, "States", half_logged)
    rows = measured(learner, frozen, again(stages, "propose"))
    assert violated(audit.measured_claims(rows)) == {SPR}
    assert rows[0]["spr"] == 0.5


def test_proposals_that_the_policy_imitates_on_other_states_are_found(learner, frozen, stages, monkeypatch):
    """The prior sees the states that the ids name; what the policy sees beside its proposals is other rows of D_on."""
    real = guide.States

    def shifted(ids, raw, observations, features):
        return real(ids, raw, jnp.roll(observations, 1, axis=0), features)

    monkeypatch.setattr(guide, "States", shifted)
    rows = measured(learner, frozen, again(stages, "propose"))
    assert violated(audit.measured_claims(rows)) == {SPR}
    assert rows[0]["spr"] == 0


def test_logged_rows_in_pet_are_found(learner, frozen, stages):
    rows = measured(learner, frozen, stages, tamper("adapt", logged_rows_for(2)))
    assert violated(audit.measured_claims(rows)) == {PET_SPR}
    assert 0 < rows[0]["pet_spr"] < 1


def test_spr_is_1_when_every_state_gets_proposals(frozen):
    everything = small_config(proposal_fraction=1.0)
    learner, stages = learner_of(everything), Stages(everything, guided=True)
    rollout, draws = rollout_of(learner.ppo.actor), draw(everything, 0, frozen.prior)
    assert not rollout.valid.all()
    parts, critic = parts_of(rollout, everything), learner.ppo.critic
    rows, batch, _ = stages.advantages(critic, parts, NORMALISER, REWARD_STD, jnp.int32(0))
    assert len(rows.weights) == ROWS
    proposer = learner.guide.proposer(frozen.prior, frozen.condition, critic, None)
    proposed = [
        stages.propose(proposer, x.state_ids, x.observations, x.valid, NORMALISER, jnp.float32(1), numbers)
        for x, numbers in zip(parts, draws.proposals, strict=True)
    ]
    gated, _, metrics = stages.gate(learner.guide, proposed, batch)
    assert sorted(gated.proposals.state_ids.tolist()) == list(range(ROWS))
    np.testing.assert_array_equal(gated.gate, rollout.valid.ravel()[gated.proposals.state_ids])
    assert gated.proposals.observations.shape[1:] == (OBS,)
    assert gated.proposals.actions.shape[2:] == (ACT,)
    assert float(metrics["spr"]) == 1


# --- the verdict on what was logged ------------------------------------------------------------------------------

GOOD = {"batch_fresh": 1.0, "ratio_error": 1e-6, "spr": 1.0, "pet_spr": 1.0, "oglr": 0.0}


@pytest.mark.parametrize(
    ("name", "value", "statement"),
    [
        ("batch_fresh", 0.999, FRESH),
        ("ratio_error", 2e-3, RATIO_1),
        ("spr", 0.999, SPR),
        ("pet_spr", 0.999, PET_SPR),
        ("oglr", 1e-9, OGLR),
    ],
)
def test_one_bad_iteration_is_enough(name, value, statement):
    assert violated(audit.measured_claims([GOOD] * 3)) == set()
    for place in range(3):
        rows = [dict(GOOD) for _ in range(3)]
        rows[place][name] = value
        assert violated(audit.measured_claims(rows)) == {statement}


def test_ppo_is_only_held_to_what_it_logs():
    row = {"batch_fresh": 1.0, "ratio_error": 0.0, "return_train": None}
    claims = audit.measured_claims([row], guided=False)
    assert [claim.statement for claim in claims] == [FRESH, RATIO_1]
    assert not violated(claims)
    assert violated(audit.measured_claims([row])) == {SPR, PET_SPR, OGLR}  # a guided run that logged no more


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("place", [0, 1])
def test_a_metric_that_is_no_number_does_not_pass(name, place):
    rows = [dict(GOOD), dict(GOOD)]
    rows[place][name] = float("nan")
    assert len(violated(audit.measured_claims(rows))) == 1


def test_an_iteration_without_a_row_is_not_passed_over():
    rows = [dict(GOOD, iteration=i, env_steps=10 * i) for i in range(1, 6)]
    assert audit.every_iteration(rows, 50) == audit.every_iteration(rows, 0) == rows
    for gone, steps in (([2], 50), ([0], 50), ([4], 50), ([1, 3], 0)):
        left = audit.every_iteration([row for i, row in enumerate(rows) if i not in gone], steps)
        assert left.count({}) == len(gone)
        assert violated(audit.measured_claims(left)) == {FRESH, RATIO_1, SPR, PET_SPR, OGLR}
    assert audit.every_iteration([], 10) == [{}]
    # Rows that are there twice, or in another order, are all looked at.
    bad = dict(rows[2], spr=0.5)
    assert violated(audit.measured_claims(audit.every_iteration([*rows[:3], bad, *rows[3:]], 50))) == {SPR}
    assert {} in audit.every_iteration([rows[0], rows[2], rows[1], *rows[3:]], 50)


def test_what_was_proved_before_a_run_was_cut_off_still_counts():
    holds, broken = (audit.Claim("(i)", "V", value, "") for value in (True, False))
    other = audit.Claim("(iv)", "logs", True, "")
    assert audit.both([holds, other], [broken]) == audit.both([broken, other], [holds]) == [broken, other]
    assert audit.both([], [holds, other]) == audit.both([holds], [holds, other]) == [holds, other]


def test_a_clause_without_a_proof_does_not_hold():
    proofs = [audit.Claim(clause, "", True, "") for clause in ("(i)", "(iv)")]
    assert audit.require_proofs(proofs) == proofs
    for kept in ([], proofs[:1], proofs[1:]):
        found = audit.require_proofs(kept)
        assert [claim.clause for claim in found] == [p.clause for p in kept] + [
            p.clause for p in proofs if p not in kept
        ]
        assert violated(found) == {"a proof on the traced update"}
