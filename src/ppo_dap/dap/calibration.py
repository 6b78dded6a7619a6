"""Calibration of Q (5.6): a monotone map from what Q says to the returns that followed, fitted on fresh rows."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.arrays import on_device

KNOTS = 16


class Calibration(NamedTuple):
    """A piecewise linear map; outside its knots it goes on as in its outermost pieces."""

    q: Float[Array, " knots"]
    returns: Float[Array, " knots"]

    @staticmethod
    def identity() -> Calibration:
        """Changes nothing."""
        line = on_device(np.linspace(-1.0, 1.0, KNOTS))
        return Calibration(line, line)

    def __call__(self, q: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """Calibrated values."""
        flat = jnp.interp(q.reshape(-1), self.q, self.returns, left="extrapolate", right="extrapolate")
        return flat.reshape(q.shape)


def isotonic_points(
    q: Float[np.ndarray, " rows"], returns: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """The never falling function of Q with the least squared error, as the distinct values of Q and its heights there.

    Rows of one value are one row, of their mean and number: no map of Q can tell them apart.
    """
    from scipy.optimize import isotonic_regression

    points, place, counts = np.unique(q, return_inverse=True, return_counts=True)
    return points, isotonic_regression(np.bincount(place, returns) / counts, weights=counts).x


def calibrate(
    q: Float[np.ndarray, " rows"], returns: Float[np.ndarray, " rows"], kind: Literal["affine", "isotonic"]
) -> Calibration:
    """The map of that kind with the least squared error on the rows, never falling; the identity where Q is constant.

    Raises `ValueError` for rows of different numbers.
    """
    if q.shape != returns.shape:
        raise ValueError(f"{len(q)} values of Q and {len(returns)} returns: there must be one return for each value")
    q, returns = q.astype(np.float64), returns.astype(np.float64)
    # Knots at equal distances in the values, not in the ranks: the map is read where proposals are, off the data too.
    low, high = np.quantile(q, [0.02, 0.98])
    knots = np.linspace(low, high, KNOTS)
    if not knots[-1] - knots[0] > 1e-6:
        return Calibration.identity()
    if kind == "affine":
        slope, offset = np.polyfit(q, returns, 1)
        values = max(slope, 0.0) * knots + (offset if slope > 0 else returns.mean())
    else:
        values = np.interp(knots, *isotonic_points(q, returns))
    return Calibration(on_device(knots), on_device(values))
