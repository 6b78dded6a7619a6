import jax.numpy as jnp
import numpy as np
import pytest

import ppo_dap
from dap.dap_made import bits
from ppo_dap import config as configs
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs
from ppo_dap.nets.normalizer import RewardScale, RunningMoments
from ppo_dap.priors import random_prior
from ppo_dap.tasks import TaskSpec
from ppo_dap.training.algorithm import create_learner
from ppo_dap.training.state import TrainState
from ppo_dap.training.warm_start import warm_start

SPEC = TaskSpec("made-v0", 2, np.array([-2.0], np.float32), np.array([2.0], np.float32), "gymnasium")


def made_logs(rewards=True):
    """Actions are 0.8 s_0 plus noise of spread 0.6, in an action space of [-2, 2]; the return to go is 5 at gamma 0."""
    rng = np.random.default_rng(0)
    observations = rng.normal([1.0, -3.0], [2.0, 0.5], (4000, 2)).astype(np.float32)
    actions = np.clip(0.4 * observations[:, :1] + 0.3 * rng.standard_normal((4000, 1)), -2, 2).astype(np.float32)
    ends = np.arange(4000) % 100 == 99
    return Logs(observations, actions, ends, rewards=np.full(4000, 5.0, np.float32) if rewards else None)


def start(config):
    learner = create_learner((2, 1), config, None)
    return TrainState(learner, RunningMoments.create(2), RewardScale.create(config.ppo.num_envs))


def test_the_actor_clones_mean_and_spread_of_the_logs():
    config = configs.make(warm_start="actor", warm_start_std_floor=0.01)
    state = warm_start(start(config), made_logs(), SPEC, config)
    policy = state.policy(SPEC, config.ppo.observation_clip)
    states = np.array([[0.0, -3.0], [2.0, -3.0], [3.0, -2.5]], np.float32)
    np.testing.assert_allclose(policy(states)[:, 0], [0.0, 0.8, 1.2], atol=0.1)
    # Scaled by half the range, 2; clipping at the bound takes a little off.
    np.testing.assert_allclose(np.exp(policy.log_std), 0.15, atol=0.02)
    np.testing.assert_allclose(state.observations.mean, [1.0, -3.0], atol=0.1)


def test_the_spread_has_a_floor():
    config = configs.make(warm_start="actor", warm_start_std_floor=0.5)
    state = warm_start(start(config), made_logs(), SPEC, config)
    np.testing.assert_allclose(np.exp(state.learner.ppo.actor.log_std), 0.5, rtol=1e-6)


def test_values_start_at_the_logged_returns_to_go():
    config = configs.make(warm_start="actor_critic", gamma=0.0)
    state = warm_start(start(config), made_logs(), SPEC, config)
    normalised = (made_logs().observations - state.observations.mean) / state.observations.std
    values = np.asarray(state.learner.ppo.critic(jnp.asarray(normalised, jnp.float32)))
    assert np.abs(values * state.reward_scale.std - 5.0).mean() < 0.2


def test_values_need_rewards():
    config = configs.make(warm_start="actor_critic")
    with pytest.raises(InputError, match="needs logs with rewards"):
        warm_start(start(config), made_logs(rewards=False), SPEC, config)


def test_ppo_bc_starts_from_the_logs(tmp_path, hopper_logs, small):
    run = ppo_dap.train(
        "Hopper-v5", "ppo-bc", logs=hopper_logs, out=tmp_path / "bc", steps=200, progress=False, **small
    )
    plain = ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "ppo", steps=200, progress=False, **small)
    assert run.config["config"]["warm_start"] == "actor"
    assert run.config["logs_hash"] == hopper_logs.hash()
    assert run.evaluations[0]["return_mean"] > plain.evaluations[0]["return_mean"]


def logs_of_good_and_bad():
    """60 episodes of 50 rows; the 20 good ones earn 1 a row and act +0.5, the others earn 0 and act -0.5 (scaled)."""
    rng = np.random.default_rng(1)
    good = np.repeat(rng.permutation(60) < 20, 50)
    actions = 2 * np.where(good, 0.5, -0.5)[:, None] + 0.02 * rng.standard_normal((3000, 1))
    observations, ends = rng.standard_normal((3000, 2)).astype(np.float32), np.arange(3000) % 50 == 49
    return Logs(observations, actions.astype(np.float32), ends, rewards=good.astype(np.float32))


@pytest.mark.parametrize(("share", "mean"), [(1.0, -0.5 / 3), (0.3, 0.5)])
def test_the_filter_shows_the_best_episodes_alone(share, mean):
    config = configs.make(warm_start="actor", logs_filter=share)
    state = warm_start(start(config), logs_of_good_and_bad(), SPEC, config)
    policy = state.policy(SPEC, config.ppo.observation_clip)
    states = np.random.default_rng(2).standard_normal((100, 2)).astype(np.float32)
    assert (policy.mean(states)).mean() == pytest.approx(mean, abs=0.08)
    # The normaliser has seen what the actor has.
    assert state.observations.count == pytest.approx(3000 * share, rel=0.02)


def guided_start(config):
    learner = create_learner((2, 1), config, random_prior(2, SPEC.action_low, SPEC.action_high).network)
    return TrainState(learner, RunningMoments.create(2), RewardScale.create(config.ppo.num_envs))


def test_q_alone_starts_from_the_returns_and_leaves_actor_and_v_as_they_are():
    """Rewards are the action's square, so that at gamma 0 that is Q's target, and V's is something else."""
    logs = made_logs()
    logs = Logs(logs.observations, logs.actions, logs.episode_ends, rewards=logs.actions[:, 0] ** 2)
    options = {"warm_start": "actor", "gamma": 0.0, "warm_start_epochs": 60}
    with_q, without = (configs.make(**options, q_warm_start=q) for q in (True, False))
    before = guided_start(with_q)
    after, plain = warm_start(before, logs, SPEC, with_q), warm_start(guided_start(without), logs, SPEC, without)
    assert bits(after.learner.ppo) == bits(plain.learner.ppo)
    assert bits(after.learner.ppo.critic) == bits(before.learner.ppo.critic)
    assert bits(plain.learner.guide) == bits(before.learner.guide)
    assert all(a != b for a, b in zip(bits(after.learner.guide.q), bits(before.learner.guide.q), strict=True))
    # PPO scales rewards by what it will see itself, not by the logs.
    assert after.reward_scale == before.reward_scale
    observations = (logs.observations - after.observations.mean) / after.observations.std
    features = after.learner.ppo.critic.features(jnp.asarray(observations, jnp.float32))
    actions = jnp.asarray(logs.actions / 2)[:, None]
    values = np.asarray(after.learner.guide.q(features, actions))[:, 0]
    assert np.corrcoef(values, logs.rewards)[0, 1] > 0.85
    assert abs(np.corrcoef(before.learner.guide.q(features, actions)[:, 0], logs.rewards)[0, 1]) < 0.5


def test_q_and_the_best_episodes_need_rewards_and_q_needs_a_warm_start():
    logs = made_logs(rewards=False)
    config = configs.make(warm_start="actor", q_warm_start=True)
    with pytest.raises(InputError, match="q_warm_start needs logs with rewards; these have none: use warm_start 'acto"):
        warm_start(guided_start(config), logs, SPEC, config)
    config = configs.make(warm_start="actor", logs_filter=0.5)
    with pytest.raises(InputError, match=r"logs_filter 0.5 goes by returns, .*: use logs with rewards, or no filter"):
        warm_start(start(config), logs, SPEC, config)
    with pytest.raises(InputError, match="q_warm_start needs a warm_start: 'actor', or 'actor_critic'"):
        configs.make(q_warm_start=True)


@pytest.mark.parametrize(("spread", "std"), [(0.4, 0.4), (0.05, 0.2), (1.7, 1.0)])
def test_the_policys_spread_starts_at_the_priors_within_bounds(spread, std):
    config = configs.make(initial_std=None)
    learners = [create_learner((2, 1), c, None, np.array([spread])) for c in (config, configs.make())]
    stds = [float(np.exp(learner.ppo.actor.log_std[0])) for learner in learners]
    assert stds == pytest.approx([std, 1.0])
    assert bits(learners[0].ppo.actor.mlp) == bits(learners[1].ppo.actor.mlp)


def test_a_run_asks_its_prior_for_the_spread(tmp_path, hopper_prior, small):
    """At a learning rate that moves nothing."""
    options = {"prior": hopper_prior, "steps": 256, "learning_rate": 1e-9, "progress": False} | small
    run = ppo_dap.train("Hopper-v5", out=tmp_path / "run", initial_std=None, **options)
    spread = ppo_dap.load_prior(hopper_prior).spread()
    assert ((spread > 0.2) & (spread < 1)).all()
    np.testing.assert_allclose(np.exp(run.policy.log_std), spread, rtol=1e-4)
    assert all(claim.holds for claim in run.audit())
