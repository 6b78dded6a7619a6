"""Logs of a trained policy: what a behaviour policy would have left behind."""

from __future__ import annotations

import numpy as np

from ppo_dap.logs import Logs
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import make_vector_env


def collect_logs(policy: Policy, task: str, steps: int, seed: int = 0, num_envs: int = 8, noise: float = 1.0) -> Logs:
    """Whole episodes of at least `steps` rows in all, by `policy` with `noise` times its own exploration noise.

    Actions are logged as executed: clipped to the action space, in environment units.
    """
    env = make_vector_env(task, num_envs, seed)
    rng = np.random.default_rng(seed)
    std = noise * np.exp(policy.log_std)
    observations = env.reset()
    open_rows: list[list[tuple]] = [[] for _ in range(num_envs)]
    episodes: list[list[tuple]] = []
    try:
        while sum(map(len, episodes)) < steps:
            sampled = policy.mean(observations) + std * rng.standard_normal((num_envs, len(std)), dtype=np.float32)
            actions = policy.unscale(sampled).astype(np.float32)
            step = env.step(actions)
            for i in np.flatnonzero(step.valid):
                open_rows[i].append((observations[i], actions[i], step.rewards[i], step.terminated[i]))
                if step.terminated[i] or step.truncated[i]:
                    episodes.append(open_rows[i])
                    open_rows[i] = []
            observations = step.observations
    finally:
        env.close()
    rows = [row for episode in episodes for row in episode]
    ends = np.zeros(len(rows), bool)
    ends[np.cumsum([len(episode) for episode in episodes]) - 1] = True
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    return Logs(
        observations=columns[0],
        actions=columns[1],
        episode_ends=ends,
        rewards=columns[2],
        terminated=columns[3],
        task=task,
        action_low=policy.action_low,
        action_high=policy.action_high,
        source=f"collected from a policy on {task}",
    )
