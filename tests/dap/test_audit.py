"""Definition 1's audits: every claim holds on the update as it is, and each planted fault fires the claim it breaks."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import (
    ACT,
    DIFFUSION,
    NORMALISER,
    OBS,
    REWARD_STD,
    ROWS,
    changed,
    iterated,
    learner_of,
    parts_of,
    quick_stages,
    rollout_of,
    schedule_of,
    small_config,
    with_fault,
)
from ppo_dap.dap import audit, guide, objective
from ppo_dap.dap.dataflow import Flow
from ppo_dap.dap.objective import proposal_terms
from ppo_dap.training import proof
from ppo_dap.training.algorithm import Stages, iterate
from ppo_dap.training.draws import draw

RATIO, ADVANTAGES, V, PET, POLICY, REST = [row[1] for row in audit.FORBIDDEN]
FRESH = "every row of the actor update is of the current batch (share)"
RATIO_1 = "ratio is 1 at the first minibatch (largest error)"
SPR, PET_SPR, OGLR = "SPR, smallest", "share of PET rows from the current batch, smallest", "OGLR, largest"


def logged(rows, probe):
    """`rows` whose first 16 are rows of the logs, under ids of D_on."""
    n = len(probe.actions)
    observations = rows.raw_observations.at[:n].set(probe.raw_observations)
    actions = rows.actions.at[:n].set(probe.actions)
    return changed(rows, raw_observations=observations, observations=observations, actions=actions)


def replaced(arguments, position, value):
    return *arguments[:position], value, *arguments[position + 1 :]


def tamper(stage_name, edit):
    """A fault that edits the arguments of one stage: `edit(arguments, seen, frozen)` returns the new ones."""

    def fault(name, stage, arguments, seen, frozen):
        return stage(*(edit(arguments, seen, frozen) if name == stage_name else arguments))

    return fault


def proposals_of(seen):
    return seen["gate"][1][0].proposals


def offline_rows_in_the_actor_loss(arguments, seen, frozen):
    return replaced(arguments, 2, logged(arguments[2], frozen.probe))


def offline_rows_among_the_proposals(arguments, seen, frozen):
    gated = arguments[3]
    proposals = changed(gated.proposals, actions=gated.proposals.actions.at[:, 0].set(frozen.probe.actions))
    return replaced(arguments, 3, changed(gated, proposals=proposals))


def proposals_in_the_ratio(arguments, seen, frozen):
    actions = proposals_of(seen).actions[:, 0]
    return replaced(arguments, 2, changed(arguments[2], actions=arguments[2].actions.at[: len(actions)].set(actions)))


def advantages_from_rewards_of_proposals(arguments, seen, frozen):
    (critic, parts, *rest), _ = seen["advantages"]
    bonus = jnp.mean(proposals_of(seen).proxy_mean)
    parts = [changed(part, rewards=part.rewards + bonus) for part in parts]
    rows, _, _ = seen["stages"].advantages(critic, parts, *rest)
    return replaced(arguments, 2, rows)


def advantages_plus_a_bonus_of_proposals(arguments, seen, frozen):
    bonus = jnp.mean(proposals_of(seen).proxy_mean)
    return replaced(arguments, 2, changed(arguments[2], advantages=arguments[2].advantages + bonus))


def returns_of_proposals(arguments, seen, frozen):
    bonus = jnp.mean(proposals_of(seen).proxy_mean)
    return replaced(arguments, 2, changed(arguments[2], returns=arguments[2].returns + bonus))


def logged_rows_for(position):
    return lambda arguments, seen, frozen: replaced(arguments, position, logged(arguments[position], frozen.probe))


def offline_moments_in_the_optimizer(name, stage, arguments, seen, frozen):
    result = stage(*arguments)
    if name != "actor":
        return result
    actor, optimizer, metrics = result
    moments = jax.tree.map(lambda x: x + jnp.mean(frozen.probe.actions), optimizer.mu)
    return actor, optimizer._replace(mu=moments), metrics


STATIC_FAULTS = {
    "offline rows in the actor loss": (tamper("actor", offline_rows_in_the_actor_loss), {RATIO, POLICY, REST}),
    "offline actions among the proposals": (tamper("actor", offline_rows_among_the_proposals), {POLICY, REST}),
    "proposals in the ratio": (tamper("actor", proposals_in_the_ratio), {RATIO}),
    "advantages of rewards that proposals changed": (
        tamper("actor", advantages_from_rewards_of_proposals),
        {ADVANTAGES},
    ),
    "advantages that proposals changed": (tamper("actor", advantages_plus_a_bonus_of_proposals), {ADVANTAGES}),
    "V's targets that proposals changed": (tamper("critic", returns_of_proposals), {V}),
    "logged rows in V's loss": (tamper("critic", logged_rows_for(2)), {V, REST}),
    "logged rows in PET": (tamper("adapt", logged_rows_for(2)), {PET, REST}),
    "logged rows in Q's loss": (tamper("learn_q", logged_rows_for(2)), {REST}),
    "logs in the optimizer's moments": (offline_moments_in_the_optimizer, {REST}),
}


@pytest.fixture(scope="module")
def traceable(config):
    """The stages as a run has them; they are traced and never compiled."""
    return Stages(config, DIFFUSION)


def violated(claims):
    return {claim.statement for claim in claims if not claim.holds}


def proved(learner, frozen, config, stages, fault=None):
    with pytest.MonkeyPatch.context() as patch:
        if fault is not None:
            patch.setattr(proof, "iterate", with_fault(fault))
        return proof.prove(learner, frozen, config, stages)


def test_every_static_claim_holds_without_a_fault(learner, frozen, config, traceable):
    claims = proved(learner, frozen, config, traceable)
    assert [(claim.clause, claim.statement) for claim in claims] == [row[:2] for row in audit.FORBIDDEN]
    assert violated(claims) == set()
    # The hook that the faults are planted with changes nothing by itself.
    harmless = proved(
        learner, frozen, config, traceable, lambda name, stage, arguments, seen, frozen: stage(*arguments)
    )
    assert [str(claim) for claim in harmless] == [str(claim) for claim in claims]


def test_plain_ppo_is_proved_too(config):
    claims = proof.prove(learner_of(config, guided=False), None, config, Stages(config, None))
    assert {claim.statement for claim in claims} == {RATIO, ADVANTAGES, V, POLICY, REST}
    assert violated(claims) == set()


@pytest.mark.parametrize(
    "name",
    [pytest.param(name) for name in STATIC_FAULTS],
)
def test_a_planted_leak_fires_its_static_claims_and_no_other(learner, frozen, config, traceable, name):
    fault, expected = STATIC_FAULTS[name]
    assert violated(proved(learner, frozen, config, traceable, fault)) == expected


def test_evidence_names_what_arrived(learner, frozen, config, traceable):
    claims = proved(learner, frozen, config, traceable, tamper("critic", logged_rows_for(2)))
    (claim,) = [claim for claim in claims if claim.statement == V]
    assert str(claim) == f"VIOLATED (i)    {V}: reached by offline"


def test_qs_gradient_in_vs_trunk_is_found(frozen):
    shared = small_config(q_trunk="shared")
    assert violated(proved(learner_of(shared), frozen, shared, Stages(shared, DIFFUSION))) == {V}


def actor_gradient_into_the_prior(name, stage, arguments, seen, frozen):
    """PET's result less the actor loss's gradient in the adapters, which the code blocks."""
    result = stage(*arguments)
    if name != "adapt":
        return result
    (state, *inputs), _ = seen["propose"]
    (_, _, batch), _ = seen["gate"]
    _, (actor, _, _) = seen["actor"]
    weights = objective.Weights(jnp.float32(1), jnp.float32(1))

    def actor_loss(adapters):
        proposed = seen["stages"].propose(changed(state, adapters=adapters), *inputs)
        gated, *_ = seen["stages"].gate(state, [proposed], batch)
        return proposal_terms(actor, gated, weights)[0]

    gradient = jax.grad(actor_loss)(state.adapters)
    return jax.tree.map(lambda a, g: a - g, result[0], gradient), *result[1:]


def test_an_unblocked_gradient_into_the_prior_is_found(learner, frozen, config, traceable, monkeypatch):
    fault = actor_gradient_into_the_prior
    # Blocked: the gradient is nothing at all.
    assert violated(proved(learner, frozen, config, traceable, fault)) == set()
    monkeypatch.setattr(jax.lax, "stop_gradient", lambda x: x)
    claims = proved(learner, frozen, config, Stages(config, DIFFUSION), fault)
    assert violated(claims) == {PET}
    (evidence,) = [claim.evidence for claim in claims if claim.statement == PET]
    assert {"actor", "q", "proposals"} <= {*evidence.removeprefix("reached by ").split(", ")}


def test_a_program_in_which_the_tags_are_missing_proves_nothing():
    claims = audit.static_claims(Flow({}, {}), Flow({}, {}))
    assert violated(claims) == {RATIO, ADVANTAGES, V, POLICY, REST}


# --- measured ----------------------------------------------------------------------------------------------------


def measured(learner, frozen, stages, fault=None, iterations=(0,), rollout=rollout_of):
    """Metrics of iterations that all start from `learner`."""
    run = iterate if fault is None else with_fault(fault)
    rows = []
    for i in iterations:
        given = rollout(learner.ppo.actor, i)
        _, metrics = iterated(run, learner, frozen, given, schedule_of(i), stages, small_config(), i)
        rows.append({name: float(value) for name, value in metrics.items()})
    return rows


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
    monkeypatch.setattr(objective, "provenance", lambda ids, states, batch: jnp.ones(len(ids)))
    open_stages = copy.copy(stages)
    open_stages.leakage = quick_stages(small_config()).leakage
    (row,) = measured(learner, frozen, open_stages)
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
    leaking = copy.copy(stages)
    leaking.propose = quick_stages(small_config()).propose
    rows = measured(learner, frozen, leaking)
    assert violated(audit.measured_claims(rows)) == {SPR}
    assert rows[0]["spr"] == 0.5


def test_logged_rows_in_pet_are_found(learner, frozen, stages):
    rows = measured(learner, frozen, stages, tamper("adapt", logged_rows_for(2)))
    assert violated(audit.measured_claims(rows)) == {PET_SPR}
    assert 0 < rows[0]["pet_spr"] < 1


def test_spr_is_1_when_every_state_gets_proposals(frozen):
    everything = small_config(proposal_fraction=1.0)
    learner, stages = learner_of(everything), quick_stages(everything)
    rollout, draws = rollout_of(learner.ppo.actor), draw(everything, 0, ACT, True)
    assert not rollout.valid.all()
    parts, critic = parts_of(rollout, everything), learner.ppo.critic
    rows, batch, _ = stages.advantages(critic, parts, NORMALISER, REWARD_STD, jnp.int32(0))
    assert len(rows.weights) == ROWS
    proposed = [
        stages.propose(learner.guide, frozen.denoiser, critic, part, NORMALISER, jnp.float32(1), numbers)
        for part, numbers in zip(parts, draws.proposals, strict=True)
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
