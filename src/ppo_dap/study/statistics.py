"""Statistics of runs (5.1.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

EPOCH = 5_000
"""Environment steps of one epoch."""


def alc(evaluations: Sequence[Mapping[str, Any]], epochs: float = 40) -> float:
    """ALC@T: mean height of the evaluation curve over the first `epochs` of 5k steps, by the trapezoidal rule.

    The curve is cut at T by linear interpolation; a run that ends before T raises `ValueError`.
    """
    steps = np.array([row["env_steps"] for row in evaluations], float)
    returns = np.array([row["return_mean"] for row in evaluations], float)
    end = epochs * EPOCH
    if len(steps) < 2 or steps[-1] < end:
        raise ValueError(f"the evaluations end at {steps[-1] if len(steps) else 0:.0f} steps, before {end:.0f}")
    inside = steps < end
    steps, returns = np.append(steps[inside], end), np.append(returns[inside], np.interp(end, steps, returns))
    return float(np.trapezoid(returns, steps) / end)
