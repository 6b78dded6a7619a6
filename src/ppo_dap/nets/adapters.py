"""psi_PET of Section 4.2: the small subset of the prior's parameters that moves online.

Adapters are a value of their own beside the frozen backbone: an optimizer that is given adapters cannot move anything
else. In both kinds one factor starts random and the other at zero, so that the adapted network starts as an exact
identity of the backbone and still learns (with both at zero no gradient would ever reach either).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ppo_dap.errors import unknown
from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.mlp import Linear, silu

AdapterKind = Literal["lora", "bottleneck"]


@runtime_checkable
class Backbone(Protocol):
    """A network with hidden layers that adapters can sit on."""

    hidden: tuple[Linear, ...]


B = TypeVar("B", bound=Backbone)


class LoRA(eqx.Module):
    """Low-rank change `up @ down` of a layer's weight (Hu et al., 2021), at scale 1."""

    down: Float[Array, "rank in"]
    up: Float[Array, "out rank"]

    def __call__(self, h: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        """What the change adds to the layer's output for input `h`."""
        return (h @ self.down.T) @ self.up.T


class Bottleneck(eqx.Module):
    """A narrow residual network after a layer's activation (Houlsby et al., 2019)."""

    down: Float[Array, "rank width"]
    up: Float[Array, "width rank"]

    def __call__(self, h: Float[Array, "*batch width"]) -> Float[Array, "*batch width"]:
        """What is added to the activation `h`."""
        return silu(h @ self.down.T) @ self.up.T


class Adapters(eqx.Module):
    """One adapter for each hidden layer of a backbone, all of one kind."""

    layers: tuple[LoRA | Bottleneck, ...]


_KINDS = {"lora": LoRA, "bottleneck": Bottleneck}


def init_adapters(rng: np.random.Generator, backbone: Backbone, kind: str, rank: int) -> Adapters:
    """Adapters that leave `backbone` exactly as it is until their first step."""
    if kind not in _KINDS:
        raise unknown("adapter", kind, _KINDS)
    return Adapters(tuple(_init_one(rng, layer, kind, rank) for layer in backbone.hidden))


def _init_one(rng: np.random.Generator, layer: Linear, kind: str, rank: int) -> LoRA | Bottleneck:
    out_size, in_size = layer.weight.shape
    width = in_size if kind == "lora" else out_size
    down = rng.standard_normal((rank, width)) / width**0.5
    return _KINDS[kind](on_device(down), on_device(np.zeros((out_size, rank))))


def apply_hidden(
    layer: Linear,
    adapter: LoRA | Bottleneck | None,
    h: Float[Array, "*batch in"],
    modulate: Callable[[Array], Array] = lambda x: x,
) -> Float[Array, "*batch out"]:
    """A hidden layer with its silu and, where there is one, its adapter; `modulate` comes before the silu."""
    if isinstance(adapter, LoRA):
        return silu(modulate(layer(h) + adapter(h)))
    h = silu(modulate(layer(h)))
    return h if adapter is None else h + adapter(h)


def merge(backbone: B, adapters: Adapters | None) -> tuple[B, Adapters | None]:
    """The same network in the form that is cheapest to evaluate: backbone, and the adapters still to be applied.

    LoRA goes into the weights, so nothing is left to apply; a bottleneck is not linear and stays attached.
    """
    if adapters is None or not all(isinstance(adapter, LoRA) for adapter in adapters.layers):
        return backbone, adapters
    weights = [
        layer.weight + adapter.up @ adapter.down
        for layer, adapter in zip(backbone.hidden, adapters.layers, strict=True)
    ]
    return eqx.tree_at(lambda b: [layer.weight for layer in b.hidden], backbone, weights), None


def adapter_norm(adapters: Adapters) -> Float[Array, ""]:
    """Frobenius norm of `up @ down` over all layers: how far the adapters are from the identity."""
    squares = [jnp.sum(jnp.square(adapter.up @ adapter.down)) for adapter in adapters.layers]
    return jnp.sqrt(sum(squares, jnp.zeros(())))
