"""Decision 2: with both weights at 0 the guide changes no bit of what PPO learns."""

import copy
from itertools import pairwise

import numpy as np
import pytest

from dap.dap_made import bits, iterated, learner_of, rollout_of, schedule_of
from ppo_dap.training.algorithm import Stages, iterate

pytestmark = pytest.mark.as_shipped

ITERATIONS = 5


def trained(config, frozen, stages, guided, **weights):
    """PPO's state after each iteration on synthetic rollouts of the current actor, and the guide at the end."""
    learner, history = learner_of(config, guided), []
    for i in range(ITERATIONS):
        schedule, rollout = schedule_of(i, guided=guided, **weights), rollout_of(learner.ppo.actor, i)
        assert not rollout.valid.all()
        prior = frozen if guided else None
        learner, _ = iterated(iterate, learner, prior, rollout, schedule, stages, config, i)
        history.append(learner.ppo)
    return history, learner.guide


@pytest.fixture(scope="module")
def ppo(config, stages):
    """Without a guide; the actor's stage is compiled without the added gradient."""
    plain = copy.copy(stages)
    plain.actor = Stages(config, guided=False).actor
    return trained(config, None, plain, guided=False)[0]


def test_a_guide_with_weights_0_leaves_every_bit_of_ppo(config, frozen, stages, ppo):
    history, guide = trained(config, frozen, stages, guided=True, lambda_kl=0.0, lambda_aux=0.0)
    assert [bits(state) for state in history] == [bits(state) for state in ppo]
    assert all(bits(before) != bits(after) for before, after in pairwise(history))
    # The guide itself did learn: it was on, and idle only towards PPO.
    start = learner_of(config).guide
    assert bits(guide.q) != bits(start.q)
    assert bits(guide.adapters) != bits(start.adapters)


@pytest.mark.parametrize("weights", [{"lambda_kl": 0.01, "lambda_aux": 0.0}, {"lambda_kl": 0.0, "lambda_aux": 0.01}])
def test_each_weight_alone_moves_the_actor_and_not_v(config, frozen, stages, ppo, weights):
    history, _ = trained(config, frozen, stages, guided=True, **weights)
    moved = np.abs(np.asarray(history[0].actor.log_std) - np.asarray(ppo[0].actor.log_std)).max()
    assert moved > 1e-4  # far more than rounding
    # On the same rollout V learns the same bits; from the second one on the actors' rollouts differ.
    assert bits((history[0].critic, history[0].critic_optimizer)) == bits((ppo[0].critic, ppo[0].critic_optimizer))
