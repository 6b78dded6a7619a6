"""Linear layers and multilayer perceptrons that act on the last axis; every leading axis is a batch."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.nets.arrays import on_device

Activation = Literal["tanh", "silu"]


def silu(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """x sigmoid(x), written with tanh: XLA's is a rational function on CPU, which takes a fifth off a whole layer."""
    return 0.5 * x * (1 + jnp.tanh(0.5 * x))


ACTIVATIONS = {"tanh": jnp.tanh, "silu": silu}


class Linear(eqx.Module):
    """x W^T + b."""

    weight: Float[Array, "out in"]
    bias: Float[Array, " out"]

    @staticmethod
    def orthogonal(rng: np.random.Generator, in_size: int, out_size: int, gain: float = 1.0) -> Linear:
        """A layer with an orthogonal weight times `gain` and no bias, as PPO's recipe wants it."""
        tall = rng.standard_normal((max(in_size, out_size), min(in_size, out_size)))
        q, r = np.linalg.qr(tall)
        q = q * np.sign(np.diag(r))  # uniform over all orthogonal matrices, whatever signs QR chose
        return _linear(gain * (q if out_size >= in_size else q.T))

    @staticmethod
    def lecun_normal(rng: np.random.Generator, in_size: int, out_size: int, gain: float = 1.0) -> Linear:
        """A layer whose output has `gain` times the spread of its input."""
        return _linear(rng.standard_normal((out_size, in_size)) * (gain / in_size**0.5))

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        """Apply the layer to the last axis."""
        y = x @ self.weight.T
        return y + jnp.broadcast_to(self.bias, y.shape)


def _linear(weight: np.ndarray) -> Linear:
    return Linear(on_device(weight), on_device(np.zeros(len(weight))))


class MLP(eqx.Module):
    """Linear layers with an activation between them and none after the last."""

    layers: tuple[Linear, ...]
    activation: Activation = eqx.field(static=True)

    @staticmethod
    def create(rng: np.random.Generator, sizes: tuple[int, ...], activation: Activation, final_gain: float) -> MLP:
        """Layers from `sizes[0]` inputs to `sizes[-1]` outputs, the last one's initial weight times `final_gain`.

        tanh networks start orthogonal with gain sqrt(2), PPO's recipe; silu networks start lecun-normal.
        """
        init, gain = (Linear.orthogonal, 2**0.5) if activation == "tanh" else (Linear.lecun_normal, 1.0)
        gains = [gain] * (len(sizes) - 2) + [final_gain]
        layers = zip(sizes[:-1], sizes[1:], gains, strict=True)
        return MLP(tuple(init(rng, *layer) for layer in layers), activation)

    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        """Apply the network to the last axis."""
        for layer in self.layers[:-1]:
            x = ACTIVATIONS[self.activation](layer(x))
        return self.layers[-1](x)
