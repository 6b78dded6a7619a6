"""Arrays of the device from numbers of the host, without a program for each shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppo_dap.dap import adaptation, q_learning
from ppo_dap.nets.arrays import first_state, on_device
from ppo_dap.ppo import update
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors import fit


def test_values_and_type_are_those_of_jax_numpy():
    values = np.arange(6.0).reshape(2, 3) / 7
    assert on_device(values).dtype == jnp.float32
    np.testing.assert_array_equal(on_device(values), jnp.asarray(values, jnp.float32))
    assert on_device(3, np.int32).shape == ()
    assert not on_device(1).weak_type  # else a stage would be compiled again for the array that comes after it


OPTIMIZERS = {
    "pet": adaptation.ADAM,
    "q": q_learning.ADAM,
    "ppo": update.ADAM,
    "fit": fit._optimizer(DiffusionConfig()),
}


@pytest.mark.parametrize("optimizer", OPTIMIZERS.values(), ids=OPTIMIZERS)
def test_first_state_is_the_optimizers_own(optimizer):
    params = {"weight": on_device(np.ones((3, 2))), "bias": on_device(np.ones(3))}
    own, ours = optimizer.init(params), first_state(optimizer, params)
    assert jax.tree.structure(own) == jax.tree.structure(ours)
    for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(ours), strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a.dtype, a.weak_type) == (b.dtype, b.weak_type)
