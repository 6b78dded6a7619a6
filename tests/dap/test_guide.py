"""What becomes of the proposals on the parts of a rollout when it is over, and how many there are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dap.dap_made import OBS, changed, small_config
from ppo_dap.dap.guide import Proposed, gate_proposals, num_proposal_states
from ppo_dap.dap.objective import Batch
from ppo_dap.dap.proposals import Proposals

STATES = np.random.default_rng(0).standard_normal((8, OBS)).astype(np.float32)
WEIGHTS = jnp.asarray([1, 1, 0, 1, 1, 1, 1, 1], jnp.float32)
BATCH = Batch(jnp.asarray(40, jnp.int32), jnp.asarray(STATES), WEIGHTS, jnp.asarray(STATES))


def proposed(rows, wanted, q_spread, ess):
    """Proposals on some rows of D_on; everything about them has the row's number in it."""
    index = jnp.asarray(rows, jnp.int32)
    numbers = jnp.asarray(rows, jnp.float32)
    actions = jnp.broadcast_to(numbers[:, None, None], (len(rows), 3, 2))
    states = jnp.asarray(STATES)[index]
    proposals = Proposals(40 + index, states, states, actions, actions[:, 0], actions[:, 1])
    return Proposed(proposals, jnp.asarray(wanted, jnp.int32), jnp.float32(q_spread), {"ess": jnp.float32(ess)})


def test_parts_are_joined_in_order_and_their_numbers_are_means(learner):
    parts = [proposed([3, 1], 2, 3.0, 1.0), proposed([7, 4], 2, 1.0, 2.0)]
    guide = changed(learner.guide, q_spread=jnp.float32(10))
    gated, spread, metrics = gate_proposals(guide, parts, BATCH)
    assert gated.proposals.state_ids.tolist() == [43, 41, 47, 44]
    np.testing.assert_array_equal(gated.proposals.actions[:, 0, 0], [3, 1, 7, 4])
    np.testing.assert_array_equal(gated.proposals.raw_observations, STATES[[3, 1, 7, 4]])
    assert gated.gate.tolist() == [1, 1, 1, 1]
    # The global scale is the root of the mean square over the parts, and nine tenths of it are remembered.
    assert float(spread) == pytest.approx(0.9 * 10 + 0.1 * np.sqrt((9 + 1) / 2))
    assert {name: float(value) for name, value in metrics.items()} == {"ess": 1.5, "spr": 1.0}


def test_rows_that_fill_up_are_stopped_and_are_no_strangers(learner):
    gated, _, metrics = gate_proposals(learner.guide, [proposed([3, 2], 1, 1, 1), proposed([7, 4], 2, 1, 1)], BATCH)
    assert gated.gate.tolist() == [1, 0, 1, 1]
    assert float(metrics["spr"]) == 1
    # The same row counted as one in which something happened: a proposal from outside.
    _, _, metrics = gate_proposals(learner.guide, [proposed([3, 2], 2, 1, 1), proposed([7, 4], 2, 1, 1)], BATCH)
    assert float(metrics["spr"]) == 0.75


def test_a_stranger_in_one_part_shows(learner):
    part = proposed([3, 1], 2, 1, 1)
    stranger = jax.tree.map(lambda x: x, part.proposals)
    stranger = changed(stranger, raw_observations=stranger.raw_observations.at[0].add(1e-3))
    other = changed(part, proposals=stranger)
    gated, _, metrics = gate_proposals(learner.guide, [proposed([7, 4], 2, 1, 1), other], BATCH)
    assert gated.gate.tolist() == [1, 1, 0, 1]
    assert float(metrics["spr"]) == 0.75


@pytest.mark.parametrize(
    ("rows", "parts", "minibatch", "fraction", "expected"),
    [
        (2048, 8, 256, 0.2, 408),  # 8 minibatches: a fifth is 409.6
        (64, 1, 32, 0.2, 12),
        (64, 8, 16, 0.25, 16),
        (64, 8, 16, 1.0, 64),
        (48, 3, 12, 0.5, 24),
        (48, 3, 12, 0.6, 24),  # in steps of 12: 3 parts, 4 minibatches
        (64, 8, 16, 0.01, 8),  # at least one for each part
    ],
)
def test_states_are_dealt_out_evenly_to_parts_and_minibatches(rows, parts, minibatch, fraction, expected):
    config = small_config(rollout_steps=rows, minibatch_size=minibatch, proposal_fraction=fraction)
    assert num_proposal_states(rows, parts, config) == expected
    assert expected % parts == expected % (rows // minibatch) == 0
