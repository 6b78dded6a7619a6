"""What a task id stands for: spaces, bounds and which backend steps it."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError, unknown

# Served by EnvPool with the reference physics (named here since importing envpool takes seconds).
ENVPOOL_TASKS = frozenset(
    f"{name}-v{version}"
    for name, versions in {
        "Ant": (3, 4, 5),
        "HalfCheetah": (3, 4, 5),
        "Hopper": (3, 4, 5),
        "Humanoid": (3, 4, 5),
        "HumanoidStandup": (2, 4, 5),
        "InvertedDoublePendulum": (2, 4, 5),
        "InvertedPendulum": (2, 4, 5),
        "Pusher": (2, 4, 5),
        "Reacher": (2, 4, 5),
        "Swimmer": (3, 4, 5),
        "Walker2d": (3, 4, 5),
    }.items()
    for version in versions
)


@dataclass(frozen=True)
class TaskSpec:
    """A continuous-control task."""

    task: str
    observation_size: int
    action_low: Float[np.ndarray, " act"]
    action_high: Float[np.ndarray, " act"]
    backend: Literal["envpool", "gymnasium"]

    @property
    def action_size(self) -> int:
        """Number of action dimensions."""
        return len(self.action_low)


def describe(task: str) -> TaskSpec:
    """Spaces of `task`; raises `InputError` for an unknown id or spaces that are not boxes."""
    if task in ENVPOOL_TASKS:
        import envpool

        env: Any = envpool.make_gymnasium(task, num_envs=1, num_threads=1)
        backend = "envpool"
    else:
        env, backend = make_gymnasium(task), "gymnasium"
    try:
        return _spec(task, env.observation_space, env.action_space, backend)
    finally:
        env.close()


def make_gymnasium(task: str) -> Any:
    """One Gymnasium environment; raises `InputError` that names the nearest id."""
    import gymnasium

    try:
        return gymnasium.make(task)
    except gymnasium.error.UnregisteredEnv:
        known = set(gymnasium.registry) | ENVPOOL_TASKS
        near = difflib.get_close_matches(task, known, n=1)
        raise unknown("task", task, known if near else {t for t in ENVPOOL_TASKS if t.endswith("v5")}) from None
    except (gymnasium.error.Error, ImportError) as error:
        raise InputError(f"task {task!r} cannot be made: {' '.join(str(error).split())}") from error


def _spec(task: str, observation_space: Any, action_space: Any, backend: Any) -> TaskSpec:
    import gymnasium

    for what, space in (("observation", observation_space), ("action", action_space)):
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise InputError(
                f"task {task!r} has the {what} space {space}: ppo-dap needs a one-dimensional box of real numbers, "
                "as Pendulum-v1 has"
            )
    low, high = action_space.low.astype(np.float32), action_space.high.astype(np.float32)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(f"task {task!r} has unbounded actions: ppo-dap scales actions by finite bounds")
    return TaskSpec(task, observation_space.shape[0], low, high, backend)
