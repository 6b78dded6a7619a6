"""What a run's numbers depend on besides its config: versions, processor, core setting."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from typing import Any

PACKAGES = ("ppo-dap", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "envpool", "mujoco")


def set_core_count() -> None:
    """Set `NPROC` if the user has not: JAX's CPU results change with the cores it sees. Only before JAX is imported."""
    os.environ.setdefault("NPROC", "1")


def manifest() -> dict[str, Any]:
    """Versions, processor flags that change floating-point results, and `NPROC`."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "versions": versions,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu_flags": _cpu_flags(),
        "NPROC": os.environ.get("NPROC"),
    }


def _cpu_flags() -> list[str]:
    """Vector extensions of the processor, where the system says so."""
    try:
        with open("/proc/cpuinfo") as file:
            line = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        return []
    return sorted(flag for flag in line.split() if flag.startswith(("avx", "fma", "sse4")))
