"""Coverage levels of 5.6: the same logs in full, thinned, and narrowed; and the best of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.dataset import Logs

COVERAGES = {
    "wide": "all of it",
    "medium": "whole episodes, drawn so that every stratum of returns keeps its share",
    "narrow": "of episodes of middling return, the segments whose actions stray least",
}
STRATA = 5
MIDDLING = (10.0, 60.0)
"""Percentiles of return between which `narrow` stays: neither the best episodes nor the worst."""
SEGMENT = 10
"""Rows that `narrow` keeps or drops together."""


def cover(logs: Logs, level: str, seed: int = 0, fraction: float = 0.3) -> Logs:
    """The logs at a coverage level; `medium` and `narrow` have about `fraction` of the rows, so that they differ in
    what they hold and not in how much.

    Raises `InputError` for an unknown level, for logs without rewards, with too few episodes for the strata, or with
    less than `fraction` of their rows in episodes of middling return.
    """
    if level not in COVERAGES:
        raise unknown("coverage", level, COVERAGES)
    if not 0 < fraction <= 0.5:
        raise InputError(f"fraction is {fraction}: must be above 0 and at most 0.5, the share of middling returns")
    if level == "wide":
        return logs
    returns = logs.episode_returns()
    if returns is None:
        raise InputError(f"coverage {level!r} goes by returns, and {logs.source} has no rewards: use wide")
    if logs.num_episodes < 2 * STRATA:
        raise InputError(f"coverage {level!r} needs {2 * STRATA} episodes, {logs.source} has {logs.num_episodes}")
    if level == "medium":
        return logs.select(np.sort(_stratified(logs, returns, seed, fraction)))
    rows = _middling(logs, returns, fraction)
    narrow = logs.take(rows)
    # A cut ends an episode: what follows it is no successor.
    return replace(narrow, episode_ends=narrow.episode_ends | (np.diff(rows, append=-1) != 1))


def _stratified(logs: Logs, returns: np.ndarray, seed: int, fraction: float) -> Int[np.ndarray, " chosen"]:
    rng, lengths = np.random.default_rng(seed), logs.episode_lengths()
    strata = np.array_split(np.argsort(returns, kind="stable"), STRATA)
    return np.concatenate([_up_to(rng.permutation(stratum), lengths, fraction) for stratum in strata])


def _middling(logs: Logs, returns: np.ndarray, fraction: float) -> Int[np.ndarray, " rows"]:
    low, high = np.percentile(returns, MIDDLING)
    inside = np.flatnonzero((returns >= low) & (returns <= high))
    slices, wanted = logs.episode_slices(), fraction * logs.num_rows
    segments = [
        np.arange(start, min(start + SEGMENT, slices[i].stop))
        for i in inside
        for start in range(slices[i].start, slices[i].stop, SEGMENT)
    ]
    lengths = np.array([len(segment) for segment in segments])
    if lengths.sum() < wanted:
        raise InputError(
            f"coverage 'narrow': episodes of middling return hold {lengths.sum()} rows of {logs.num_rows}, less than "
            f"the fraction {fraction} that was asked for"
        )
    straying = _straying(logs)
    order = np.argsort([straying[segment].mean() for segment in segments], kind="stable")
    return np.sort(np.concatenate([segments[i] for i in _up_to(order, lengths, wanted / lengths.sum())]))


def _up_to(order: np.ndarray, lengths: np.ndarray, fraction: float) -> np.ndarray:
    """The first pieces of `order`, up to `fraction` of their rows, to the nearest; at least one."""
    reached = np.cumsum(lengths[order]) - lengths[order] / 2
    return order[: max(1, int(np.sum(reached <= fraction * lengths[order].sum())))]


def _straying(logs: Logs) -> Float[np.ndarray, " rows"]:
    """Mean squared distance of each action from the logs' mean action, in standard deviations."""
    actions = logs.actions.astype(np.float64)
    spread = actions.std(0)
    return np.mean(np.square((actions - actions.mean(0)) / np.where(spread > 0, spread, 1.0)), axis=1)


def best_episodes(logs: Logs, share: float) -> Logs:
    """Whole episodes, the best by undiscounted return first, until they hold at least `share` of the rows; ties go to
    the earlier one. They stay in the logs' order, and share 1 is all of them.

    Raises `InputError` unless 0 < share <= 1, and for a share below 1 of logs without rewards.
    """
    if not 0 < share <= 1:
        raise InputError(f"logs_filter is {share}: must be above 0 and at most 1, the share of rows to keep")
    if share == 1:
        return logs
    returns = logs.episode_returns()
    if returns is None:
        found = f"goes by returns, and {logs.source} has no rewards"
        raise InputError(f"logs_filter {share} {found}: use logs with rewards, or no filter")
    order = np.argsort(-returns, kind="stable")
    kept = np.cumsum(logs.episode_lengths()[order]) / logs.num_rows
    return logs.select(np.sort(order[: 1 + int(np.argmax(kept >= share))]))


def coverage_statistics(logs: Logs) -> dict[str, float]:
    """What tells the levels apart: rows, pieces, reward by row, and how far actions spread.

    A piece is an episode, or what `narrow` left of one in a row.
    `action_std` is the mean over dimensions; `action_log_volume` half the log-determinant of the actions' covariance, a
    Gaussian's entropy up to a constant (-inf where a dimension never changes).
    """
    actions = logs.actions.astype(np.float64)
    sign, log_determinant = np.linalg.slogdet(np.atleast_2d(np.cov(actions, rowvar=False)))
    result = {
        "rows": float(logs.num_rows),
        "pieces": float(logs.num_episodes),
        "action_std": float(actions.std(0).mean()),
        "action_log_volume": 0.5 * float(log_determinant) if sign > 0 else -np.inf,
    }
    if logs.rewards is not None:
        result |= {"reward_mean": float(logs.rewards.mean()), "reward_std": float(logs.rewards.std())}
    return result
