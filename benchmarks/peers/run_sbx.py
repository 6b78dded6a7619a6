"""Training speed of SBX's PPO (Stable-Baselines3 in JAX) on one MuJoCo task, on the CPU.

The first iteration (collect and update, with the compilation) is a warm-up outside the clock; the rest of
``--steps`` is timed.
"""

import time
from importlib.metadata import version

import gymnasium as gym
import jax
from common import ENVS, ITERATION, ROLLOUT, arguments, report
from flax import linen as nn
from sbx import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    args = arguments(__doc__)
    jax.config.update("jax_platforms", "cpu")

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
        max_grad_norm=0.5,  # SBX has an optimiser each for actor and critic, and clips each by its own norm
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "activation_fn": nn.tanh},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # otherwise each learn() leaves a folder in /tmp

    model.learn(ITERATION)
    steps_before = model.num_timesteps
    start = time.perf_counter()
    model.learn(args.steps - ITERATION, reset_num_timesteps=False)
    jax.block_until_ready((model.policy.actor_state.params, model.policy.vf_state.params))
    seconds = time.perf_counter() - start
    steps = model.num_timesteps - steps_before

    report("sbx", version("sbx-rl"), args.task, steps, seconds)


if __name__ == "__main__":
    main()
