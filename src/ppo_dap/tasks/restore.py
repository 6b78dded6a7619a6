"""Simulators that can be put back to an earlier state, so that several futures of one state can be seen."""

from __future__ import annotations

import copy
import importlib
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.tasks.catalogue import make_gymnasium

MEMORY = ("_rewards",)
"""What an episode remembers outside its simulator: Striker's least distance and strike."""
PROBE_STEPS = 12
"""Steps that a copy has to repeat before it is trusted."""


@runtime_checkable
class Restorable(Protocol):
    """An environment without resets and time limits whose state can be kept and put back."""

    def step(self, action: Float[np.ndarray, " act"]) -> tuple[Float[np.ndarray, " obs"], float, bool]:
        """Observation, reward and whether the episode terminated; the action is in environment units."""
        ...

    def save(self) -> Any:
        """The state, for `restore` of this or another copy of the same task."""
        ...

    def restore(self, saved: Any) -> None:
        """Go back to a state that a copy of the same task saved."""
        ...


class MujocoSimulator:
    """A MuJoCo environment of Gymnasium. It is all of MuJoCo's data that is kept, not positions and velocities alone:
    the solver's warm start and what lags the state by a substep change the next reward's bits.

    The elapsed steps are no part of it: a time limit says nothing about what an action is worth (a truncation is
    bootstrapped), so the discounted return does not depend on them.
    """

    def __init__(self, env: Any):
        self._mujoco: Any = importlib.import_module("mujoco")  # compiled: the type checker sees none of its names
        self._env = env.unwrapped

    def step(self, action: Float[np.ndarray, " act"]) -> tuple[Float[np.ndarray, " obs"], float, bool]:
        """One step, whatever a time limit says."""
        observation, reward, terminated, _, _ = self._env.step(action)
        return observation.astype(np.float32), float(reward), bool(terminated)

    def save(self) -> Any:
        """A copy of MuJoCo's data and of what the task itself remembers."""
        memory = {name: copy.deepcopy(getattr(self._env, name)) for name in MEMORY if hasattr(self._env, name)}
        return copy.copy(self._env.data), memory

    def restore(self, saved: Any) -> None:
        """Put a saved state in place; the saved one stays as it is."""
        data, memory = saved
        self._mujoco.mj_copyData(self._env.data, self._env.model, data)
        for name, value in memory.items():
            setattr(self._env, name, copy.deepcopy(value))


def make_restorable(task: str, copies: int, seed: int = 0) -> list[MujocoSimulator] | None:
    """`copies` simulators of `task`; None when it is not MuJoCo's, or keeps more than `save` knows of.

    The second is seen by trying: one copy has to repeat, bit by bit, what another did from a state of the other's.
    """
    try:
        envs = [make_gymnasium(task) for _ in range(max(2, copies))]
    except InputError as error:
        if "imageio" not in str(error):
            raise
        raise InputError(f"Gymnasium makes {task} only where imageio is installed: install ppo-dap[video]") from error
    if _is_mujoco(envs[0]):
        for i, env in enumerate(envs):
            env.reset(seed=seed + i)
        simulators, space = [MujocoSimulator(env) for env in envs], envs[0].action_space
        actions = np.random.default_rng(seed).uniform(space.low, space.high, (2 * PROBE_STEPS, len(space.low)))
        if repeats(simulators[0], simulators[1], actions.astype(space.dtype)):
            return simulators[:copies]
    for env in envs:
        env.close()
    return None


def _is_mujoco(env: Any) -> bool:
    try:
        from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
    except ImportError:  # it needs imageio: whatever was made without it is no task of MuJoCo's
        return False
    return isinstance(env.unwrapped, MujocoEnv)


def repeats(one: Restorable, other: Restorable, actions: Float[np.ndarray, "steps act"]) -> bool:
    """Whether `other`, put into a state that `one` reached halfway, sees what `one` saw after it."""
    half = len(actions) // 2
    for action in actions[:half]:
        one.step(action)
    saved = one.save()
    for action in actions[half : half + half // 3]:
        other.step(action)  # another past, of another length, which must leave no trace
    seen = [one.step(action) for action in actions[half:]]
    other.restore(saved)
    again = [other.step(action) for action in actions[half:]]
    return all(np.array_equal(a, b) and (r, t) == (s, u) for (a, r, t), (b, s, u) in zip(seen, again, strict=True))
