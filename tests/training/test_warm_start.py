import jax.numpy as jnp
import numpy as np
import pytest

import ppo_dap
from ppo_dap import config as configs
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs
from ppo_dap.nets.normalizer import RewardScale, RunningMoments
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
