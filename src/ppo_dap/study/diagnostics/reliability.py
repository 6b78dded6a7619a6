"""Measures of how far value guidance can be trusted (5.7), in plain numpy.

Sizes: n states, k actions a state, m rollouts an action. Q and the return proxy G are in the same units; the report
that is made of these is in `ppo_dap.study.diagnostics.reliability_report`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from ppo_dap.dap.calibration import isotonic_points

Map = Callable[[np.ndarray], np.ndarray]
"""A calibration: Q as it is to Q as it should be."""
RESAMPLES = 2000
"""Bootstrap samples of an interval."""


def rank_correlation(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> float:
    """Spearman's rho (5.7); NaN where one side does not vary, or for fewer than two pairs."""
    from scipy.stats import spearmanr

    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan")
    return float(spearmanr(x, y).statistic)  # type: ignore[attr-defined]


def rank_correlation_per_state(q: Float[np.ndarray, "n k"], g: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """5.7: Spearman's rho between Q(s, a) and G(s, a) among the actions of each state; NaN where it has none."""
    return np.array([rank_correlation(*pair) for pair in zip(q, g, strict=True)])


def mean_and_interval(values: Float[np.ndarray, " n"], seed: int = 0) -> tuple[float, float, float]:
    """Mean over the states that have a value, and its 95% bootstrap interval; all NaN when fewer than two have one."""
    from scipy.stats import bootstrap

    values = values[np.isfinite(values)]
    if len(values) < 2:
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    found = bootstrap((values,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=rng).confidence_interval
    return float(values.mean()), float(found.low), float(found.high)


def rank_ceiling(returns: Float[np.ndarray, "n k m"]) -> float:
    """About the rho that the true Q would reach against G, a mean of m noisy returns; NaN for fewer than two.

    The ranks of two halves of the rollouts agree to r; all of them are then reliable to 2r / (1 + r) (Spearman and
    Brown), and a truth without noise correlates with them by the root of it.
    """
    half = returns.shape[2] // 2
    if half == 0:
        return float("nan")
    first, second = returns[..., :half].mean(2), returns[..., half : 2 * half].mean(2)
    rho = rank_correlation_per_state(first, second)
    if not np.isfinite(rho).any():
        return float("nan")
    agreement = max(float(np.nanmean(rho)), 0.0)
    return float(np.sqrt(2 * agreement / (1 + agreement)))


def mean_absolute_error(q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"]) -> float:
    """5.7: E|Q(s, a) - G(s, a)| over pairs."""
    return float(np.mean(np.abs(q - g)))


def bias(q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"]) -> float:
    """E[Q(s, a) - G(s, a)] over pairs: above 0 when Q promises too much."""
    return float(np.mean(q - g))


def calibration_curve(
    q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"], bins: int
) -> tuple[Float[np.ndarray, " found"], Float[np.ndarray, " found"], Int[np.ndarray, " found"]]:
    """5.7: mean Q, mean G and number of pairs in each bin between quantiles of Q; equal values share a bin, and bins
    that stay empty are left out.
    """
    edges = np.quantile(q, np.arange(1, bins) / bins)
    where = np.searchsorted(edges, q, side="right")
    counts = np.bincount(where, minlength=bins)
    found = counts > 0
    means = (np.bincount(where, weights=x, minlength=bins)[found] / counts[found] for x in (q, g))
    return next(means), next(means), counts[found]


def expected_calibration_error(q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"], bins: int = 10) -> float:
    """5.7: mean over pairs of |mean Q - mean G| of their bin."""
    mean_q, mean_g, counts = calibration_curve(q, g, bins)
    return float(np.average(np.abs(mean_q - mean_g), weights=counts))


def high_q_hit_rate(of_state: Float[np.ndarray, "n k"], q: Float[np.ndarray, "n j"]) -> float:
    """5.6: share of `q` at or above the 90th percentile of Q over the state's actions, `of_state`."""
    return float(np.mean(q >= np.quantile(of_state, 0.9, axis=1, keepdims=True)))


def affine_map(q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"]) -> Map:
    """The line through (Q, G) by least squares; a constant Q is mapped to the mean of G."""
    if np.ptp(q) == 0:
        return lambda x: np.full_like(x, g.mean())
    slope, offset = np.polyfit(q, g, 1)
    return lambda x: slope * x + offset


def isotonic_map(q: Float[np.ndarray, " n"], g: Float[np.ndarray, " n"]) -> Map:
    """The rising function nearest to (Q, G) by least squares, linear between its points and constant outside them."""
    points = isotonic_points(q, g)
    return lambda x: np.interp(x, *points)


MAPS: dict[str, Callable[[np.ndarray, np.ndarray], Map]] = {
    "as it is": lambda q, g: lambda x: x,
    "affine": affine_map,
    "isotonic": isotonic_map,
}
"""Calibrations by name."""


def calibrations(
    q: Float[np.ndarray, "n k"], g: Float[np.ndarray, "n k"], bins: int = 10, seed: int = 0
) -> dict[str, dict[str, float]]:
    """MAE and ECE under each of `MAPS`, fitted to the pairs of one half of the states and judged on the other's.

    States are split, not pairs: those of a state are too alike to judge each other. Each half is judged once.
    """
    order = np.random.default_rng(seed).permutation(len(q))
    halves = order[: len(q) // 2], order[len(q) // 2 :]
    found: dict[str, dict[str, float]] = {}
    for name, fit in MAPS.items():
        rows = []
        for one, other in (halves, halves[::-1]):
            mapped, truth = fit(q[one].ravel(), g[one].ravel())(q[other].ravel()), g[other].ravel()
            rows.append((mean_absolute_error(mapped, truth), expected_calibration_error(mapped, truth, bins)))
        found[name] = dict(zip(("mae", "ece"), np.mean(rows, axis=0).tolist(), strict=True))
    return found


def measure(
    q: Float[np.ndarray, "n k"], g: Float[np.ndarray, "n k"], bins: int = 10, seed: int = 0
) -> dict[str, float]:
    """All of 5.7 on one set of pairs: rho within states (with its interval) and over all pairs, MAE, bias, ECE."""
    per_state = rank_correlation_per_state(q, g)
    rho, low, high = mean_and_interval(per_state, seed)
    flat = q.ravel(), g.ravel()
    return {
        "rho": rho,
        "rho_low": low,
        "rho_high": high,
        "rho_states": int(np.isfinite(per_state).sum()),
        "rho_pooled": rank_correlation(*flat),
        "mae": mean_absolute_error(*flat),
        "bias": bias(*flat),
        "ece": expected_calibration_error(*flat, bins),
    }
