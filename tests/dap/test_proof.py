"""The static proof: every claim holds on the update as it is, and each planted leak fires the claims it breaks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import (
    changed,
    learner_of,
    logged,
    logged_rows_for,
    replaced,
    small_config,
    tamper,
    violated,
    with_fault,
)
from ppo_dap.dap import audit, objective
from ppo_dap.dap.dataflow import Flow
from ppo_dap.dap.objective import proposal_terms
from ppo_dap.training import proof
from ppo_dap.training.algorithm import Stages

RATIO, ADVANTAGES, LESS, V, ALONE, PET, POLICY, REST = [row[1] for row in audit.FORBIDDEN]
OF_PPO = {RATIO, ADVANTAGES, LESS, V, ALONE, POLICY, REST}


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


def offline_moments_in_the_optimizer(name, stage, arguments, seen, frozen):
    result = stage(*arguments)
    if name != "actor":
        return result
    actor, optimizer, metrics = result
    moments = jax.tree.map(lambda x: x + jnp.mean(frozen.probe.actions), optimizer.mu)
    return actor, optimizer._replace(mu=moments), metrics


def moments_of_another(stage_name, of):
    """A fault: what `of(seen)` gives is added to the optimizer's moments, which nothing but the next iteration sees."""

    def fault(name, stage, arguments, seen, frozen):
        result = stage(*arguments)
        if name != stage_name:
            return result
        moments = jax.tree.map(lambda x: x + of(seen), result[1].mu)
        return result[0], result[1]._replace(mu=moments), *result[2:]

    return fault


def q_of(seen):
    return jnp.mean(seen["propose"][0][0].q.heads[0].action.weight)


def q_in_the_weights_of_the_policy(arguments, seen, frozen):
    return replaced(arguments, 0, jax.tree.map(lambda x: x + 1e-3 * q_of(seen), arguments[0]))


def setting(name, of):
    """An edit: a number of the actor's settings is multiplied by what `of(arguments, seen)` gives."""

    def edit(arguments, seen, frozen):
        settings = arguments[5]
        return replaced(arguments, 5, settings._replace(**{name: getattr(settings, name) * of(arguments, seen)}))

    return edit


def weights_that_q_trusts(arguments, seen, frozen):
    weights = arguments[5].added_weights
    weights = weights._replace(lambda_aux=weights.lambda_aux * seen["propose"][0][0].q_rank)
    return replaced(arguments, 5, arguments[5]._replace(added_weights=weights))


def returns_of_the_actors_moments(arguments, seen, frozen):
    bonus = jnp.mean(seen["actor"][1][1].mu.log_std)
    return replaced(arguments, 2, changed(arguments[2], returns=arguments[2].returns + bonus))


def closed_over(arguments, seen, frozen):
    """Logs that are no argument of the update, but a closure of one of its stages."""
    logs, rows = np.ones((16, 2), np.float32), arguments[2]
    actions = jax.jit(lambda actions: actions.at[:16].set(logs))(rows.actions)
    return replaced(arguments, 2, changed(rows, actions=actions))


def called_back(arguments, seen, frozen):
    bonus = jax.pure_callback(lambda: np.float32(1), jax.ShapeDtypeStruct((), jnp.float32))
    return replaced(arguments, 2, changed(arguments[2], advantages=arguments[2].advantages + bonus))


STATIC_FAULTS = {
    "offline rows in the actor loss": (tamper("actor", offline_rows_in_the_actor_loss), {RATIO, LESS, POLICY, REST}),
    "offline actions among the proposals": (tamper("actor", offline_rows_among_the_proposals), {POLICY, REST}),
    "proposals in the ratio": (tamper("actor", proposals_in_the_ratio), {RATIO, LESS}),
    "advantages of rewards that proposals changed": (
        tamper("actor", advantages_from_rewards_of_proposals),
        {ADVANTAGES, LESS},
    ),
    "advantages that proposals changed": (tamper("actor", advantages_plus_a_bonus_of_proposals), {ADVANTAGES, LESS}),
    "V's targets that proposals changed": (tamper("critic", returns_of_proposals), {V}),
    "logged rows in V's loss": (tamper("critic", logged_rows_for(2)), {V, REST}),
    "logged rows in PET": (tamper("adapt", logged_rows_for(2)), {PET, REST}),
    "logged rows in Q's loss": (tamper("learn_q", logged_rows_for(3)), {REST}),
    "logs in the optimizer's moments": (offline_moments_in_the_optimizer, {LESS, POLICY, REST}),
    "Q in the moments of V's optimizer": (moments_of_another("critic", q_of), {V}),
    "proposals in the moments of PET's optimizer": (
        moments_of_another("adapt", lambda seen: jnp.mean(proposals_of(seen).proxy_mean)),
        {PET},
    ),
    "moments of the actor's optimizer in V's targets": (tamper("critic", returns_of_the_actors_moments), {V}),
    "Q in the policy's weights": (tamper("actor", q_in_the_weights_of_the_policy), {LESS, ALONE}),
    "a learning rate by proposals": (
        tamper("actor", setting("learning_rate", lambda arguments, seen: jnp.mean(arguments[3].proposals.proxy_std))),
        {LESS},
    ),
    "a KL limit by Q": (
        tamper("actor", setting("kl_limit", lambda arguments, seen: seen["propose"][0][0].q_rank)),
        {LESS, ALONE},
    ),
    "weights of Eq. 9 by Q": (tamper("actor", weights_that_q_trusts), {ALONE}),
    "rows that a stage closes over": (tamper("actor", closed_over), {RATIO, LESS, ALONE, POLICY, REST}),
    "what a callback returns": (tamper("actor", called_back), {ADVANTAGES, LESS, ALONE, POLICY, REST}),
}


@pytest.fixture(scope="module")
def traceable(config):
    """The stages as a run has them; they are traced and never compiled."""
    return Stages(config, guided=True)


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
    claims = proof.prove(learner_of(config, guided=False), None, config, Stages(config, guided=False))
    assert {claim.statement for claim in claims} == OF_PPO
    assert violated(claims) == set()


def test_plain_ppo_with_advantage_weighted_imitation_is_proved_too():
    config = small_config(lambda_awr=0.1)
    arguments = learner_of(config, guided=False), None, config, Stages(config, guided=False)
    claims = proof.prove(*arguments)
    assert {claim.statement for claim in claims} == OF_PPO
    assert violated(claims) == set()
    assert Stages(config, guided=False).adds
    assert not Stages(small_config(), guided=False).adds


def test_a_leak_is_found_with_advantage_weighted_imitation_too(frozen):
    config = small_config(lambda_awr=0.1)
    stages, learner = Stages(config, guided=True), learner_of(config)
    assert violated(proved(learner, frozen, config, stages)) == set()
    fault = tamper("actor", offline_rows_in_the_actor_loss)
    assert violated(proved(learner, frozen, config, stages, fault)) == {RATIO, LESS, POLICY, REST}


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
    assert violated(proved(learner_of(shared), frozen, shared, Stages(shared, guided=True))) == {V}


def actor_gradient_into_the_prior(name, stage, arguments, seen, frozen):
    """PET's result less the actor loss's gradient in the adapters, which the code blocks."""
    result = stage(*arguments)
    if name != "adapt":
        return result
    (proposer, *inputs), _ = seen["propose"]
    (state, _, batch), _ = seen["gate"]
    _, (actor, _, _) = seen["actor"]
    weights = objective.Weights(*(jnp.float32(1),) * 3)

    def actor_loss(adapters):
        proposed = seen["stages"].propose(proposer._replace(adapters=adapters), *inputs)
        gated, *_ = seen["stages"].gate(state, [proposed], batch)
        return proposal_terms(actor, gated, weights)[0]

    gradient = jax.grad(actor_loss)(state.adapters)
    return jax.tree.map(lambda a, g: a - g, result[0], gradient), *result[1:]


def test_an_unblocked_gradient_into_the_prior_is_found(learner, frozen, config, traceable, monkeypatch):
    fault = actor_gradient_into_the_prior
    # Blocked: the gradient is nothing at all.
    assert violated(proved(learner, frozen, config, traceable, fault)) == set()
    monkeypatch.setattr(jax.lax, "stop_gradient", lambda x: x)
    claims = proved(learner, frozen, config, Stages(config, guided=True), fault)
    assert violated(claims) == {PET}
    (evidence,) = [claim.evidence for claim in claims if claim.statement == PET]
    assert {"actor", "q", "proposals"} <= {*evidence.removeprefix("reached by ").split(", ")}


def test_a_program_in_which_the_tags_are_missing_proves_nothing():
    claims = audit.static_claims(lambda cut: Flow({}, {}))
    assert violated(claims) == OF_PPO
