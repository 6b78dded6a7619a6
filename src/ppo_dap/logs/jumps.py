"""Unmarked episode ends: rows whose successor cannot be the next state of the same episode.

Physics ties the change of a state to the state, the action and the other columns' changes: a position moves as its
velocity says. A joint Gaussian of (s, a, s' - s), fitted to the three quarters of the rows that agree best with one
another, predicts each column of the change from everything else; a reset breaks the prediction in most columns at
once, a contact in some of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ppo_dap.logs.dataset import Logs

STRONG, ISOLATED = 40.0, 4.0
"""A mismatch this many times the usual one, and `ISOLATED` times those of the rows around it, is a jump by itself.
Without a jump: at most 45 on 11 tasks under random, linear, periodic and near-still actions, but 121 where HalfCheetah
drops and comes to rest, row upon row, which `ISOLATED` spares. With one: mostly 50 to 1000."""
WEAK, NEAR, NEARER, COMBINED = 3.0, 0.5, 2.5, 8.0
"""A weaker mismatch, above `WEAK`, is a jump where it leads back to a known start: to within `NEAR` (usual deviations,
90th percentile over columns), by a factor of at least `NEARER`, and `COMBINED` times the distance left is below the
mismatch. Resets of HalfCheetah and Ant are 3 to 20 strong, as hard contacts are, but no contact led back to a start."""
ONE_IN = 10_000
"""Up to one found row in so many is no warning: heavy tails have such rows, and so few missing ends do no harm."""

MIN_ROWS = 100
MAX_FIT_ROWS = 50_000
MAX_COLUMNS = 48
AGREEING = 0.75  # share of rows that the fit keeps, so that up to a quarter of the rows may be resets
ROUNDS = 4
RIDGE = 1e-4
CUT = 30.0  # deviations at which a value is cut in the fit
MAX_STARTS = 8
CHUNK = 16_384


@dataclass(frozen=True)
class Jumps:
    """`rows` (jumps,): rows after which the state jumps.

    `mismatch` (rows,): each row's mismatch over the usual one, nan where it was not looked at (an episode's last row,
    or logs too small or without a moving column, for which `num_columns` is 0); `num_fit_rows`: rows of the fit.
    """

    rows: Int[np.ndarray, " jumps"]
    mismatch: Float[np.ndarray, " rows"]
    num_columns: int
    num_fit_rows: int

    @property
    def suspicious(self) -> bool:
        """Whether there are more than the one in `ONE_IN` that heavy tails may give."""
        return len(self.rows) > len(self.mismatch) / ONE_IN


def find_jumps(logs: Logs) -> Jumps:
    """Rows t within an episode (not its last row) after which the state jumps, as a reset without a mark does."""
    inside = np.flatnonzero(~logs.episode_ends[:-1])
    mismatch = np.full(logs.num_rows, np.nan)
    none = Jumps(np.zeros(0, np.int64), mismatch, 0, 0)
    if len(inside) < MIN_ROWS:
        return none
    fit_rows = inside[:: -(-len(inside) // MAX_FIT_ROWS)]
    model = _fit(logs, fit_rows)
    if model is None:
        return none
    for start in range(0, len(inside), CHUNK):
        rows = inside[start : start + CHUNK]
        mismatch[rows] = model.mismatch(logs.observations[rows], logs.actions[rows], logs.observations[rows + 1])
    usual = mismatch[fit_rows]
    # Where more than a tenth of the rows are resets the 90th percentile is itself one; without any it is below this.
    mismatch /= max(min(np.quantile(usual, 0.9), 4 * np.quantile(usual, 0.75)), 1e-9)
    candidates = inside[mismatch[inside] > WEAK]
    strength = mismatch[candidates]
    strong = (strength > STRONG) & (strength > ISOLATED * _around(mismatch, candidates))
    found = candidates[strong]
    for _ in range(2):  # what the first pass finds are more starts, where the second finds what landed near those
        starts = logs.observations[_known_starts(logs, found)]
        before = model.distance(logs.observations[candidates], starts)
        after = model.distance(logs.observations[candidates + 1], starts)
        weak = (after < NEAR) & (before > NEARER * after) & (strength > COMBINED * after)
        found = candidates[strong | weak]
    return Jumps(found, mismatch, model.num_changes, len(fit_rows))


def _known_starts(logs: Logs, found: Int[np.ndarray, " jumps"]) -> Int[np.ndarray, " starts"]:
    """Some of the rows that start an episode, marked or found."""
    starts = np.unique(np.concatenate([[0], np.flatnonzero(logs.episode_ends[:-1]) + 1, found + 1]))
    return starts[np.linspace(0, len(starts) - 1, min(MAX_STARTS, len(starts))).astype(int)]


def _around(mismatch: Float[np.ndarray, " rows"], rows: Int[np.ndarray, " chosen"]) -> Float[np.ndarray, " chosen"]:
    """90th percentile of the mismatch of the ten rows before and the ten after each row, without itself."""
    offsets = np.concatenate([np.arange(-10, 0), np.arange(1, 11)])
    result = np.empty(len(rows))
    padded = np.concatenate([np.full(10, np.nan), mismatch, np.full(10, np.nan)])
    for start in range(0, len(rows), CHUNK):
        part = rows[start : start + CHUNK]
        around = padded[part[:, None] + 10 + offsets]
        empty = np.isnan(around).all(1)
        around[empty] = 0.0
        result[start : start + len(part)] = np.nanquantile(around, 0.9, axis=1)
    return result


@dataclass(frozen=True)
class _Columns:
    """Columns that really move, and how to standardise them: a column that rests in most rows has no usual move."""

    used: np.ndarray
    middle: np.ndarray
    scale: np.ndarray

    @staticmethod
    def of(values: Float[np.ndarray, "rows columns"]) -> _Columns:
        low, quarter, middle, three, high = np.percentile(values, [10, 25, 50, 75, 90], axis=0)
        scale = (high - low) / 2.563
        return _Columns(np.flatnonzero((scale > 1e-7) & (three - quarter > 0.135 * scale)), middle, scale)

    def only(self, chosen: Int[np.ndarray, " chosen"]) -> _Columns:
        return _Columns(np.intersect1d(self.used, chosen), self.middle, self.scale)

    def __call__(self, values: Float[np.ndarray, "rows columns"], most: float) -> Float[np.ndarray, "rows used"]:
        """Standardised float64 values, cut at `most` deviations so that no single column drowns the others."""
        chosen = values[:, self.used].astype(np.float64)
        return np.clip((chosen - self.middle[self.used]) / self.scale[self.used], -most, most)


@dataclass(frozen=True)
class _Model:
    """The joint Gaussian of standardised (s, a, s' - s): its mean, and what gives each change's residual."""

    states: _Columns
    actions: _Columns
    changes: _Columns
    mean: np.ndarray
    residual: np.ndarray
    usual: np.ndarray

    @property
    def num_changes(self) -> int:
        return len(self.changes.used)

    def mismatch(self, states: np.ndarray, actions: np.ndarray, following: np.ndarray) -> Float[np.ndarray, " rows"]:
        """Median over columns of |residual|, each in its own usual size."""
        change = following.astype(np.float64) - states
        joint = np.concatenate([self.states(states, 1e3), self.actions(actions, 1e3), self.changes(change, 1e3)], 1)
        return np.median(np.abs((joint - self.mean) @ self.residual) / self.usual, axis=1)

    def distance(self, states: np.ndarray, starts: np.ndarray) -> Float[np.ndarray, " rows"]:
        """To the nearest of `starts`: 90th percentile over columns, in usual deviations."""
        if not len(self.states.used) or not len(states):
            return np.full(len(states), np.inf)
        here, there = self.states(states, 1e3), self.states(starts, 1e3)
        return np.min([np.quantile(np.abs(here - start), 0.9, axis=1) for start in there], axis=0)


def _fit(logs: Logs, rows: Int[np.ndarray, " fit"]) -> _Model | None:
    """The model of the given rows; None when no column moves."""
    observations, following = logs.observations[rows], logs.observations[rows + 1]
    change = following.astype(np.float64) - observations
    states, actions, changes = _Columns.of(observations), _Columns.of(logs.actions[rows]), _Columns.of(change)
    most = min(MAX_COLUMNS, len(rows) // 20)
    if max(len(states.used), len(changes.used)) > most:
        states, changes = _best(observations, change, states, changes, most)
    if not len(changes.used):
        return None
    joint = np.concatenate([states(observations, CUT), actions(logs.actions[rows], CUT), changes(change, CUT)], axis=1)
    size = len(changes.used)
    mismatch = np.median(np.abs(joint[:, -size:]), axis=1)
    for _ in range(ROUNDS):
        agreeing = joint[mismatch <= np.quantile(mismatch, AGREEING)]
        mean = agreeing.mean(0)
        covariance = np.atleast_2d(np.cov(agreeing.T)) + RIDGE * np.eye(joint.shape[1])
        precision = np.linalg.inv(covariance)
        # Row j of a precision matrix over its diagonal is z_j less its best linear prediction from all the others.
        residual = (precision / np.diag(precision))[:, -size:]
        errors = np.abs((joint - mean) @ residual)
        usual = np.maximum(np.median(errors, axis=0), 1e-6)
        mismatch = np.median(errors / usual, axis=1)
    return _Model(states, actions, changes, mean, residual, usual)


def _best(
    observations: np.ndarray, change: np.ndarray, states: _Columns, changes: _Columns, most: int
) -> tuple[_Columns, _Columns]:
    """The columns whose change follows another column best (a position its velocity), with those others."""
    # The middle of the step: q' - q = dt (v + v') / 2 holds better than q' - q = dt v.
    middle = states(observations + change / 2, 3.0)
    move = changes(change, 3.0)
    correlation = _unit(move).T @ _unit(middle)
    if not correlation.size:
        return states, changes.only(changes.used[:most])
    order = np.argsort(-np.abs(correlation).max(1), kind="stable")[: max(1, most // 2)]
    partners = np.abs(correlation[order]).argmax(1)
    chosen = np.union1d(changes.used[order], states.used[partners])
    return states.only(chosen), changes.only(chosen)


def _unit(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    centred = values - values.mean(0)
    return centred / np.maximum(np.linalg.norm(centred, axis=0), 1e-12)
