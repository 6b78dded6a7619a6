"""Training speed of Stable-Baselines3's PPO on one MuJoCo task, on the CPU.

The first iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import time
from importlib.metadata import version

import gymnasium as gym
import torch
from common import ENVS, ITERATION, ROLLOUT, arguments, report
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    args = arguments(__doc__)

    envs = VecNormalize(DummyVecEnv([lambda: gym.make(args.task)] * ENVS), gamma=0.99)
    model = PPO(
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
        max_grad_norm=0.5,
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "activation_fn": torch.nn.Tanh},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # otherwise each learn() leaves a folder in /tmp

    model.learn(ITERATION)
    steps_before = model.num_timesteps
    start = time.perf_counter()
    model.learn(args.steps - ITERATION, reset_num_timesteps=False)
    seconds = time.perf_counter() - start
    steps = model.num_timesteps - steps_before

    report("sb3", version("stable-baselines3"), args.task, steps, seconds)


if __name__ == "__main__":
    main()
