"""What rows with nearly the same state did: how far a state settles the action, and whether episodes differ in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ppo_dap.logs.dataset import Logs

MAX_ROWS = 10_000
"""Rows that are compared, drawn by `SEED`: nearest neighbours among more say the same and cost more."""
SEED = 0
NEIGHBOURS = 5
LOOKED_AT = 64  # nearest rows among which neighbours of other episodes are taken
MAX_DIMENSIONS = 12  # of the whitened state: nearness means little in more
MIN_QUERIES = 100
MIN_EPISODES = 8
PERMUTATIONS = 999


@dataclass(frozen=True)
class Neighbours:
    """Rows with their nearest neighbours among other episodes' rows; empty where there are too few of either."""

    rows: Int[np.ndarray, " queries"]
    spread: Float[np.ndarray, " queries"]
    """Mean squared difference of the actions of a row and its neighbours, over that of any two rows: 0 where the state
    settles the action, about 1 where it says nothing about it."""
    distance: Float[np.ndarray, " queries"]
    """To the neighbours in the whitened state, over that of any two rows."""
    residual: Float[np.ndarray, "queries act"]
    """Action less the neighbours' mean and less what the state's distance to them accounts for linearly, over the
    action's standard deviation."""
    states: Float[np.ndarray, "queries whitened"]
    num_rows: int
    """Rows that neighbours were taken from."""


@dataclass(frozen=True)
class Mixture:
    """Whether rows of one episode share what their actions have apart from those of other episodes' near states.

    `share`: of the action's variance, what the episode accounts for at a given state; `p_value`: of a permutation test
    that pairs the first halves of episodes with other episodes' second halves; `halves` (2, episodes): the
    residuals' mean of each half along the direction in which the halves agree most.
    """

    share: float
    p_value: float
    halves: Float[np.ndarray, "2 episodes"]


def find_neighbours(logs: Logs) -> Neighbours:
    """Neighbours of up to `MAX_ROWS` rows, by scipy's k-d tree."""
    from scipy.spatial import KDTree

    rng = np.random.default_rng(SEED)
    count = min(logs.num_rows, MAX_ROWS)
    rows = np.sort(rng.choice(logs.num_rows, count, replace=False))
    episode, second = _places(logs, rows)
    states = _whiten(logs.observations[rows].astype(np.float64))
    actions = logs.actions[rows].astype(np.float64)
    actions = actions / np.maximum(actions.std(0), 1e-12)
    looked_at = min(LOOKED_AT, count)
    if states.shape[1] == 0 or episode[0] == episode[-1] or looked_at <= NEIGHBOURS:
        return _none(logs, count)
    _, near = KDTree(states).query(states, k=looked_at)
    # The two halves of an episode look at different rows, or a neighbour of both would make them alike.
    pool = rng.random(count) < 0.5
    other = (episode[near] != episode[:, None]) & (pool[near] == second[:, None])
    # The first NEIGHBOURS places of other episodes: a stable sort moves them to the front, in their order.
    order = np.argsort(~other, axis=1, kind="stable")[:, :NEIGHBOURS]
    enough = np.flatnonzero(other.sum(1) >= NEIGHBOURS)
    if len(enough) < MIN_QUERIES:
        return _none(logs, count)
    near = np.take_along_axis(near, order, axis=1)[enough]
    varying = actions.std(0) > 0.5  # 1 or, for a column that never changes, 0
    differences = actions[enough, None] - actions[near]
    spread = (differences[:, :, varying] ** 2).mean((1, 2)) / 2 if varying.any() else np.zeros(len(enough))
    steps = states[enough, None] - states[near]
    distance = np.sqrt((steps**2).sum(2).mean(1) / (2 * states.shape[1]))
    residual, step = differences.mean(1), steps.mean(1)
    gram = step.T @ step + 1e-9 * len(step) * np.eye(step.shape[1])
    residual = residual - step @ np.linalg.solve(gram, step.T @ residual)
    return Neighbours(rows[enough], spread, distance, residual, states[enough], count)


def _places(logs: Logs, rows: Int[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray]:
    """(rows,) each row's episode, and whether it lies in that episode's second half."""
    ends, lengths = np.flatnonzero(logs.episode_ends), logs.episode_lengths()
    episode = np.searchsorted(ends, rows)
    return episode, ends[episode] - rows < lengths[episode] / 2


def _none(logs: Logs, count: int) -> Neighbours:
    nothing = np.zeros(0)
    return Neighbours(np.zeros(0, np.int64), nothing, nothing, np.zeros((0, logs.action_size)), np.zeros((0, 1)), count)


def _whiten(states: Float[np.ndarray, "rows obs"]) -> Float[np.ndarray, "rows whitened"]:
    """The leading principal components of the standardised columns, each of variance 1."""
    scale = states.std(0)
    moving = scale > 1e-7
    standard = (states[:, moving] - states[:, moving].mean(0)) / scale[moving]
    if standard.shape[1] == 0:
        return standard
    variances, directions = np.linalg.eigh(np.atleast_2d(np.cov(standard.T)))
    leading = np.flatnonzero(variances > 1e-4 * variances[-1])[::-1][:MAX_DIMENSIONS]
    return standard @ directions[:, leading] / np.sqrt(variances[leading])


def find_mixture(logs: Logs, neighbours: Neighbours) -> Mixture | None:
    """The permutation test; None with fewer than `MIN_EPISODES` episodes that have three rows in each half.

    Were all episodes' actions drawn from one policy, independently given the states, which second half stands beside
    which first one would not matter, so the p-value is uniform up to the neighbours' bias (nearly the same states are
    not the same). `share` says whether what differs matters.
    """
    if not len(neighbours.rows):
        return None
    episode, second = _places(logs, neighbours.rows)
    # A difference may change sign from state to state: the residual is also weighed by the leading state components.
    weights = np.concatenate([np.ones((len(episode), 1)), np.clip(neighbours.states[:, :3], -3, 3)], axis=1)
    features = (neighbours.residual[:, :, None] * weights[:, None, :]).reshape(len(episode), -1)
    counts = np.stack([np.bincount(episode[side], minlength=logs.num_episodes) for side in (~second, second)])
    both = np.flatnonzero(counts.min(0) >= 3)
    if len(both) < MIN_EPISODES:
        return None
    means = np.zeros((2, len(both), features.shape[1]))
    for half, side in enumerate((~second, second)):
        sums = np.zeros((logs.num_episodes, features.shape[1]))
        np.add.at(sums, episode[side], features[side])
        means[half] = sums[both] / counts[half, both, None]
    means -= means.mean(1, keepdims=True)
    scale = np.maximum(np.sqrt((means**2).mean((0, 1))), 1e-12)
    first, last = means / scale
    observed = float((first * last).sum())
    rng = np.random.default_rng(SEED)
    # Every pairing of halves is a sum of entries of one matrix.
    product = first @ last.T
    pairings = rng.permuted(np.tile(np.arange(len(both)), (PERMUTATIONS, 1)), axis=1)
    drawn = product[np.arange(len(both)), pairings].sum(1)
    p_value = float(1 + (drawn >= observed).sum()) / (1 + PERMUTATIONS)
    covariance = (means[0] * means[1]).mean(0).reshape(logs.action_size, -1)
    share = float(np.maximum(covariance, 0).sum(1).mean())
    cross = first.T @ last
    direction = np.linalg.eigh(cross + cross.T)[1][:, -1]
    return Mixture(share, p_value, np.stack([first @ direction, last @ direction]))
