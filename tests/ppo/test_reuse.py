"""PPO-ARC as reconstructed: what the previous batch becomes, the second candidate's loss, and the contest."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from ppo.ppo_made import changed, make_rows, no_normaliser, orders_of, small_config
from ppo_dap.ppo.gae import gae
from ppo_dap.ppo.reuse import Candidate, contest, no_batch, previous_rows, remember, truncated_gae
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, PPOState, PreviousRows, Settings, improve_actor, ppo_loss

PPO = small_config()
GRID = (PPO.rollout_steps // PPO.num_envs, PPO.num_envs)
STATE = PPOState.create(np.random.default_rng(0), 3, 2, PPO.hidden_size)
ACTOR = changed(STATE.actor, log_std=jnp.asarray([-0.3, 0.2], jnp.float32))
ROWS = make_rows(ACTOR)
LIMITLESS = Settings(jnp.float32(3e-3), jnp.float32(np.inf), jnp.array(False))
SEEN = jax.jit(functools.partial(previous_rows, ppo=PPO))
REUSE = jax.jit(functools.partial(improve_actor, ppo=PPO))
CONTEST = jax.jit(functools.partial(contest, ppo=PPO))
LOSS = jax.jit(functools.partial(ppo_loss, ppo=PPO))


def old_batch(seed=3):
    """A batch of another policy: episodes that end either way, and rows in which no transition happened."""
    rng = np.random.default_rng(seed)
    means = 0.3 * rng.standard_normal((*GRID, 2))
    actions = means + rng.standard_normal((*GRID, 2))
    ended = rng.random(GRID) < 0.2
    terminated = ended & (rng.random(GRID) < 0.5)
    wide = {"observations": rng.standard_normal((*GRID, 3)), "next_observations": rng.standard_normal((*GRID, 3))}
    wide |= {"actions": actions, "means": means, "rewards": rng.standard_normal(GRID)}
    wide |= {"log_probs": norm.logpdf(actions, means, 1).sum(-1)}
    flags = {"terminated": terminated, "truncated": ended & ~terminated, "valid": rng.random(GRID) > 0.2}
    return Rollout(
        state_ids=jnp.arange(64, dtype=jnp.int32).reshape(GRID) - 64,
        **{name: jnp.asarray(x, jnp.float32) for name, x in wide.items()},
        **{name: jnp.asarray(x) for name, x in flags.items()},
    )


OLD = old_batch()


def seen(batch=OLD, normaliser=None, reward_std=1.0, actor=ACTOR) -> PreviousRows:
    return SEEN(actor, STATE.critic, batch, normaliser or no_normaliser(3), jnp.float32(reward_std))


def same_bits(first, second):
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


# The previous batch under the current policy.


def test_truncated_gae_is_the_sum_over_later_differences():
    rng = np.random.default_rng(1)
    time, envs, gamma, lam = 9, 5, 0.9, 0.8
    rewards, values, successors = rng.standard_normal((3, time, envs))
    ended, ratio = rng.random((time, envs)) < 0.15, rng.uniform(0.3, 1.8, (time, envs))
    terminated = ended & (rng.random((time, envs)) < 0.5)
    valid = rng.random((time, envs)) > 0.1
    expected = np.zeros((time, envs))
    for t, env in np.ndindex(time, envs):
        weight = 1.0
        for later in range(t, time):
            if not valid[later, env]:
                break
            after = 0 if terminated[later, env] else gamma * successors[later, env]
            expected[t, env] += weight * (rewards[later, env] + after - values[later, env])
            if ended[later, env] or later + 1 == time:
                break
            weight *= gamma * lam * min(1.0, ratio[later + 1, env])
    columns = [jnp.asarray(x, jnp.float32) for x in (rewards, values, successors)]
    columns += [jnp.asarray(x) for x in (terminated, ended & ~terminated, valid)]
    got = truncated_gae(*columns, jnp.asarray(ratio, jnp.float32), gamma, lam)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)
    plain = gae(*columns, gamma, lam)
    assert same_bits(truncated_gae(*columns, jnp.full((time, envs), 1.7), gamma, lam), plain)
    assert np.abs(np.asarray(got - plain)).max() > 0.1


def test_rows_are_seen_by_the_current_policy_value_and_statistics():
    normaliser = Normaliser(jnp.full(3, 0.5), jnp.full(3, 2.0))
    rows = seen(normaliser=normaliser, reward_std=4.0)
    raw, after, actions = (
        np.asarray(x).reshape(64, -1) for x in (OLD.observations, OLD.next_observations, OLD.actions)
    )
    observations = (raw - 0.5) / 2
    np.testing.assert_allclose(rows.observations, observations, rtol=1e-5, atol=1e-6)
    valid = np.asarray(OLD.valid).ravel()
    np.testing.assert_array_equal(rows.weights, valid)
    means, std = np.asarray(ACTOR(jnp.asarray(observations, jnp.float32))), np.exp(ACTOR.log_std)
    now, then = norm.pdf(actions, means, std).prod(-1), np.exp(np.asarray(OLD.log_probs)).ravel()
    np.testing.assert_allclose(rows.centre[valid], (now / then)[valid], rtol=1e-4)
    np.testing.assert_array_equal(rows.centre[~valid], 1)
    values, successors = (
        STATE.critic(jnp.asarray(x, jnp.float32)).reshape(GRID) for x in (observations, (after - 0.5) / 2)
    )
    flags = OLD.terminated, OLD.truncated, OLD.valid
    ratio = jnp.asarray(np.where(valid, now / then, 1.0).reshape(GRID), jnp.float32)
    expected = truncated_gae(OLD.rewards / 4, values, successors, *flags, ratio, PPO.gamma, PPO.gae_lambda)
    np.testing.assert_allclose(rows.advantages, expected.ravel(), rtol=1e-3, atol=1e-5)


def test_a_batch_of_the_current_policy_itself_has_centres_of_1():
    means = np.asarray(ACTOR(OLD.observations.reshape(64, 3)))
    log_probs = norm.logpdf(OLD.actions.reshape(64, 2), means, np.exp(ACTOR.log_std)).sum(-1)
    rows = seen(changed(OLD, log_probs=jnp.asarray(log_probs.reshape(GRID), jnp.float32)))
    np.testing.assert_allclose(rows.centre, 1, rtol=1e-5)
    assert np.abs(np.asarray(seen().centre) - 1).max() > 0.2


def test_parts_are_remembered_in_time():
    parts = [jax.tree.map(lambda x, a=a: x[a : a + 8], OLD) for a in (0, 8)]
    assert same_bits(remember(parts), OLD)
    assert not same_bits(remember(parts[::-1]), OLD)


def test_there_is_no_batch_before_the_first():
    empty = no_batch(PPO, 3, 2)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), empty) == jax.tree.map(lambda x: (x.shape, x.dtype), OLD)
    rows = seen(empty)
    assert not np.any(rows.weights)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rows))


# The second candidate.


def reused(rows=ROWS, previous=None, ppo_orders=1):
    given = seen() if previous is None else previous
    return REUSE(ACTOR, STATE.actor_optimizer, rows, (), orders_of(PPO, seed=ppo_orders), LIMITLESS, given)


def test_loss_is_half_of_each_batchs_own():
    previous = seen()
    actor = changed(ACTOR, log_std=ACTOR.log_std - 0.15)
    loss, (means, ratio) = LOSS(actor, ROWS, ACTOR.log_std, previous)
    own, (own_means, own_ratio) = LOSS(actor, ROWS, ACTOR.log_std)
    assert same_bits((means, ratio), (own_means, own_ratio))
    kept = np.asarray(previous.weights) > 0
    means = np.asarray(actor(previous.observations))
    now = norm.logpdf(previous.actions, means, np.exp(actor.log_std)).sum(-1)
    ratio = np.exp(now - np.asarray(previous.old_log_probs))[kept]
    centre, advantages = np.asarray(previous.centre)[kept], np.asarray(previous.advantages)[kept]
    advantages = (advantages - advantages.mean()) / advantages.std()
    bounded = np.clip(ratio, centre - 0.2, centre + 0.2)
    old = -np.minimum(ratio * advantages, bounded * advantages).mean()
    assert float(loss) == pytest.approx((float(own) + old) / 2, rel=1e-4)
    assert np.mean(ratio != bounded) > 0.1


def test_both_batches_move_the_candidate():
    learned = reused()[0]
    assert not same_bits(reused(previous=seen(old_batch(9)))[0], learned)
    assert not same_bits(reused(changed(ROWS, advantages=-ROWS.advantages))[0], learned)
    assert float(reused()[2]["actor_updates"]) == PPO.num_epochs * PPO.rollout_steps // PPO.minibatch_size


@pytest.mark.parametrize("name", ["actions", "log_probs", "rewards", "observations", "next_observations"])
def test_masked_old_rows_move_nothing(name):
    masked = ~np.asarray(OLD.valid)
    value = np.array(getattr(OLD, name))
    value[masked] = 1e6 * np.random.default_rng(0).uniform(0.5, 1, value[masked].shape)
    garbled = changed(OLD, **{name: jnp.asarray(value)})
    result = reused(previous=seen(garbled))
    assert same_bits(result, reused())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
    every = changed(garbled, valid=jnp.ones_like(OLD.valid))  # planted: with weight the same garbage counts
    if name != "next_observations":  # the value of a state is bounded by tanh: garbage there is no garbage
        assert not same_bits(seen(every).advantages, seen(changed(OLD, valid=every.valid)).advantages)


def test_without_a_previous_batch_nothing_is_nan():
    result = reused(previous=seen(no_batch(PPO, 3, 2)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))


# The contest.


def shifted(distance):
    """A candidate whose means are `distance` standard deviations from pi_k's, all in one direction."""
    bias = ACTOR.mlp.layers[-1].bias + distance * jnp.exp(ACTOR.log_std) * jnp.asarray([1.0, 0.0])
    actor = eqx.tree_at(lambda a: a.mlp.layers[-1].bias, ACTOR, bias)
    return Candidate(actor, STATE.actor_optimizer, {"name": jnp.float32(distance)})


# The advantage is the noise of the first action: the further the mean is shifted that way, the higher E[r A].
NOISE = (ROWS.actions - ROWS.old_means) * jnp.exp(-ACTOR.log_std)[None]
GOOD = changed(ROWS, advantages=NOISE[:, 0])


def fought(own, other, rows=GOOD, previous=None, **options):
    given = seen() if previous is None else previous
    play = CONTEST if not options else jax.jit(functools.partial(contest, ppo=small_config(**options)))
    winner, won, metrics = play(ACTOR.log_std, own, other, rows, given)
    assert bool(won) == bool(metrics["arc_reused"])
    assert same_bits(winner, other if won else own)
    return bool(won), {name: float(value) for name, value in metrics.items()}


def test_the_higher_score_wins_either_way():
    assert fought(shifted(0.05), shifted(0.15))[0]
    assert not fought(shifted(0.15), shifted(0.05))[0]
    assert not fought(shifted(0.1), shifted(0.1))[0]  # a draw is PPO's


@pytest.mark.parametrize("beta", [1.0, 20.0])
def test_scores_and_kls_by_hand(beta):
    masked = np.arange(64) % 4 == 0
    rows = changed(
        GOOD,
        weights=jnp.asarray(~masked, jnp.float32),
        advantages=jnp.where(masked, 1e6, GOOD.advantages),
        old_log_probs=jnp.where(masked, -1e3, GOOD.old_log_probs),
    )
    _, metrics = fought(shifted(0.0), shifted(0.1), rows, contest_kl_weight=beta)
    z, advantages = np.asarray(NOISE[:, 0])[~masked], np.asarray(GOOD.advantages)[~masked]
    advantages = (advantages - advantages.mean()) / advantages.std()
    ratio = norm.pdf(z - 0.1) / norm.pdf(z)
    assert metrics["arc_kl_ppo"] == pytest.approx(0, abs=1e-6)
    assert metrics["arc_kl_reuse"] == pytest.approx(0.1**2 / 2, rel=1e-3)
    assert metrics["arc_score_ppo"] == pytest.approx(0, abs=1e-5)
    assert metrics["arc_score_reuse"] == pytest.approx((ratio * advantages).mean() - beta * 0.005, rel=2e-3)


def test_the_weight_of_the_kl_decides():
    assert fought(shifted(0.05), shifted(0.15), contest_kl_weight=0.0)[0]
    assert not fought(shifted(0.05), shifted(0.15), contest_kl_weight=1e3)[0]


def test_a_candidate_that_went_too_far_is_rejected():
    """The limit is twice kl_target, 0.04: a shift of 0.28 is just within, one of 0.29 beyond."""
    assert fought(shifted(0.05), shifted(0.28))[0]
    assert not fought(shifted(0.05), shifted(0.29))[0]
    assert fought(shifted(0.29), shifted(0.05))[0]
    assert not fought(shifted(0.29), shifted(0.5))[0]  # both: PPO's stands


def test_in_the_first_iteration_and_against_nan_ppo_stands():
    nothing = seen(no_batch(PPO, 3, 2))
    assert not fought(shifted(0.05), shifted(0.15), previous=nothing)[0]
    broken = shifted(0.15)._replace(actor=changed(ACTOR, log_std=jnp.full(2, jnp.nan)))
    assert not fought(shifted(0.05), broken)[0]
    assert fought(broken, shifted(0.05))[0]
