"""What holds in every test: one core for XLA (the same bits everywhere), no display, no silent broadcasting."""

import os
from pathlib import Path

# Tests build the same small programs again and again, in several processes: each is compiled once.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("NPROC", "1")  # XLA reads it when it starts; subprocesses inherit it
os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")  # on a GPU as everywhere
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import mujoco

jax.config.update("jax_numpy_rank_promotion", "raise")
mujoco.set_mju_user_warning(lambda text: None)  # else every warning is appended to MUJOCO_LOG.TXT in the working folder
