"""ppo-dap: logged trajectories in, faster PPO out. See the README for the commands.

The names below are the whole public interface; each is imported when it is first used, so that importing is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ppo_dap.dap.plugin import Guide as Guide
    from ppo_dap.errors import InputError as InputError
    from ppo_dap.errors import PPODAPError as PPODAPError
    from ppo_dap.logs import Logs as Logs
    from ppo_dap.logs import check_logs as check_logs
    from ppo_dap.logs import load_logs as load_logs
    from ppo_dap.priors import fit_prior as fit_prior
    from ppo_dap.priors import load_prior as load_prior
    from ppo_dap.training.run import Run as Run
    from ppo_dap.training.run import load_run as load_run
    from ppo_dap.training.run import train as train

_SOURCES = {
    "Guide": ("dap.plugin", "Guide"),
    "InputError": ("errors", "InputError"),
    "Logs": ("logs", "Logs"),
    "PPODAPError": ("errors", "PPODAPError"),
    "Run": ("training.run", "Run"),
    "check_logs": ("logs", "check_logs"),
    "fit_prior": ("priors", "fit_prior"),
    "load_logs": ("logs", "load_logs"),
    "load_prior": ("priors", "load_prior"),
    "load_run": ("training.run", "load_run"),
    "methods": ("methods", "capability_rows"),
    "train": ("training.run", "train"),
}
__all__ = sorted(_SOURCES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version  # ten times what the rest of this file costs

        return version("ppo-dap")
    if name not in _SOURCES:
        raise AttributeError(f"module 'ppo_dap' has no attribute {name!r}")
    module, attribute = _SOURCES[name]
    if module not in ("errors", "logs", "methods"):
        from ppo_dap.training.manifest import prepare_jax

        prepare_jax()
    return getattr(importlib.import_module(f"ppo_dap.{module}"), attribute)
