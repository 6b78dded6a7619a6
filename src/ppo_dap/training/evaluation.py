"""Evaluation: the deterministic policy with frozen statistics, one episode in each of several environments (5.1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import make_vector_env

ENDLESS = 1_000_000
"""An episode of so many steps has no end: a task without a time limit would keep an evaluation for ever."""


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns and lengths of whole episodes."""

    returns: tuple[float, ...]
    lengths: tuple[int, ...]

    def row(self, env_steps: int) -> dict:
        """What `evaluations.jsonl` holds for it."""
        return {
            "env_steps": env_steps,
            "return_mean": float(np.mean(self.returns)),
            "return_std": float(np.std(self.returns)),
            "episodes": len(self.returns),
            "length_mean": float(np.mean(self.lengths)),
            "returns": list(self.returns),
        }


def evaluate_policy(policy: Policy, task: str, episodes: int, seed: int, threads: int = 1) -> Evaluation:
    """Returns of `episodes` episodes with mean actions; the first of each environment counts."""
    env = make_vector_env(task, episodes, seed, threads)
    try:
        observations = env.reset()
        returns, lengths, running = np.zeros(episodes), np.zeros(episodes, int), np.ones(episodes, bool)
        while running.any():
            step = env.step(policy.unscale(policy.mean(observations)))  # one that ended may show NaN
            returns += np.where(running, step.rewards, 0.0)
            lengths += running
            running &= ~(step.terminated | step.truncated)
            if lengths.max() >= ENDLESS and running.any():
                raise InputError(f"task {task}: an episode has no end after {ENDLESS:,} steps: step must truncate it")
            observations = step.observations
        return Evaluation(tuple(returns.tolist()), tuple(lengths.tolist()))
    finally:
        env.close()
