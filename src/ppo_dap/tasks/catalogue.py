"""What a task id stands for: spaces, bounds, which backend steps it, and what is known of the paper's eight tasks."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError, unknown
from ppo_dap.tasks.own_class import is_class_path, make_own
from ppo_dap.tasks.striker_rules import EPISODE_LENGTH

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
    """A continuous-control task; what is None is not known."""

    task: str
    observation_size: int
    action_low: Float[np.ndarray, " act"]
    action_high: Float[np.ndarray, " act"]
    backend: Literal["envpool", "mujoco", "gymnasium"]
    episode_length: int | None = None
    """Steps after which an episode is truncated."""
    terminates: bool | None = None
    """Whether an episode can end before that."""
    random_return: float | None = None
    """Mean return of uniformly random actions."""
    expert_return: float | None = None
    """Return of an expert, as D4RL publishes it."""
    gamma: float | None = None
    """Discount that training takes where the user sets none; None: the recipe's."""

    @property
    def action_size(self) -> int:
        """Number of action dimensions."""
        return len(self.action_low)


def _listed(task: str, sizes: tuple[int, int], bound: float, length: int, terminates: bool, **known: Any) -> TaskSpec:
    """A row of the catalogue: `sizes` of observation and action, every action within -bound and bound."""
    high = np.full(sizes[1], bound, np.float32)
    high.setflags(write=False)
    low = -high
    low.setflags(write=False)
    backend = "envpool" if task in ENVPOOL_TASKS else "mujoco"
    return TaskSpec(task, sizes[0], low, high, backend, length, terminates, **known)


STRIKER = "Striker-v2"
NAMESPACED = {f"ppo_dap/{STRIKER}": STRIKER}
"""Ids under which Gymnasium knows our own tasks -> their short ids."""

CATALOGUE: dict[str, TaskSpec] = {
    spec.task: spec
    for spec in (
        _listed("Ant-v5", (105, 8), 1.0, 1000, True, random_return=-93.4, expert_return=3879.7),
        _listed("HalfCheetah-v5", (17, 6), 1.0, 1000, False, random_return=-246.5, expert_return=12135.0),
        _listed("Hopper-v5", (11, 3), 1.0, 1000, True, random_return=17.3, expert_return=3234.3),
        _listed("HumanoidStandup-v5", (348, 17), 0.4, 1000, False, random_return=33608.2),
        _listed("Pusher-v5", (23, 7), 2.0, 100, False, random_return=-148.1),
        _listed(STRIKER, (23, 7), 3.0, EPISODE_LENGTH, False, random_return=-485.9),
        _listed("Swimmer-v5", (8, 2), 1.0, 1000, False, random_return=-2.1, gamma=0.9999),
        _listed("Walker2d-v5", (17, 6), 1.0, 1000, True, random_return=0.3, expert_return=4592.3),
    )
}
"""The eight tasks of the paper (5.1.1), at the versions that exist.

Random returns are means over 20 episodes, as `python -m ppo_dap.tasks.random_returns` prints them. Expert returns are
D4RL's, of the v2 tasks, whose rewards are nearly those of v5; for HumanoidStandup, Pusher, Striker and Swimmer nobody
has published one that can be trusted. Why Swimmer has a discount of its own is in docs/tasks.md.
"""


def describe(task: str) -> TaskSpec:
    """What is known of `task`; raises `InputError` for an unknown id or spaces that are not boxes.

    A task of the catalogue is looked up; of every other a copy is made, to ask it for its spaces.
    """
    if not isinstance(task, str) or task.startswith(":") or task.count(":") > 1:
        raise InputError(f"task must be a Gymnasium id or package.module:ClassName, not {task!r}")
    task = NAMESPACED.get(task, task)
    if task in CATALOGUE:
        return CATALOGUE[task]
    if task in ENVPOOL_TASKS:
        import envpool

        env: Any = envpool.make_gymnasium(task, num_envs=1, num_threads=1)
        backend = "envpool"
    else:
        env, backend = make_gymnasium(task), "gymnasium"
    try:
        return _spec(task, env, backend)
    finally:
        env.close()


def make_gymnasium(task: str, **options: Any) -> Any:
    """One Gymnasium environment of an id, or of a class by its import path `package.module:ClassName`.

    `options` go to `gymnasium.make` (such as `render_mode`), or to the class. Raises `InputError` that names the
    nearest id.
    """
    if is_class_path(task):
        return make_own(task, **options)
    import gymnasium

    _register()
    registered = {short: long for long, short in NAMESPACED.items()}
    try:
        return gymnasium.make(registered.get(task, task), **options)
    except gymnasium.error.UnregisteredEnv:
        known = set(gymnasium.registry) | ENVPOOL_TASKS | set(CATALOGUE)
        near = difflib.get_close_matches(task, known, n=1)
        raise unknown("task", task, known if near else CATALOGUE) from None
    except Exception as error:  # whatever an environment, or the module that registers it, raises while it is made
        raise InputError(f"task {task!r} cannot be made: {' '.join(str(error).split())}") from error


def _register() -> None:
    """Tell Gymnasium of our own tasks, once; it imports their modules when it makes them."""
    import gymnasium

    (name,) = NAMESPACED
    if name not in gymnasium.registry:
        gymnasium.register(name, "ppo_dap.tasks.striker:StrikerEnv", max_episode_steps=EPISODE_LENGTH)


def _spec(task: str, env: Any, backend: Any) -> TaskSpec:
    import gymnasium

    for what in ("observation", "action"):
        space = getattr(env, f"{what}_space", None)
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or space.shape[0] < 1:
            raise InputError(
                f"task {task!r} has the {what} space {space}: ppo-dap needs a one-dimensional box of real numbers, "
                "as Pendulum-v1 has"
            )
    low, high = env.action_space.low.astype(np.float32), env.action_space.high.astype(np.float32)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(f"task {task!r} has unbounded actions: ppo-dap scales actions by finite bounds")
    return TaskSpec(task, env.observation_space.shape[0], low, high, backend)
