"""Many copies of Striker-v2 on one MuJoCo model: the same bits as Gymnasium's route, without its cost per copy.

The copies are stepped one by one. `mujoco.rollout` is no faster here, and between calls it forgets what the solver
starts from, which changes the bits.
"""

from __future__ import annotations

import importlib
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float

from ppo_dap.tasks.striker_rules import ARM, BODIES, EPISODE_LENGTH, FRAME_SKIP, MODEL, Rewards, start
from ppo_dap.tasks.vector import Transition


class StrikerVectorEnv:
    """Copy i is seeded with `seed` + i; all copies start and end their episodes together."""

    def __init__(self, num_envs: int, seed: int, threads: int = 1):
        mujoco: Any = importlib.import_module("mujoco")  # compiled: the type checker sees none of its names
        self._mujoco, self.num_envs, self._seed = mujoco, num_envs, seed
        self._model = mujoco.MjModel.from_xml_path(str(MODEL))
        self._copies = [mujoco.MjData(self._model) for _ in range(num_envs)]
        bodies = [self._model.body(name).id for name in BODIES]
        # Views, made once: each access of an array of MuJoCo's costs as much as copying it.
        self._controls = [data.ctrl for data in self._copies]
        self._sources = [(d.qpos[:ARM], d.qvel[:ARM], *(d.xipos[b] for b in bodies)) for d in self._copies]
        self._state = np.zeros((num_envs, 2 * ARM + 3 * len(BODIES)))
        ends = np.cumsum([ARM, ARM, 3, 3, 3])[:-1]
        self._targets = [np.split(row, ends) for row in self._state]
        self._rewards = Rewards(num_envs)
        self._shares = [self._copies[i::threads] for i in range(min(threads, num_envs))]
        self._pool = ThreadPoolExecutor(len(self._shares)) if len(self._shares) > 1 else None

    def reset(self) -> Float[np.ndarray, "envs obs"]:
        """First observations, the same in every call."""
        from gymnasium.utils.seeding import np_random

        self._generators = [np_random(self._seed + i)[0] for i in range(self.num_envs)]
        self._restart()
        return self._state.astype(np.float32)

    def step(self, actions: Float[np.ndarray, "envs act"]) -> Transition:
        """One step; every row is valid."""
        rewards, _, _ = self._rewards(self._state[:, 2 * ARM :].reshape(-1, 3, 3), actions)
        for control, action in zip(self._controls, actions, strict=True):
            control[:] = action
        if self._pool is None:
            self._simulate(self._copies)
        else:
            list(self._pool.map(self._simulate, self._shares))
        self._elapsed += 1
        self._observe()
        observations = successors = self._state.astype(np.float32)
        truncated = np.full(self.num_envs, self._elapsed == EPISODE_LENGTH)
        if self._elapsed == EPISODE_LENGTH:
            self._restart()
            observations = self._state.astype(np.float32)
        never, valid = np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        return Transition(successors, rewards.astype(np.float32), never, truncated, valid, observations)

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _simulate(self, copies: list) -> None:
        for data in copies:
            self._mujoco.mj_step(self._model, data, nstep=FRAME_SKIP)

    def _restart(self) -> None:
        for data, generator in zip(self._copies, self._generators, strict=True):
            self._mujoco.mj_resetData(self._model, data)
            data.qpos[:], data.qvel[:] = start(self._model.qpos0, generator)
            self._mujoco.mj_forward(self._model, data)
        self._rewards.restart()
        self._elapsed = 0
        self._observe()

    def _observe(self) -> None:
        for sources, targets in zip(self._sources, self._targets, strict=True):
            for source, target in zip(sources, targets, strict=True):
                target[:] = source
