"""Data flow of a traced program: which inputs and which tagged values can reach which outputs and tags.

Read off the jaxpr, so off the program that runs and not off its source. Every primitive passes all of its inputs on to
all of its outputs, except those whose structure is known (loops, branches, calls, barriers), which are followed inside.
What is reported as unreachable is unreachable; the reverse need not hold.

An array that is in the program and no argument of it (a closure's), what a callback to Python returns and what is read
from a mutable array have no owner: they carry `UNKNOWN`, since they could be anything.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex
from jax.interpreters.partial_eval import dce_jaxpr

Labels = frozenset[str]
NOTHING: Labels = frozenset()
UNKNOWN: Labels = frozenset({"unknown"})
KNOWN = "known"
"""Tag of what is made of constant arrays that are no data, such as a polynomial's coefficients: it takes `UNKNOWN` off.
"""


@dataclass(frozen=True)
class Flow:
    """Labels that reach each named output and each tag."""

    outputs: Mapping[str, Labels]
    tags: Mapping[str, Labels]


@dataclass(frozen=True)
class Traced:
    """A traced function, to be asked for its data flow."""

    jaxpr: Any
    owners: Sequence[str]
    results: Mapping[str, int]

    def flow(self, *, sources: Collection[str] = (), cuts: Collection[str] = ()) -> Flow:
        """Every argument is a label of its own. A value tagged (`checkpoint_name`) with a name in `sources` adds that
        name to what it carries; one tagged with a name in `cuts` carries nothing but that name from there on.
        """
        walker = _Walker(frozenset(sources), frozenset(cuts))
        labels = walker.run(self.jaxpr, [frozenset({owner}) for owner in self.owners])
        outputs, position = {}, 0
        for name, count in self.results.items():
            outputs[name] = NOTHING.union(*labels[position : position + count])
            position += count
        return Flow(outputs, walker.tags)


def trace(function: Callable[..., Mapping[str, Any]], arguments: Mapping[str, Any]) -> Traced:
    """Trace `function(**arguments)`, which returns a mapping of named pytrees; nothing is executed."""
    names = list(arguments)
    flat, structure = jax.tree.flatten([arguments[name] for name in names])
    owners = [name for name in names for _ in jax.tree.leaves(arguments[name])]
    results: dict[str, int] = {}

    def flat_function(*leaves):
        result = function(**dict(zip(names, jax.tree.unflatten(structure, leaves), strict=True)))
        results.update({name: len(jax.tree.leaves(result[name])) for name in sorted(result)})
        return [jax.tree.leaves(result[name]) for name in sorted(result)]

    jaxpr = jax.make_jaxpr(flat_function)(*flat).jaxpr
    # Only what contributes to a result counts: diagnostics that are not returned drop out.
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)
    return Traced(jaxpr, owners, results)


class _Walker:
    def __init__(self, sources: frozenset[str], cuts: frozenset[str]):
        self.sources, self.cuts = sources, cuts
        self.tags: dict[str, Labels] = {}

    def run(self, jaxpr: Any, inputs: Sequence[Labels]) -> list[Labels]:
        """Labels of a jaxpr's outputs for labels of its inputs."""
        env: dict[Any, Labels] = dict(zip(jaxpr.invars, inputs, strict=True)) | dict.fromkeys(jaxpr.constvars, UNKNOWN)

        def read(var) -> Labels:
            if isinstance(var, jex.Literal):
                return UNKNOWN if np.ndim(var.val) else NOTHING
            return env.get(var, NOTHING)

        for eqn in jaxpr.eqns:
            env.update(zip(eqn.outvars, self.equation(eqn, [read(v) for v in eqn.invars]), strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, inputs: list[Labels]) -> list[Labels]:
        """Labels of one equation's outputs."""
        name, params = eqn.primitive.name, eqn.params
        if name == "name":
            return [self.tag(params["name"], inputs[0])]
        if "callback" in name or any(hasattr(v.aval, "inner_aval") for v in eqn.invars):
            return [UNKNOWN.union(*inputs)] * len(eqn.outvars)
        if name == "optimization_barrier":
            return inputs
        if name == "scan":
            return self.scan(eqn, inputs)
        if name == "while":
            return self.while_loop(params, inputs)
        if name == "cond":
            branches = [self.run(b.jaxpr, inputs[1:]) for b in params["branches"]]
            return [inputs[0].union(*labels) for labels in zip(*branches, strict=True)]
        inner = [p for p in params.values() if hasattr(p, "eqns") or hasattr(getattr(p, "jaxpr", None), "eqns")]
        if inner:
            body = getattr(inner[0], "jaxpr", inner[0])
            if len(body.invars) == len(inputs) and len(body.outvars) == len(eqn.outvars):
                return self.run(body, inputs)
        return [NOTHING.union(*inputs)] * len(eqn.outvars)

    def tag(self, name: str, labels: Labels) -> Labels:
        """Record what reaches a tag, and what goes on from it."""
        self.tags[name] = self.tags.get(name, NOTHING) | labels
        if name in self.cuts:
            return frozenset({name})
        if name == KNOWN:
            return labels - UNKNOWN
        return labels | {name} if name in self.sources else labels

    def scan(self, eqn: Any, inputs: list[Labels]) -> list[Labels]:
        """A loop over a leading axis: what reaches the carry once reaches it in every later step."""
        body = eqn.params["jaxpr"].jaxpr
        # Sizes off the shapes, since JAX 0.11 names them differently: what is stacked has one axis more outside.
        count, scanned = _as_inside(eqn.outvars, body.outvars), len(inputs) - _as_inside(eqn.invars, body.invars)
        fixed = len(inputs) - count - scanned
        constants, carry, xs = inputs[:fixed], inputs[fixed : fixed + count], inputs[fixed + count :]
        while True:
            outputs = self.run(body, [*constants, *carry, *xs])
            merged = [a | b for a, b in zip(carry, outputs[:count], strict=True)]
            if merged == carry:
                return [*merged, *outputs[count:]]
            carry = merged

    def while_loop(self, params: Mapping[str, Any], inputs: list[Labels]) -> list[Labels]:
        """A loop with a condition: what the condition sees reaches every result."""
        split = params["cond_nconsts"]
        body_split = split + params["body_nconsts"]
        cond_constants, body_constants, carry = inputs[:split], inputs[split:body_split], inputs[body_split:]
        while True:
            seen = NOTHING.union(*self.run(params["cond_jaxpr"].jaxpr, [*cond_constants, *carry]))
            outputs = self.run(params["body_jaxpr"].jaxpr, [*body_constants, *carry])
            merged = [a | b | seen for a, b in zip(carry, outputs, strict=True)]
            if merged == carry:
                return merged
            carry = merged


def _as_inside(outer: Sequence[Any], inner: Sequence[Any]) -> int:
    """How many values of a loop have the same number of axes outside it as in its body."""
    return sum(a.aval.ndim == b.aval.ndim for a, b in zip(outer, inner, strict=True))
