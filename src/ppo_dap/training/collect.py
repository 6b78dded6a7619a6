"""Logs of a trained policy: what a behaviour policy would have left behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ppo_dap.logs import Logs
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import make_vector_env


class Episode(NamedTuple):
    """One episode, or what was seen of it. Actions as executed: clipped to the action space, in environment units."""

    observations: Float[np.ndarray, "rows obs"]
    actions: Float[np.ndarray, "rows act"]
    rewards: Float[np.ndarray, " rows"]
    terminated: Bool[np.ndarray, " rows"]
    final_observation: Float[np.ndarray, " obs"]
    """What the environment showed after the last action."""


def collect_episodes(
    policy: Policy, task: str, steps: int, seed: int = 0, num_envs: int = 8, noise: float = 1.0
) -> list[Episode]:
    """Whole episodes of at least `steps` rows in all, by `policy` with `noise` times its own exploration noise."""
    env = make_vector_env(task, num_envs, seed)
    rng = np.random.default_rng(seed)
    std = noise * np.exp(policy.log_std)
    observations = env.reset()
    open_rows: list[list[tuple]] = [[] for _ in range(num_envs)]
    episodes: list[Episode] = []
    collected = 0
    try:
        while collected < steps:
            sampled = policy.mean(observations) + std * rng.standard_normal((num_envs, len(std)), dtype=np.float32)
            actions = policy.unscale(sampled).astype(np.float32)
            step = env.step(actions)
            for i in np.flatnonzero(step.valid):
                open_rows[i].append((observations[i], actions[i], step.rewards[i], step.terminated[i]))
                if step.terminated[i] or step.truncated[i]:
                    seen, acted, rewards, ended = (np.stack(column) for column in zip(*open_rows[i], strict=True))
                    episodes.append(Episode(seen, acted, rewards, ended, step.next_observations[i]))
                    collected += len(open_rows[i])
                    open_rows[i] = []
            observations = step.observations
    finally:
        env.close()
    return episodes


def collect_logs(policy: Policy, task: str, steps: int, seed: int = 0, num_envs: int = 8, noise: float = 1.0) -> Logs:
    """`collect_episodes` as `Logs`."""
    episodes = collect_episodes(policy, task, steps, seed, num_envs, noise)
    bounds = {"action_low": policy.action_low, "action_high": policy.action_high}
    return as_logs(episodes, task=task, source=f"collected from a policy on {task}", **bounds)


def as_logs(episodes: Sequence[Episode], **about: Any) -> Logs:
    """Episodes one after the other as `Logs`, which have no final observations; `about` are its other fields."""
    names = ("observations", "actions", "rewards", "terminated")
    columns = {name: np.concatenate([getattr(episode, name) for episode in episodes]) for name in names}
    ends = np.zeros(len(columns["rewards"]), bool)
    ends[np.cumsum([len(episode.rewards) for episode in episodes]) - 1] = True
    return Logs(episode_ends=ends, **columns, **about)


def thin(episodes: Sequence[Episode], rows: int) -> list[Episode]:
    """Whole episodes of about `rows` rows in all, spread evenly over the given ones."""
    share = min(1.0, rows / sum(len(episode.rewards) for episode in episodes))
    # One is taken whenever the rows so far, times the share, pass what has been taken: even in rows, not in episodes.
    kept, seen, taken = [], 0, 0
    for episode in episodes:
        seen += len(episode.rewards)
        if taken + len(episode.rewards) / 2 <= share * seen:
            kept.append(episode)
            taken += len(episode.rewards)
    return kept or [episodes[0]]
