"""Compile a run's stages ahead of their first call: each as soon as it is traced, while the next is being traced."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax

WORKERS = 2


class CompileAhead:
    """Give `trace` to `iterate` as its `run` while it is traced; `wait` before the first real call."""

    def __init__(self):
        self._pool = ThreadPoolExecutor(WORKERS)
        self._programs: dict[int, Future] = {}

    def trace(self, name: str, stage: Callable[..., Any], *arguments: Any) -> Any:
        """Call a jitted stage with tracers, and begin to compile it for arguments of their shapes."""
        result = stage(*arguments)
        if id(stage) not in self._programs:
            shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=_weak(x)), arguments)
            self._programs[id(stage)] = self._pool.submit(lambda: stage.lower(*shapes).compile())  # type: ignore[attr-defined]
        return result

    def wait(self) -> None:
        """Return when everything is compiled; raises what a compilation raised."""
        self._pool.shutdown()
        for program in self._programs.values():
            program.result()
        self._programs = {}


def _weak(x: Any) -> bool:
    return getattr(getattr(x, "aval", None), "weak_type", False)
