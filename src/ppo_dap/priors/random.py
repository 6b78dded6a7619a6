"""The control that shows what a prior is worth: proposals that know nothing, neither of logs nor of the state."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.prior_config import RandomConfig
from ppo_dap.priors.prior import Prior, checked_bounds
from ppo_dap.priors.uniform import Uniform

PROBE_ROWS = 256
PROBE_SEED = 0

Bound = Float[np.ndarray, " act"] | Sequence[float]


def random_prior(observation_size: int, action_low: Bound, action_high: Bound, task: str | None = None) -> Prior:
    """A prior of kind "random": uniform actions between the bounds, whatever the state, made without logs.

    Its probe rows are standard normal observations and uniform actions, always the same ones. Raises `InputError` for
    bounds that are not finite or not one number an action dimension.
    """
    if not observation_size > 0:
        raise InputError(f"observation_size must be an integer above 0, not {observation_size!r}")
    low, high = checked_bounds(action_low, action_high, np.size(action_low))
    rng = np.random.default_rng(PROBE_SEED)
    return Prior(
        network=Uniform(jnp.zeros(low.shape, jnp.float32), RandomConfig()),
        action_low=low,
        action_high=high,
        task=task,
        logs_hash="random",
        training={"rows": 0, "steps": 0},
        probe_observations=rng.standard_normal((PROBE_ROWS, observation_size), dtype=np.float32),
        probe_actions=rng.uniform(-1.0, 1.0, (PROBE_ROWS, low.size)).astype(np.float32),
    )
