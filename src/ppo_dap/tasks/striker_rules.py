"""Striker-v2's rules in plain numpy, for one copy and for many: how an episode starts, and what a step is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

MODEL = Path(__file__).parent / "assets" / "striker.xml"
BODIES = ("tips_arm", "object", "goal")
"""Tip, ball and goal: the bodies whose centres of mass are observed and rewarded, in this order."""
ARM = 7
"""Joints of the arm; they come first in positions and velocities."""
FRAME_SKIP = 5
EPISODE_LENGTH = 100
STRIKE_DISTANCE = 0.1
"""The tip strikes when it is nearer than this to the ball (m)."""
BALL_START = np.array([0.5, -0.175])
GOAL_LOW, GOAL_HIGH = np.array([0.15, 0.1]), np.array([0.7, 1.0])


def start(
    initial_position: Float[np.ndarray, " 16"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, " 16"], Float[np.ndarray, " 15"]]:
    """Positions and velocities of a new episode.

    `initial_position` is the model's own: the arm stretched out, the goal's height, no rotation. The last coordinate of
    the goal's quaternion turns its cup roughly towards the ball; MuJoCo normalises the quaternion.
    """
    position, velocity = initial_position.copy(), np.zeros(15)
    # The old task drew again within 0.17 m of the ball; no goal of this range lies nearer than 0.275 m.
    goal = rng.uniform(GOAL_LOW, GOAL_HIGH)
    difference = BALL_START - goal
    velocity[:ARM] = rng.uniform(-0.1, 0.1, ARM)
    position[7:9] = BALL_START[::-1]  # the slide along y comes first
    position[9:11] = goal
    position[15] = -np.arctan(difference[0] / (difference[1] + 1e-8)) / 3.14
    return position, velocity


class Rewards:
    """Rewards of n copies, with what an episode has to remember for them."""

    def __init__(self, copies: int):
        self._copies = copies
        self.restart()

    def restart(self) -> None:
        """Forget the episode, in all copies."""
        self._least = np.full(self._copies, np.inf)
        self._struck = np.zeros(self._copies, bool)
        self._strike = np.zeros((self._copies, 3))

    def __call__(
        self, bodies: Float[np.ndarray, "n 3 3"], actions: Float[np.ndarray, "n 7"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Reward, its distance part and its control part (both unweighted) of a step.

        `bodies` are the positions of `BODIES` before the step (n copies, body, xyz in m), `actions` as the policy gave
        them, even where the motors cannot follow.
        """
        tip, ball, goal = bodies[:, 0], bodies[:, 1], bodies[:, 2]
        self._least = np.minimum(self._least, _length(ball - goal))
        first = ~self._struck & (_length(ball - tip) < STRIKE_DISTANCE)
        self._strike[first] = tip[first]
        self._struck |= first
        near = -_length(ball - np.where(self._struck[:, None], self._strike, tip))
        distance, control = -self._least, -np.square(actions.astype(np.float64)).sum(-1)
        return 3 * distance + 0.1 * control + 0.5 * near, distance, control


def _length(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Norms; not np.linalg.norm, whose bits for one vector and for many differ."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)
