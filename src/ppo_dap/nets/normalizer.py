"""Running moments: the normaliser's state, kept on the host in float64 and frozen within an iteration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class RunningMoments(NamedTuple):
    """Count, mean and sum of squared deviations of everything seen so far, a column each."""

    count: float
    mean: Float[np.ndarray, " columns"]
    m2: Float[np.ndarray, " columns"]

    @staticmethod
    def create(columns: int) -> RunningMoments:
        """Moments of nothing: mean 0, and standard deviation 1 until two rows were seen."""
        return RunningMoments(0.0, np.zeros(columns), np.zeros(columns))

    def update(self, rows: Float[np.ndarray, "rows columns"]) -> RunningMoments:
        """Moments after `rows` as well (parallel update of Chan et al. 1979), in float64."""
        if len(rows) == 0:
            return self
        rows = rows.astype(np.float64)
        mean, n = rows.mean(0), float(len(rows))
        m2 = np.square(rows - mean).sum(0)
        count = self.count + n
        delta = mean - self.mean
        return RunningMoments(
            count, self.mean + delta * (n / count), self.m2 + m2 + delta**2 * (self.count * n / count)
        )

    @property
    def std(self) -> Float[np.ndarray, " columns"]:
        """Standard deviation; 1 where nothing has varied yet, so that dividing by it is always safe."""
        if self.count < 2:
            return np.ones_like(self.mean)
        variance = self.m2 / self.count
        return np.sqrt(np.where(variance < 1e-8, 1.0, variance))


class RewardScale(NamedTuple):
    """Rewards are divided by the running standard deviation of the discounted return (never centred)."""

    moments: RunningMoments
    discounted: Float[np.ndarray, " envs"]
    """What the next reward is added to: gamma times the discounted return so far, 0 at an episode's start."""

    @staticmethod
    def create(num_envs: int) -> RewardScale:
        """The scale before any reward: 1."""
        return RewardScale(RunningMoments.create(1), np.zeros(num_envs))

    def update(
        self,
        rewards: Float[np.ndarray, "time envs"],
        ended: Bool[np.ndarray, "time envs"],
        valid: Bool[np.ndarray, "time envs"],
        gamma: float,
    ) -> RewardScale:
        """The scale after one rollout; rows that are not `valid` do not count."""
        discounted, seen = self.discounted.copy(), np.empty(rewards.shape)
        # Worked out for all rows at once; the loop is what has to be one.
        factors = np.where(ended, 0.0, np.where(valid, gamma, 1.0))
        for row, reward, factor in zip(seen, np.where(valid, rewards, 0.0), factors, strict=True):
            discounted += reward
            row[:] = discounted
            discounted *= factor
        return RewardScale(self.moments.update(seen[valid][:, None]), discounted)

    def restart(self) -> RewardScale:
        """The same scale with the running returns of the environments at 0, for environments that start anew."""
        return RewardScale(self.moments, np.zeros_like(self.discounted))

    @property
    def std(self) -> float:
        """What rewards are divided by."""
        return float(self.moments.std[0])
