"""Training through the interface that Stable-Baselines3 and SBX share, with the recipe of all peers."""

import argparse
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import gymnasium as gym
from common import ENVS, ITERATION, ROLLOUT, report
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


def measure(
    algorithm: Any,
    activation: Any,
    args: argparse.Namespace,
    peer: str,
    package: str,
    settle: Callable[[Any], None] = lambda model: None,
) -> None:
    """Train with the PPO class `algorithm`, and print the measurement; `settle` waits until the model is computed."""
    envs = VecNormalize(DummyVecEnv([lambda: gym.make(args.task)] * ENVS), gamma=0.99)
    model = algorithm(
        "MlpPolicy",
        envs,
        learning_rate=3e-4,
        n_steps=ROLLOUT,
        batch_size=256,
        n_epochs=10,
        gamma=0.99,
        gae_lambda=0.95,
        clip_range=0.2,
        normalize_advantage=True,  # over each minibatch
        ent_coef=0.0,
        vf_coef=0.5,
        max_grad_norm=0.5,  # SBX has an optimiser each for actor and critic, and clips each by its own norm
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "activation_fn": activation},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # otherwise each learn() leaves a folder in /tmp

    model.learn(ITERATION)
    steps_before = model.num_timesteps
    start = time.perf_counter()
    model.learn(args.steps - ITERATION, reset_num_timesteps=False)
    settle(model)
    report(peer, version(package), args.task, model.num_timesteps - steps_before, time.perf_counter() - start)
