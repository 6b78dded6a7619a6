import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppo_dap.dap.q_learning import QData, q_loss
from ppo_dap.nets.critic import Critic, QFunction, q_features

OBSERVATIONS = jnp.asarray(np.random.default_rng(0).standard_normal((6, 3)), jnp.float32)
ACTIONS = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (6, 4, 2)), jnp.float32)
CRITIC = Critic.create(np.random.default_rng(0), 3, 8)


def create_q(own_trunk=False):
    return QFunction.create(np.random.default_rng(1), 3, 2, 8, 5, own_trunk)


def gradients(q, shared):
    """Gradient of a loss of Q in the critic and in Q."""

    def loss(critic, q):
        return jnp.mean(jnp.square(q(q_features(critic, q, OBSERVATIONS, shared), ACTIONS) - 1))

    return jax.jit(jax.grad(loss, argnums=(0, 1)))(CRITIC, q)


def moves(tree):
    return any(np.any(leaf) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize(
    ("own_trunk", "shared", "reaches"), [(False, False, False), (False, True, True), (True, True, False)]
)
def test_qs_gradient_reaches_vs_trunk_only_when_shared(own_trunk, shared, reaches):
    in_critic, in_q = gradients(create_q(own_trunk), shared)
    assert moves(in_critic.trunk) == reaches
    assert not moves(in_critic.v_head)
    (head,) = in_q.heads
    assert all(moves(layer) for layer in (head.state, head.action, head.out))
    assert moves(in_q.trunk) == own_trunk


def test_a_trunk_of_its_own_does_not_read_the_critics():
    other = Critic.create(np.random.default_rng(7), 3, 8)
    for own_trunk in (True, False):
        q = create_q(own_trunk)
        features = [np.asarray(q_features(critic, q, OBSERVATIONS, True)) for critic in (CRITIC, other)]
        assert np.array_equal(*features) == own_trunk


def test_stopping_the_gradient_changes_no_value():
    q = create_q()
    stopped, shared = (q_features(CRITIC, q, OBSERVATIONS, s) for s in (False, True))
    np.testing.assert_array_equal(stopped, shared)


def numpy_linear(layer, x):
    return x @ np.asarray(layer.weight).T + np.asarray(layer.bias)


def test_values_and_q_equal_plain_numpy_row_by_row():
    q = jax.tree.map(lambda leaf: leaf + 0.1, create_q())
    critic = jax.tree.map(lambda leaf: leaf + 0.1, CRITIC)
    (head,) = q.heads
    values, q_values = critic(OBSERVATIONS), q(critic.features(OBSERVATIONS), ACTIONS)
    assert values.shape == (6,)
    assert q_values.shape == (6, 4)
    for i in range(6):
        hidden = np.asarray(OBSERVATIONS)[i]
        for layer in critic.trunk.layers:
            hidden = np.tanh(numpy_linear(layer, hidden))
        assert float(values[i]) == pytest.approx(numpy_linear(critic.v_head, hidden)[0], abs=1e-5)
        for k in range(4):
            action = numpy_linear(head.action, np.asarray(ACTIONS)[i, k])
            both = np.tanh(numpy_linear(head.state, hidden) + action)
            assert float(q_values[i, k]) == pytest.approx(numpy_linear(head.out, both)[0], abs=1e-5)


# --- several heads --------------------------------------------------------------------------------------------------


FEATURES = CRITIC.features(OBSERVATIONS)
TWO = QFunction.create(np.random.default_rng(1), 3, 2, 8, 5, False, 2)
values_of = jax.jit(lambda q, pessimism: q(FEATURES, ACTIONS, pessimism), static_argnums=1)


def head_values(head):
    """A head in plain numpy, in float64."""
    states = numpy_linear(head.state, np.asarray(FEATURES, np.float64))[:, None]
    hidden = np.tanh(states + numpy_linear(head.action, np.asarray(ACTIONS, np.float64)))
    return numpy_linear(head.out, hidden)[..., 0]


def test_heads_differ_and_the_first_is_what_a_single_one_is():
    first, second = TWO.heads
    (only,) = create_q().heads
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(only), strict=True))
    assert np.abs(head_values(first) - head_values(second)).mean() > 0.1


@pytest.mark.parametrize("pessimism", [0.0, 1.0, 2.5])
def test_several_heads_are_their_mean_less_a_part_of_their_spread(pessimism):
    values = np.stack([head_values(head) for head in TWO.heads])
    expected = values.mean(0) - pessimism * values.std(0)
    np.testing.assert_allclose(values_of(TWO, pessimism), expected, atol=1e-4)
    if pessimism == 1:  # of two heads, that is the lower one
        np.testing.assert_allclose(expected, values.min(0), atol=1e-12)
    # One head has no spread to be pessimistic about.
    np.testing.assert_array_equal(values_of(create_q(), pessimism), values_of(create_q(), 0.0))


def test_the_gradient_is_finite_where_heads_agree_exactly():
    agreeing = QFunction(None, (TWO.heads[0],) * 2)
    in_actions = jax.grad(lambda actions, q: jnp.sum(q(FEATURES, actions, 1.0)))
    in_q = jax.grad(lambda q: jnp.sum(q(FEATURES, ACTIONS, 1.0)))(agreeing)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(in_q))
    # The slope in the action is that of the head that they both are.
    np.testing.assert_allclose(in_actions(ACTIONS, agreeing), in_actions(ACTIONS, create_q()), atol=1e-4)


@pytest.mark.parametrize("num_heads", [1, 2, 3])
def test_the_loss_is_the_sum_of_the_heads_mean_squared_errors(num_heads):
    q = QFunction.create(np.random.default_rng(4), 3, 2, 8, 5, False, num_heads)
    targets, weights = np.random.default_rng(5).standard_normal(6), np.array([1.0, 1, 0, 1, 0, 1])
    columns = OBSERVATIONS, ACTIONS[:, 0], *(jnp.asarray(x, jnp.float32) for x in (targets, weights))
    errors = [((head_values(head)[:, 0] - targets) ** 2)[weights > 0].mean() for head in q.heads]
    assert float(q_loss(q, CRITIC, QData(*columns), False)) == pytest.approx(sum(errors), rel=1e-4)
