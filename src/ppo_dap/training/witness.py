"""A second account of what enters an iteration's update, kept beside the host code that prepares it.

The data-flow proof begins at the update's arguments. Those come from numpy code that no proof sees: the rollout, the
statistics, the state that one iteration leaves to the next. This is the check on that code.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from ppo_dap.nets.policy import unscale_actions
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.tasks import TaskSpec, Transition, VectorEnv
from ppo_dap.training.state import TrainState


class Watched:
    """Environments that remember what they showed, what was sent to them and what came of it."""

    def __init__(self, env: VectorEnv):
        self.num_envs, self._env = env.num_envs, env
        self._seen: list[tuple[np.ndarray, ...]] = []

    def reset(self) -> np.ndarray:
        """First observations."""
        self._shown = self._env.reset()
        return self._shown

    def step(self, actions: np.ndarray) -> Transition:
        """One step. What it returns is read-only: whoever changed it in place would change what is remembered."""
        step = self._env.step(actions)
        for array in (step.next_observations, step.rewards, step.observations):
            array.flags.writeable = False
        self._seen.append((self._shown, actions, *step[:5]))
        self._shown = step.observations
        return step

    def close(self) -> None:
        """Free what the environments hold."""
        self._env.close()

    def recall(self) -> list[np.ndarray]:
        """What was seen since the last call, a row a transition: observations, actions, and the fields of `Transition`
        up to `valid`.
        """
        seen, self._seen = self._seen, []
        return [np.concatenate(column) for column in zip(*seen, strict=True)]


class Witness:
    """Says of each iteration how much of what entered its update is what it should be."""

    def __init__(self, state: TrainState, spec: TaskSpec, seed: Sequence[int]):
        """`state` as the run starts or goes on with; `seed` of the rollouts' noise, less the iteration."""
        self._spec, self._seed = spec, tuple(seed)
        self._left = self._carried(state)

    def watch(self, env: VectorEnv) -> Watched:
        """`env`, whose steps count from now on."""
        self._watched = Watched(env)
        return self._watched

    def before(self, state: TrainState) -> None:
        """Call it with the state that an iteration begins with."""
        carried = self._carried(state)
        self._untouched = all(now is then for now, then in zip(carried, self._left, strict=True))
        self._std, self._counts = np.exp(np.asarray(state.learner.ppo.actor.log_std)), self._rows(state)

    def after(self, state: TrainState, rollout: Sequence[Rollout]) -> float:
        """Call it with the state that the iteration leaves, before its number is raised, and with its rollout.

        The share of the rollout's rows that the environments showed and that the policy's own noise, by the run's seed,
        made. 0 where the networks or statistics that the iteration began with are not those that the one before had
        left, or where the statistics have not seen each of its transitions once.
        """
        shown, sent, successors, rewards, terminated, truncated, valid = self._watched.recall()
        flat = _flat(rollout)
        noise = np.random.default_rng([*self._seed, state.iteration]).standard_normal(sent.shape, dtype=np.float32)
        sampled = flat.means + self._std * noise
        pairs = (
            (flat.observations, shown),
            (flat.actions, sampled),
            (unscale_actions(sampled, self._spec.action_low, self._spec.action_high), sent),
            (flat.next_observations, successors),
            (flat.rewards, rewards),
            (flat.terminated, terminated),
            (flat.truncated, truncated),
            (flat.valid, valid),
            (flat.state_ids, state.iteration * len(valid) + np.arange(len(valid))),
        )
        counts = [before + np.count_nonzero(valid) for before in self._counts]
        whole = self._untouched and counts == self._rows(state) and all(a.shape == b.shape for a, b in pairs)
        self._left = self._carried(state)
        if not whole:
            return 0.0
        right = np.ones(len(valid), bool)
        for a, b in pairs:
            if not np.array_equal(a, b):  # nearly always they are, and the comparison by rows costs ten times as much
                right &= (a == b) if a.ndim == 1 else (a == b).all(-1)
        return float(right.mean())

    @staticmethod
    def _carried(state: TrainState) -> tuple[Any, ...]:
        return state.learner, state.observations, state.reward_scale.moments

    @staticmethod
    def _rows(state: TrainState) -> list[float]:
        return [state.observations.count, state.reward_scale.moments.count]


def _flat(parts: Sequence[Rollout]) -> SimpleNamespace:
    """The columns of a rollout, a row a transition."""
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    return SimpleNamespace(**{name: x.reshape(-1, *x.shape[2:]) for name, x in columns.items()})
