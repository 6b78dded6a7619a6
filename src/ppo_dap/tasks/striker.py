"""Striker-v2: a robot arm strikes a ball, which has to come to rest in a cup.

The task left Gym in version 0.22; docs/tasks.md defines it as it is here. Gymnasium alone imports this module, when it
makes the task that the catalogue registers, so its heavy imports can stand at the top, where the base class needs them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.spaces import Box

from ppo_dap.tasks.striker_rules import ARM, BODIES, FRAME_SKIP, MODEL, Rewards, start


class StrikerEnv(MujocoEnv):
    """One copy of Striker-v2.

    Actions: 7 torques of the arm's motors in [-3, 3]. Observations (23): 7 joint angles (rad), 7 joint velocities
    (rad/s), and the positions of tip, ball and goal (m), which MuJoCo computes at the start of its last substep, as in
    every task of Gymnasium. Rewards are of the state before the step; an episode never terminates, and the registered
    task is truncated after 100 steps. `info` holds `reward_dist` and `reward_ctrl`, without their weights.
    """

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, **options: Any):
        """`options` are those of `MujocoEnv` that concern rendering."""
        space = Box(-np.inf, np.inf, (2 * ARM + 3 * len(BODIES),), np.float64)
        camera = {"distance": 4.0}
        super().__init__(str(MODEL), FRAME_SKIP, space, default_camera_config=camera, **options)
        self._bodies = [self.model.body(name).id for name in BODIES]
        self._rewards = Rewards(1)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, float]]:
        """One step of 0.05 s."""
        reward, distance, control = self._rewards(self.data.xipos[None, self._bodies], np.asarray(action)[None])
        self.do_simulation(action, self.frame_skip)
        if self.render_mode == "human":
            self.render()
        info = {"reward_dist": float(distance[0]), "reward_ctrl": float(control[0])}
        return self._observation(), float(reward[0]), False, False, info

    def reset_model(self) -> np.ndarray:
        """Start an episode; `reset` calls it."""
        self._rewards.restart()
        self.set_state(*start(self.init_qpos, self.np_random))
        return self._observation()

    def _observation(self) -> np.ndarray:
        data = self.data
        return np.concatenate([data.qpos[:ARM], data.qvel[:ARM], data.xipos[self._bodies].ravel()])
