"""What holds in every test: one core for XLA (the same bits everywhere), no display, no silent broadcasting."""

import importlib
import os
from pathlib import Path

# Tests build the same small programs again and again, in several processes: each is compiled once.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# Most of a test's time would go to optimising programs that run once. What depends on it is marked `as_shipped`.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("NPROC", "1")  # XLA reads it when it starts; subprocesses inherit it
os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")  # on a GPU as everywhere
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import mujoco
from jaxtyping import install_import_hook

# Before types are checked: what is called a hundred thousand times and knows no shapes.
for module in ("ppo_dap.fields", "ppo_dap.dap.dataflow"):
    importlib.import_module(module)
install_import_hook("ppo_dap", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")
mujoco.set_mju_user_warning(lambda text: None)  # else every warning is appended to MUJOCO_LOG.TXT in the working folder

LONGEST = ("test_smoke.py", "test_ray.py", "test_as_shipped.py")


def pytest_collection_modifyitems(items):
    """What takes minutes begins first: at the end one core would work through it and the other wait."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
