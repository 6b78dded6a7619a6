"""How numbers of the host become arrays of the device without a program: `jnp` would compile one for every shape."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array


def on_device(values: Any, dtype: Any = np.float32) -> Array:
    """`values` as an array of `dtype` on the default device."""
    return jax.device_put(np.asarray(values, dtype))


def first_state(optimizer: Any, params: Any) -> Any:
    """What `optimizer.init(params)` gives where that is zeros, as Adam's moments and count are."""
    shapes = jax.eval_shape(optimizer.init, params)
    return jax.tree.map(lambda shape: on_device(np.zeros(shape.shape), shape.dtype), shapes)
