"""Monte-Carlo returns of chosen actions (5.7's G): states that a policy visits, and several futures of each.

Sizes: n states, k actions a state, m rollouts an action. Actions are scaled as the policy's; returns are in Q's units,
since `Scoring` divides and clips rewards as training does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ppo_dap.nets.policy import Policy
from ppo_dap.tasks.restore import Restorable

Values = Callable[[np.ndarray], np.ndarray]
"""V of raw observations, (n, obs) to (n,)."""


@dataclass(frozen=True)
class Scoring:
    """What turns rewards into a return."""

    gamma: float
    reward_std: float
    reward_clip: float
    values: Values

    def __call__(self, rewards: Any) -> Any:
        """Rewards as Q's targets see them."""
        return np.clip(np.asarray(rewards) / self.reward_std, -self.reward_clip, self.reward_clip)


class Walk(NamedTuple):
    """Steps of one environment with the stochastic policy, and the states that were kept on the way."""

    observations: Float[np.ndarray, "steps obs"]
    next_observations: Float[np.ndarray, "steps obs"]
    actions: Float[np.ndarray, "steps act"]
    """As executed: clipped to [-1, 1]."""
    rewards: Float[np.ndarray, " steps"]
    terminated: Bool[np.ndarray, " steps"]
    truncated: Bool[np.ndarray, " steps"]
    kept: Int[np.ndarray, " n"]
    """Rows of the states that are looked at."""
    saved: list[Any]
    """Their simulator states; empty where the task cannot be restored."""


def default_horizon(gamma: float, weight: float = 0.05, most: int = 1000) -> int:
    """Steps after which gamma^H is below `weight`, `most` where the discount never gets there."""
    return most if gamma >= 1 else max(1, min(most, math.floor(math.log(weight) / math.log(max(gamma, 1e-9))) + 1))


def walk(env: Any, policy: Policy, steps: int, states: int, seed: int, save: Callable[[], Any] | None) -> Walk:
    """`steps` steps of the Gymnasium environment `env`, and `states` of them drawn at random to be looked at.

    `save` keeps the simulator's state before a step; None where that is impossible.
    """
    rng = np.random.default_rng([seed, 0])
    kept = np.sort(rng.choice(steps, min(states, steps), replace=False))
    wanted, saved, rows = set(kept.tolist()), [], []
    std = np.exp(policy.log_std)
    observation = np.asarray(env.reset(seed=seed)[0], np.float32)
    for step in range(steps):
        if save is not None and step in wanted:
            saved.append(save())
        noise = rng.standard_normal(len(std), dtype=np.float32)
        action = np.clip(policy.mean(observation[None]) + std * noise, -1.0, 1.0)
        successor, reward, terminated, truncated, _ = env.step(policy.unscale(action)[0])
        successor = np.asarray(successor, np.float32)
        rows.append((observation, successor, action[0], float(reward), bool(terminated), bool(truncated)))
        observation = np.asarray(env.reset()[0], np.float32) if terminated or truncated else successor
    return Walk(*map(np.array, zip(*rows, strict=True)), kept=kept, saved=saved)  # type: ignore[arg-type]


def returns_to_go(trajectory: Walk, scoring: Scoring) -> Float[np.ndarray, " steps"]:
    """Discounted return of each visited pair along its own trajectory, with V where that is cut: at a time limit and
    after the last step.
    """
    rewards, after = scoring(trajectory.rewards), scoring.values(trajectory.next_observations)
    found, following = np.empty(len(rewards)), 0.0
    for t in range(len(rewards) - 1, -1, -1):
        if trajectory.terminated[t]:
            following = 0.0
        elif trajectory.truncated[t] or t == len(rewards) - 1:
            following = after[t]
        found[t] = following = rewards[t] + scoring.gamma * following
    return found


def monte_carlo_returns(
    copies: Sequence[Restorable],
    policy: Policy,
    saved: Sequence[Any],
    actions: Float[np.ndarray, "n k act"],
    scoring: Scoring,
    horizon: int,
    seed: int,
    progress: Callable[[int], None] = lambda state: None,
) -> Float[np.ndarray, "n k m"]:
    """5.7: discounted returns G(s, a) of m rollouts a pair, one in each of `copies`: restore s, take a, then follow
    the stochastic policy; after `horizon` steps V stands for the rest, unless the episode terminated.

    The actions of a state share the noise of their rollouts: what differs between them is the action.
    """
    n, k, size = actions.shape
    returns = np.zeros((n, k, len(copies)))
    lasts, left = [], []
    for i, state in enumerate(saved):
        noise = np.random.default_rng([seed, 1, i]).standard_normal((horizon, len(copies), size), dtype=np.float32)
        for j in range(k):
            returns[i, j], last, weights = _rollouts(copies, policy, state, actions[i, j], noise, scoring)
            lasts.append(last)
            left.append(weights)
        progress(i + 1)
    rest = scoring.values(np.concatenate(lasts)).reshape(returns.shape)
    return returns + np.stack(left).reshape(returns.shape) * rest


def _rollouts(
    copies: Sequence[Restorable],
    policy: Policy,
    saved: Any,
    action: Float[np.ndarray, " act"],
    noise: Float[np.ndarray, "horizon m act"],
    scoring: Scoring,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m obs"], Float[np.ndarray, " m"]]:
    """Returns of one action's rollouts, their last observations, and what V there weighs (0 after a termination)."""
    for copy in copies:
        copy.restore(saved)
    std, going = np.exp(policy.log_std), list(range(len(copies)))
    returns, weights = np.zeros(len(copies)), np.zeros(len(copies))
    last: list[Any] = [None] * len(copies)
    chosen, discount = np.tile(action, (len(copies), 1)), 1.0
    for step in range(len(noise)):
        if step > 0:
            chosen = policy.mean(np.stack([last[i] for i in going])) + std * noise[step, going]
        rewards = np.zeros(len(copies))
        taken = list(zip(going, policy.unscale(chosen), strict=True))
        for i, units in taken:
            last[i], rewards[i], terminated = copies[i].step(units)
            if terminated:
                going.remove(i)
        returns += discount * scoring(rewards)
        discount *= scoring.gamma
        if not going:
            break
    weights[going] = discount
    return returns, np.stack(last), weights
