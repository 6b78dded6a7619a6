"""Returns of uniformly random actions: `python -m ppo_dap.tasks.random_returns [TASK ...]` prints them.

Without arguments it measures every task of the catalogue, whose `random_return` comes from here.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ppo_dap.tasks.catalogue import CATALOGUE, describe
from ppo_dap.tasks.vector import make_vector_env


def random_returns(task: str, episodes: int = 20, seed: int = 0) -> Float[np.ndarray, " episodes"]:
    """Undiscounted returns of the first episode of each of `episodes` copies."""
    spec, rng = describe(task), np.random.default_rng(seed)
    env = make_vector_env(task, episodes, seed)
    try:
        env.reset()
        returns, running = np.zeros(episodes), np.ones(episodes, bool)
        while running.any():
            actions = rng.uniform(spec.action_low, spec.action_high, (episodes, spec.action_size))
            step = env.step(actions.astype(np.float32))
            returns += np.where(running, step.rewards, 0.0)
            running &= ~(step.terminated | step.truncated)
        return returns
    finally:
        env.close()


def main(tasks: Sequence[str]) -> None:
    """Print mean and standard error for each of `tasks`."""
    for task in tasks or CATALOGUE:
        returns = random_returns(task)
        print(f"{task}: {returns.mean():,.1f} +- {returns.std(ddof=1) / len(returns) ** 0.5:,.1f} (n = {len(returns)})")


if __name__ == "__main__":
    main(sys.argv[1:])
