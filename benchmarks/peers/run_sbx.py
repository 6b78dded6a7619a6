"""Training speed of SBX's PPO (Stable-Baselines3 in JAX) on one MuJoCo task, on the CPU.

The first iteration (collect and update, with the compilation) is a warm-up outside the clock; the rest of
``--steps`` is timed.
"""

import jax
from common import arguments
from flax import linen as nn
from sb3_interface import measure
from sbx import PPO


def settle(model: PPO) -> None:
    """Wait for what JAX has only begun."""
    jax.block_until_ready((model.policy.actor_state.params, model.policy.vf_state.params))


if __name__ == "__main__":
    args = arguments(__doc__)
    jax.config.update("jax_platforms", "cpu")
    measure(PPO, nn.tanh, args, "sbx", "sbx-rl", settle)
