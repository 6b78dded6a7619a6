"""Many copies of a task stepped together, with one autoreset convention whatever the backend does.

A step returns the true successor of every observation (at an episode's end its final observation), the observation to
act on next, and `valid`: False for the rows in which a backend that resets one step late (EnvPool, Gymnasium's
NEXT_STEP) ignored the action. Learners mask those rows everywhere.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from ppo_dap.tasks.catalogue import describe, make_gymnasium


class Transition(NamedTuple):
    """One step of all environments."""

    next_observations: Float[np.ndarray, "envs obs"]
    """True successors: at an episode's end the final observation, never the next episode's first."""
    rewards: Float[np.ndarray, " envs"]
    terminated: Bool[np.ndarray, " envs"]
    truncated: Bool[np.ndarray, " envs"]
    valid: Bool[np.ndarray, " envs"]
    """False where no transition happened: the environment was being reset."""
    observations: Float[np.ndarray, "envs obs"]
    """What to act on next."""


@runtime_checkable
class VectorEnv(Protocol):
    """What rollouts and evaluation step."""

    num_envs: int

    def reset(self) -> Float[np.ndarray, "envs obs"]:
        """First observations; the seed was given when the environments were made."""
        ...

    def step(self, actions: Float[np.ndarray, "envs act"]) -> Transition:
        """Step with actions in environment units, already within the bounds."""
        ...

    def close(self) -> None:
        """Free what the backend holds."""
        ...


def make_vector_env(task: str, num_envs: int, seed: int, threads: int = 1) -> VectorEnv:
    """`num_envs` copies of `task`: EnvPool where it serves the id, our own for Striker, Gymnasium for every other.

    Raises `InputError` for an unknown id or spaces that are not boxes.
    """
    seed, spec = seed % 2**31, describe(task)
    if spec.backend == "envpool":
        import envpool

        env = envpool.make_gymnasium(task, num_envs=num_envs, num_threads=min(threads, num_envs), seed=seed)
        return NextStepEnv(env, num_envs, None)
    if spec.backend == "mujoco":
        from ppo_dap.tasks.striker_vector import StrikerVectorEnv

        return StrikerVectorEnv(num_envs, seed, threads)
    from gymnasium.vector import AutoresetMode, SyncVectorEnv

    env = SyncVectorEnv([lambda: make_gymnasium(task)] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    return wrap_gymnasium(env, seed)


class _GymnasiumLike:
    """The parts of the backends' interface that do not depend on when they reset."""

    def __init__(self, env: Any, num_envs: int, seed: int | None):
        self.env, self.num_envs, self._seed = env, num_envs, seed

    def reset(self) -> Float[np.ndarray, "envs obs"]:
        """First observations."""
        observations, _ = self.env.reset(seed=self._seed) if self._seed is not None else self.env.reset()
        self._ended = np.zeros(self.num_envs, bool)
        return observations.astype(np.float32)

    def close(self) -> None:
        """Free what the backend holds."""
        self.env.close()


class NextStepEnv(_GymnasiumLike):
    """A backend that resets in the step after an episode's end and ignores that step's action."""

    def step(self, actions: Float[np.ndarray, "envs act"]) -> Transition:
        """One step; rows of environments that ended before it are not valid."""
        observations, rewards, terminated, truncated, _ = self.env.step(actions)
        observations, rewards, valid = observations.astype(np.float32), rewards.astype(np.float32), ~self._ended
        if np.count_nonzero(self._ended):  # a fifth of what .any() costs, and this is a step's whole overhead
            terminated, truncated = terminated & valid, truncated & valid
            rewards[~valid] = 0.0
        self._ended = terminated | truncated
        return Transition(observations, rewards, terminated, truncated, valid, observations)


class SameStepEnv(_GymnasiumLike):
    """A Gymnasium vector environment that resets at once and keeps the final observation in its info."""

    def step(self, actions: Float[np.ndarray, "envs act"]) -> Transition:
        """One step; every row is valid."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        observations = observations.astype(np.float32)
        successors = observations
        ended = terminated | truncated
        if ended.any():
            successors = observations.copy()
            successors[ended] = np.stack(info["final_obs"][ended]).astype(np.float32)
        return _all_valid(successors, rewards, terminated, truncated, observations)


class ManualResetEnv(_GymnasiumLike):
    """A Gymnasium vector environment with autoreset disabled: ended environments are reset here."""

    def step(self, actions: Float[np.ndarray, "envs act"]) -> Transition:
        """One step; every row is valid."""
        successors, rewards, terminated, truncated, _ = self.env.step(actions)
        successors = successors.astype(np.float32)
        ended, observations = terminated | truncated, successors
        if ended.any():
            fresh, _ = self.env.reset(options={"reset_mask": ended})
            observations = np.where(ended[:, None], fresh, successors).astype(np.float32)
        return _all_valid(successors, rewards, terminated, truncated, observations)


def wrap_gymnasium(env: Any, seed: int) -> VectorEnv:
    """A Gymnasium vector environment of any autoreset mode behind `VectorEnv`."""
    from gymnasium.vector import AutoresetMode

    adapters = {
        AutoresetMode.NEXT_STEP: NextStepEnv,
        AutoresetMode.SAME_STEP: SameStepEnv,
        AutoresetMode.DISABLED: ManualResetEnv,
    }
    return adapters[env.metadata["autoreset_mode"]](env, env.num_envs, seed)


def _all_valid(successors, rewards, terminated, truncated, observations) -> Transition:
    valid = np.ones(len(rewards), bool)
    return Transition(successors, rewards.astype(np.float32), terminated, truncated, valid, observations)
