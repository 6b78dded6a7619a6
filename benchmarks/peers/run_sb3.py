"""Training speed of Stable-Baselines3's PPO on one MuJoCo task, on the CPU.

The first iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import argparse
import json
import time
from importlib.metadata import version

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

ENVS, ROLLOUT, ITERATION = 8, 256, 8 * 256  # environments, and steps of each and of all in an iteration


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="Walker2d-v5")
    parser.add_argument("--steps", type=int, default=20480, help="environment steps, the warm-up's 2048 included")
    parser.add_argument("--threads", type=int, help="torch.set_num_threads; torch's own default when left out")
    args = parser.parse_args()
    if args.steps % ITERATION or args.steps < 2 * ITERATION:
        parser.error(f"--steps must be a multiple of {ITERATION}, and at least twice that")
    if args.threads:
        torch.set_num_threads(args.threads)

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

    result = {"peer": "sb3", "version": version("stable-baselines3"), "task": args.task, "steps": steps}
    print(json.dumps({**result, "seconds": round(seconds, 3), "steps_per_second": round(steps / seconds, 1)}))


if __name__ == "__main__":
    main()
