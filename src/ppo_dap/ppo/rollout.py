"""Step 1 of Algorithm 1: collect D_on with the current policy."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import VectorEnv


class Rollout(eqx.Module):
    """D_on of one iteration. Observations are raw, actions scaled and not clipped (as sampled)."""

    state_ids: Int[Array, "time envs"]
    """Unique over a run: `iteration * rows + row`. What proposals and PET minibatches are traced by."""
    observations: Float[Array, "time envs obs"]
    next_observations: Float[Array, "time envs obs"]
    actions: Float[Array, "time envs act"]
    log_probs: Float[Array, "time envs"]
    means: Float[Array, "time envs act"]
    rewards: Float[Array, "time envs"]
    terminated: Bool[Array, "time envs"]
    truncated: Bool[Array, "time envs"]
    valid: Bool[Array, "time envs"]


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

    def collect(self, policy: Policy, steps: int, iteration: int, rng: np.random.Generator) -> Rollout:
        """`steps` rows over all environments, sampled from `policy`, with rewards as the task gives them."""
        envs = self.env.num_envs
        time, act = steps // envs, len(policy.log_std)
        noise = rng.standard_normal((time, envs, act), dtype=np.float32)
        std = np.exp(policy.log_std)
        self.env_seconds = 0.0
        out = _empty(time, envs, self.observations.shape[1], act)
        for t in range(time):
            mean = policy.mean(self.observations)
            action = mean + std * noise[t]
            actions = policy.unscale(action)
            start = clock.perf_counter()
            step = self.env.step(actions)
            self.env_seconds += clock.perf_counter() - start
            out["observations"][t], out["next_observations"][t] = self.observations, step.next_observations
            out["actions"][t], out["means"][t] = action, mean
            out["rewards"][t], out["valid"][t] = step.rewards, step.valid
            out["terminated"][t], out["truncated"][t] = step.terminated, step.truncated
            self._count(step)
            self.observations = step.observations
        out["log_probs"] = policy.log_prob_of_noise(noise)
        rows = np.arange(time * envs, dtype=np.int32) + np.int32(iteration * time * envs)
        return Rollout(
            **{name: jnp.asarray(x) for name, x in out.items()}, state_ids=jnp.asarray(rows.reshape(time, envs))
        )

    def _count(self, step) -> None:
        self.returns += step.rewards
        ended = step.terminated | step.truncated
        if ended.any():
            self.finished_returns.extend(self.returns[ended].tolist())
            self.returns[ended] = 0.0


def _empty(time: int, envs: int, obs: int, act: int) -> dict[str, np.ndarray]:
    flags = {name: np.empty((time, envs), bool) for name in ("terminated", "truncated", "valid")}
    wide = {"observations": obs, "next_observations": obs, "actions": act, "means": act}
    arrays = {name: np.empty((time, envs, size), np.float32) for name, size in wide.items()}
    return {**flags, **arrays, "rewards": np.empty((time, envs), np.float32)}
