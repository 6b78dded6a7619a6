"""What a run's numbers depend on besides its config: versions, processor, device, core setting."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import warnings
from pathlib import Path
from typing import Any

PACKAGES = ("ppo-dap", "jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "envpool", "mujoco")


def prepare_jax() -> None:
    """Set, before JAX is imported, what the user's environment does not: a core, a cache of programs, float32.

    JAX's results on a CPU change with the number of cores that it sees, so `NPROC` is 1 unless set.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ppo-dap" / "jax"
    os.environ.setdefault("NPROC", "1")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    # A GPU's products would be of 10 bits (TF32), while the policy that collects, in numpy, computes with all 23.
    os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    # The networks are small, and a study's runs share the GPU: the first would take three quarters of its memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    # JAX does not write an entry in one step: one that another process is at, or was killed at, is compiled anew.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")


def manifest() -> dict[str, Any]:
    """Versions, device, the precision of products, the processor with its vector extensions, and `NPROC`."""
    import jax

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
        "device": jax.devices()[0].device_kind,
        "matmul_precision": jax.config.jax_default_matmul_precision,  # type: ignore[attr-defined]
        "processor": processor(),
        "cpu_flags": _cpu_flags(),
        "NPROC": os.environ.get("NPROC"),
    }


def processor() -> str:
    """The processor's name, where the system tells it."""
    return _cpuinfo("model name") or platform.processor()


def _cpu_flags() -> list[str]:
    """Vector extensions of the processor, where the system says so."""
    return sorted(flag for flag in _cpuinfo("flags").split() if flag.startswith(("avx", "fma", "sse4")))


def _cpuinfo(name: str) -> str:
    """What Linux says of the first core under this name, or nothing."""
    try:
        with open("/proc/cpuinfo") as file:
            return next((line.split(":", 1)[1].strip() for line in file if line.startswith(name)), "")
    except OSError:
        return ""
