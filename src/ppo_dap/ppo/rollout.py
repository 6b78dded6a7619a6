"""Step 1 of Algorithm 1: collect D_on with the current policy."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import VectorEnv
from ppo_dap.tasks.vector import Transition

# A collector's arrays are numpy's; inside a jitted stage, where they are used, they are JAX's.
if TYPE_CHECKING:
    Numbers = Array
else:
    Numbers = Array | np.ndarray


class Rollout(eqx.Module):
    """D_on of one iteration, or a part of it. Observations are raw, actions scaled and not clipped (as sampled)."""

    state_ids: Int[Numbers, "time envs"]
    """Unique over a run: `iteration * rows + row`. What proposals and PET minibatches are traced by."""
    observations: Float[Numbers, "time envs obs"]
    next_observations: Float[Numbers, "time envs obs"]
    actions: Float[Numbers, "time envs act"]
    log_probs: Float[Numbers, "time envs"]
    means: Float[Numbers, "time envs act"]
    rewards: Float[Numbers, "time envs"]
    terminated: Bool[Numbers, "time envs"]
    truncated: Bool[Numbers, "time envs"]
    valid: Bool[Numbers, "time envs"]


@dataclass
class Collector:
    """Steps the environments and keeps what outlives one rollout: current observations and open episodes."""

    env: VectorEnv
    observations: Float[np.ndarray, "envs obs"] = field(init=False)
    returns: Float[np.ndarray, " envs"] = field(init=False)
    finished_returns: list[float] = field(default_factory=list)
    """Returns of the training episodes that ended since the list was last emptied."""
    env_seconds: float = 0.0
    """Time that the last rollout spent in the environments."""

    def __post_init__(self):
        self.observations = self.env.reset()
        self.returns = np.zeros(self.env.num_envs)

    def collect(
        self, policy: Policy, steps: int, parts: int, iteration: int, rng: np.random.Generator
    ) -> Iterator[Rollout]:
        """`steps` rows over all environments, sampled from `policy`, with rewards as the task gives them.

        They come in `parts` of one length, each as soon as it has been collected. Arrays are numpy's, and nobody
        writes to them again.
        """
        envs, act = self.env.num_envs, len(policy.log_std)
        time = steps // envs // parts
        std = np.exp(policy.log_std)
        self.env_seconds = 0.0
        for part in range(parts):
            noise = rng.standard_normal((time, envs, act), dtype=np.float32)
            out = self._part(policy, std * noise)
            first = (iteration * parts + part) * time * envs
            ids = np.arange(first, first + time * envs, dtype=np.int32).reshape(time, envs)
            yield Rollout(**out, log_probs=policy.log_prob_of_noise(noise), state_ids=ids)  # type: ignore[arg-type]

    def _part(self, policy: Policy, spread: np.ndarray) -> dict[str, np.ndarray]:
        steps, acted_on, means = [], [], []
        for t in range(len(spread)):
            mean = policy.mean(self.observations)
            means.append(mean)
            acted_on.append(self.observations)
            actions = policy.unscale(mean + spread[t])
            start = clock.perf_counter()
            step = self.env.step(actions)
            self.env_seconds += clock.perf_counter() - start
            steps.append(step)
            self._count(step)
            self.observations = step.observations
        columns = zip(Transition._fields, zip(*steps, strict=True), strict=True)
        out = {name: np.stack(column) for name, column in columns}
        out["means"] = np.stack(means)
        return out | {"observations": np.stack(acted_on), "actions": out["means"] + spread}

    def _count(self, step) -> None:
        self.returns += step.rewards
        ended = step.terminated | step.truncated
        if np.count_nonzero(ended):
            self.finished_returns.extend(self.returns[ended].tolist())
            self.returns[ended] = 0.0
