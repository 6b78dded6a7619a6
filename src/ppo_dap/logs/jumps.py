"""Unmarked episode ends: rows whose successor cannot be the next state of the same episode."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ppo_dap.logs.dataset import Logs

JUMP = 20.0
"""A move of the whole state this many times the 99th percentile of moves is a jump."""
MISMATCH = 10.0
"""A mismatch this many times the usual one is a jump. Measured on seven MuJoCo tasks, 3000 rows of random and of
periodic actions: at most 6.7 without a jump; with one 10 to 1000, but 2 to 6 on HalfCheetah and Ant, whose unmarked
ends are mostly missed."""
TAIL = 4.0  # most that the 99th percentile may count in 95th ones
CORRELATION = 0.9  # squared; below this a pair of columns is not position and velocity
MAX_FIT_ROWS = 100_000
MIN_PAIRS = 20


@dataclass(frozen=True)
class Jumps:
    """`rows` (jumps,): the rows after which the state jumps; `num_pairs`: position-velocity pairs that were found."""

    rows: Int[np.ndarray, "jumps"]
    num_pairs: int


def find_jumps(logs: Logs) -> Jumps:
    """Rows t within an episode (not its last row) after which the state jumps, as a reset without a mark does.

    The size of ||s' - s|| alone finds no reset of a locomotion task: velocities change as much at each step. So a row
    also counts when positions do not move as their velocities say, q' - q = dt (v + v') / 2 (the trapezoid rule);
    which column is whose velocity is read off the data.
    """
    inside = np.flatnonzero(~logs.episode_ends[:-1])
    if len(inside) < MIN_PAIRS:
        return Jumps(np.zeros(0, np.int64), 0)
    state, following = logs.observations[inside], logs.observations[inside + 1]
    move = np.linalg.norm((following - state).astype(np.float64), axis=1)
    jumped = move > JUMP * max(float(np.quantile(move, 0.99)), 1e-12)
    mismatch, num_pairs = _mismatch(state, following)
    return Jumps(inside[jumped | (mismatch > MISMATCH)], num_pairs)


def _mismatch(
    state: Float[np.ndarray, "rows obs"], following: Float[np.ndarray, "rows obs"]
) -> tuple[Float[np.ndarray, "rows"], int]:
    """How badly each row breaks the trapezoid rule, in its usual size; number of pairs."""
    stride = -(-len(state) // MAX_FIT_ROWS)
    fit_state, fit_following = state[::stride].astype(np.float64), following[::stride].astype(np.float64)
    change, mean = _centred(fit_following - fit_state), _centred((fit_state + fit_following) / 2)
    change_variance, mean_variance = (change**2).mean(0), (mean**2).mean(0)
    covariance = change.T @ mean / len(change)
    scale = change_variance[:, None] * mean_variance
    squared = np.where(scale > 1e-20, covariance**2 / np.maximum(scale, 1e-20), 0.0)
    partner = squared.argmax(1)
    positions = np.flatnonzero(squared.max(1) > CORRELATION)
    ratios = []
    for position in positions:
        velocity = partner[position]
        dt = covariance[position, velocity] / mean_variance[velocity]
        average = (state[:, velocity].astype(np.float64) + following[:, velocity]) / 2
        error = following[:, position].astype(np.float64) - state[:, position] - dt * average
        error = np.abs(error - np.median(error))
        # The floor keeps rounding noise of an exact rule from counting as a mismatch.
        floor = 0.01 * np.sqrt(change_variance[position])
        # Where more than 1 % of rows are jumps the 99th percentile is itself one; without any it is below this.
        usual = min(float(np.quantile(error, 0.99)), TAIL * float(np.quantile(error, 0.95)))
        ratios.append(error / max(usual, floor))
    if not ratios:
        return np.zeros(len(state)), 0
    # A reset moves every position; with three pairs or more, ask two to agree, so that one odd column does not warn.
    order = np.sort(np.stack(ratios), axis=0)
    return order[-1] if len(ratios) < 3 else order[-2], len(ratios)


def _centred(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Cut the outer 5 % (which hold the jumps looked for, and would hide the pairs) and subtract the mean."""
    low, high = np.percentile(values, [5, 95], axis=0)
    values = np.clip(values, low, high)
    return values - values.mean(0)
