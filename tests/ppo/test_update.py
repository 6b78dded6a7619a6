import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppo.ppo_made import make_rows, no_normaliser, orders_of, small_config
from ppo_dap.ppo.gae import gae
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import (
    ADAM,
    Normaliser,
    PPOState,
    Settings,
    draw_orders,
    estimate_advantages,
    improve_actor,
    improve_critic,
    ppo_loss,
)

PPO = small_config()
MINIBATCHES = PPO.rollout_steps // PPO.minibatch_size
STATE = PPOState.create(np.random.default_rng(0), 3, 2, PPO.hidden_size)
ORDERS = orders_of(PPO, seed=1)
LIMITLESS = Settings(jnp.float32(3e-3), jnp.float32(np.inf), jnp.array(False))
RATE = jnp.float32(1e-3)
ROWS = make_rows(STATE.actor)
CRITIC = jax.jit(functools.partial(improve_critic, ppo=PPO))
VALUES = jax.jit(lambda critic, observations: critic(observations.reshape(64, 3)).reshape(16, 4))
ADVANTAGES = jax.jit(functools.partial(estimate_advantages, ppo=PPO))


@functools.cache
def actor_program(added_gradient=None):
    return jax.jit(functools.partial(improve_actor, ppo=PPO, added_gradient=added_gradient))


def improve(rows=ROWS, settings=LIMITLESS, orders=ORDERS, added=(), added_gradient=None, actor=STATE.actor):
    return actor_program(added_gradient)(actor, STATE.actor_optimizer, rows, added, orders, settings)


def limited(kl_limit):
    return improve(settings=LIMITLESS._replace(kl_limit=jnp.float32(kl_limit)))


def assert_same_bits(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def differ(first, second):
    return any(np.any(a != b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))


def changed(rows, **changes):
    return eqx.tree_at(lambda r: [getattr(r, name) for name in changes], rows, list(changes.values()))


# The clipped objective with its rules.


def test_the_ratio_is_1_at_the_first_minibatch_of_fresh_rows():
    _, _, metrics = improve()
    assert float(metrics["ratio_error"]) < 1e-5
    assert float(metrics["actor_updates"]) == PPO.num_epochs * MINIBATCHES
    assert float(metrics["pgshare"]) == pytest.approx(1, abs=1e-4)


def test_an_older_policys_batch_makes_the_ratio_error_large():
    older = PPOState.create(np.random.default_rng(9), 3, 2, PPO.hidden_size).actor
    stale = make_rows(eqx.tree_at(lambda a: a.log_std, older, older.log_std - 0.2))
    assert float(improve(stale)[2]["ratio_error"]) > 0.05


def test_statistics_that_move_within_an_iteration_make_the_ratio_error_large():
    steep = eqx.tree_at(lambda a: a.mlp.layers[-1].weight, STATE.actor, 50 * STATE.actor.mlp.layers[-1].weight)
    rows = make_rows(steep)
    assert float(improve(rows, actor=steep)[2]["ratio_error"]) < 1e-4
    renormalised = changed(rows, observations=1.5 * rows.observations)
    assert float(improve(renormalised, actor=steep)[2]["ratio_error"]) > 0.05


def test_the_kl_rule_stops_after_the_first_epoch_over_the_limit():
    actor, _, metrics = limited(1e-12)
    assert float(metrics["actor_updates"]) == MINIBATCHES
    assert all(np.isfinite(float(value)) for value in metrics.values())
    assert differ(actor, improve()[0])
    kl = [float(run[2]["policy_kl_minibatch"]) for run in (limited(1e-12), improve())]
    assert 0 < kl[0] < kl[1]
    assert MINIBATCHES < float(limited(1.5 * kl[0])[2]["actor_updates"]) <= PPO.num_epochs * MINIBATCHES


def test_same_seed_same_bits_and_another_seed_others():
    assert_same_bits(improve(), improve())
    assert differ(improve()[0], improve(orders=orders_of(PPO, seed=2))[0])


def test_an_order_holds_each_row_once_and_epochs_have_their_own():
    orders = draw_orders(np.random.default_rng(0), 50, 6)
    assert orders.dtype == np.int32
    np.testing.assert_array_equal(np.sort(orders, axis=1), np.broadcast_to(np.arange(6), (50, 6)))
    assert len({*map(tuple, orders.tolist())}) > 40
    firsts = np.bincount(draw_orders(np.random.default_rng(1), 6000, 6)[:, 0], minlength=6)
    assert np.abs(firsts - 1000).max() < 5 * np.sqrt(1000 * 5 / 6)


def test_minibatches_are_cut_from_an_epochs_order():
    """Other places within a minibatch change the rounding at most, another minibatch changes what is learned."""
    shape = (PPO.num_epochs, MINIBATCHES, PPO.minibatch_size)
    within = ORDERS.rows.reshape(shape)[..., ::-1].reshape(ORDERS.rows.shape)
    start, same, other = (
        np.asarray(improve(orders=ORDERS._replace(rows=rows))[0].log_std)
        for rows in (ORDERS.rows, within, ORDERS.rows[:, ::-1])
    )
    np.testing.assert_allclose(same, start, atol=1e-5)
    assert np.abs(other - start).max() > 1e-4


def test_advantages_move_the_policy_towards_the_better_actions():
    better = changed(ROWS, advantages=ROWS.actions[:, 0] - ROWS.old_means[:, 0])
    worse = changed(ROWS, advantages=-better.advantages)
    for rows, sign in ((better, 1), (worse, -1)):
        moved = np.asarray(improve(rows)[0](ROWS.observations) - ROWS.old_means).mean(0)
        assert sign * moved[0] > max(0.02, 2 * abs(moved[1]))


def test_where_every_row_is_clipped_nothing_moves():
    """Ratio above 1.2 at better rows, below 0.8 at worse ones: Eq. 5 is flat there."""
    better = ROWS.advantages > jnp.mean(ROWS.advantages)
    signs = jnp.where(better, jnp.float32(1), jnp.float32(-1))
    clipped = changed(ROWS, advantages=signs, old_log_probs=ROWS.old_log_probs - signs)
    learned, _, metrics = improve(clipped)
    assert_same_bits(learned, STATE.actor)
    assert float(metrics["actor_gradient_norm"]) == 0
    assert differ(improve(changed(ROWS, advantages=signs))[0], STATE.actor)


def test_gradient_of_the_spread_is_the_score_times_the_normalised_advantage():
    """At ratio 1, d(surrogate)/d(log_std) = mean(A (z^2 - 1))."""
    gradient = jax.jit(jax.grad(lambda actor: ppo_loss(actor, ROWS, STATE.actor.log_std, ppo=PPO)[0]))(STATE.actor)
    advantages = np.asarray(ROWS.advantages)
    advantages = (advantages - advantages.mean()) / advantages.std()
    z = np.asarray(ROWS.actions - ROWS.old_means)
    np.testing.assert_allclose(gradient.log_std, -(advantages[:, None] * (z**2 - 1)).mean(0), rtol=1e-4)


# What a method adds.


def pull(actor, rows, added, weight):
    """Gradient of `weight` times a loss that draws the means to 1 and the spread to nothing."""
    loss = lambda actor: weight * (jnp.mean(jnp.square(actor(added) - 1)) + actor.log_std.sum())  # noqa: E731
    return jax.grad(loss)(actor), {"seen": jnp.mean(added)}


def pulled(weight, adds=True):
    settings = LIMITLESS._replace(adds=jnp.array(adds), added_weights=jnp.float32(weight))
    orders = orders_of(PPO, seed=1, added=8)
    return improve(settings=settings, orders=orders, added=jnp.full((8, 3), 5.0), added_gradient=pull)


def test_an_added_gradient_of_zeros_leaves_every_bit():
    """Two programs, one with another term in it: the compiler must not fuse PPO's part differently."""
    plain = improve()
    for with_zeros in (pulled(0), pulled(5, adds=False)):
        assert_same_bits(with_zeros[:2], plain[:2])
        for name, value in plain[2].items():
            np.testing.assert_array_equal(with_zeros[2][name], value)
    assert float(plain[2]["pgshare"]) == pytest.approx(1, abs=1e-4)


def test_an_added_gradient_acts_and_is_reported():
    learned, _, metrics = pulled(5)
    assert np.all(np.asarray(learned.log_std) < np.asarray(improve()[0].log_std) - 0.01)
    assert float(metrics["seen"]) == 5
    assert 0 < float(metrics["pgshare"]) < 0.3


# Values.


def test_the_critic_fits_a_known_function():
    rows = make_rows(STATE.actor, seed=3)
    critic, optimizer = STATE.critic, STATE.critic_optimizer
    losses = []
    for i in range(60):
        critic, optimizer, metrics = CRITIC(critic, optimizer, rows, orders_of(PPO, seed=i).rows, jnp.float32(5e-3))
        losses.append(float(metrics["value_loss"]))
    errors = np.asarray(critic(rows.observations)) - np.sin(np.asarray(rows.observations[:, 0]))
    assert (errors**2).mean() < 0.02
    assert losses[-1] < 0.1 * losses[0]


def random_rollout(seed=0, masked=True):
    rng = np.random.default_rng(seed)
    grid = (16, 4)
    ended = rng.random(grid) < 0.2
    terminated = ended & (rng.random(grid) < 0.5)
    valid = np.ones(grid, bool)
    if masked:
        ended[1:] &= ~ended[:-1]  # a reset row does not end an episode
        terminated &= ended
        valid[1:] = ~ended[:-1]
    sizes = {"observations": 3, "next_observations": 3, "actions": 2, "means": 2}
    fields = {name: rng.standard_normal((*grid, size)) for name, size in sizes.items()}
    fields |= {name: rng.standard_normal(grid) for name in ("log_probs", "rewards")}
    flags = {"terminated": terminated, "truncated": ended & ~terminated, "valid": valid}
    return Rollout(
        state_ids=jnp.arange(64, dtype=jnp.int32).reshape(grid),
        **{name: jnp.asarray(value, jnp.float32) for name, value in fields.items()},
        **{name: jnp.asarray(value) for name, value in flags.items()},
    )


def parts_of(rollout, lengths=(4, 10, 2)):
    """The rollout as parts that follow each other in time."""
    ends = np.cumsum(lengths)
    return [jax.tree.map(lambda x, a=a, b=b: x[a:b], rollout) for a, b in zip(ends - lengths, ends, strict=True)]


def test_advantages_run_on_from_part_to_part():
    rollout = random_rollout()
    rows = ADVANTAGES(STATE.critic, parts_of(rollout), no_normaliser(3), jnp.ones(()))
    values, successors = (VALUES(STATE.critic, o) for o in (rollout.observations, rollout.next_observations))
    flags = rollout.terminated, rollout.truncated, rollout.valid
    columns = rollout.rewards, values, successors, *flags
    whole = np.asarray(gae(*columns, PPO.gamma, PPO.gae_lambda))
    np.testing.assert_allclose(rows.advantages, whole.ravel(), rtol=1e-4, atol=1e-5)
    # Each part on its own gives other advantages where an episode goes on.
    alone = [gae(*part, PPO.gamma, PPO.gae_lambda) for part in parts_of(columns)]
    last = np.asarray(~rollout.terminated & ~rollout.truncated & rollout.valid)[3]
    assert last.any()
    assert np.all(np.abs(np.concatenate(alone) - whole)[3, last] > 0.01)


def test_targets_are_flattened_in_step_with_their_rows():
    rollout = random_rollout()
    rows = ADVANTAGES(STATE.critic, parts_of(rollout), no_normaliser(3), jnp.float32(2.0))
    values, successors = (VALUES(STATE.critic, o) for o in (rollout.observations, rollout.next_observations))
    got, sent = (jax.tree.map(np.asarray, x) for x in (rows, rollout))
    for kind in (sent.terminated, sent.truncated, ~sent.valid, sent.valid):
        t, env = (index[-1] for index in np.nonzero(kind))
        row = 4 * t + env
        assert got.state_ids[row] == sent.state_ids[t, env]
        np.testing.assert_array_equal(got.actions[row], sent.actions[t, env])
        np.testing.assert_array_equal(got.raw_observations[row], sent.observations[t, env])
        assert got.weights[row] == sent.valid[t, env]
        after = 0.0 if sent.terminated[t, env] else PPO.gamma * float(successors[t, env])
        assert got.q_targets[row] == pytest.approx(sent.rewards[t, env] / 2 + after, abs=1e-5)
        assert got.returns[row] == pytest.approx(got.advantages[row] + float(values[t, env]), abs=1e-5)
        assert (got.advantages[row] != 0) == sent.valid[t, env]


def test_observations_and_rewards_are_normalised_and_clipped():
    rollout = random_rollout(masked=False)
    rollout = changed(
        rollout,
        rewards=rollout.rewards.at[0, 0].set(1e6),
        observations=rollout.observations.at[0, 0].set(1e6),
        terminated=jnp.ones_like(rollout.terminated),
    )
    normaliser = Normaliser(jnp.full(3, 0.5), jnp.full(3, 2.0))
    rows = ADVANTAGES(STATE.critic, parts_of(rollout), normaliser, jnp.float32(4.0))
    expected = np.clip((np.asarray(rollout.observations).reshape(64, 3) - 0.5) / 2, -10, 10)
    np.testing.assert_allclose(rows.observations, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows.q_targets, np.minimum(np.asarray(rollout.rewards).ravel() / 4, 10), rtol=1e-5)


# Rows in which no transition happened.

GARBAGE = 1e6


def garble(rows, masked, names):
    """`rows` with garbage in the masked rows of the named fields."""
    rng = np.random.default_rng(0)
    fields = {name: np.array(getattr(rows, name)) for name in names}
    for value in fields.values():
        value[masked] = GARBAGE * rng.uniform(0.5, 1, value[masked].shape)
    return changed(rows, **{name: jnp.asarray(value) for name, value in fields.items()})


def test_masked_rows_of_a_rollout_reach_no_other_row():
    rollout = random_rollout()
    masked = ~np.asarray(rollout.valid)
    assert masked.sum() > 5
    names = ("observations", "next_observations", "rewards", "actions", "means", "log_probs")

    def program(rollout):
        return ADVANTAGES(STATE.critic, parts_of(rollout), no_normaliser(3), jnp.ones(()))

    rows, garbled = program(rollout), program(garble(rollout, masked, names))
    kept = ~masked.ravel()
    assert_same_bits(*(jax.tree.map(lambda x: x[kept], r) for r in (rows, garbled)))
    seen = changed(rollout, valid=jnp.ones_like(rollout.valid))  # planted: nothing is masked
    assert differ(program(seen).advantages, program(garble(seen, masked, names)).advantages)


ROW_FIELDS = ("observations", "actions", "old_log_probs", "old_means", "advantages", "returns")
MASKED = np.arange(64) % 5 == 0


@pytest.mark.parametrize("name", ROW_FIELDS)
def test_masked_rows_move_neither_actor_nor_critic_nor_metrics(name):
    half = changed(ROWS, weights=jnp.asarray(~MASKED, jnp.float32))
    garbled = garble(half, MASKED, [name])
    assert_same_bits(improve(garbled), improve(half))
    critic = (STATE.critic, STATE.critic_optimizer)
    assert_same_bits(CRITIC(*critic, garbled, ORDERS.rows, RATE), CRITIC(*critic, half, ORDERS.rows, RATE))
    every = improve(garble(ROWS, MASKED, [name])), CRITIC(*critic, garble(ROWS, MASKED, [name]), ORDERS.rows, RATE)
    assert differ(every, (improve(), CRITIC(*critic, ROWS, ORDERS.rows, RATE)))  # with weight 1 the same garbage counts


def test_a_masked_row_whose_ratio_overflows_does_no_harm():
    half = changed(ROWS, weights=jnp.asarray(~MASKED, jnp.float32))
    low = changed(half, old_log_probs=jnp.where(MASKED, -1000.0, half.old_log_probs))
    assert_same_bits(improve(low), improve(half))


def test_actor_and_critic_have_optimizers_of_their_own():
    for networks, state in ((STATE.actor, STATE.actor_optimizer), (STATE.critic, STATE.critic_optimizer)):
        assert_same_bits(state, ADAM.init(networks))
    assert differ(improve()[1], STATE.actor_optimizer)
