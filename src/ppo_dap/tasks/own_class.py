"""A user's own environment, by the import path of its class."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from typing import Any

from ppo_dap.errors import InputError, unknown


def is_class_path(task: str) -> bool:
    """Whether `task` reads `package.module:ClassName`; Gymnasium's own `module:Name-v0` has a version."""
    module, colon, name = task.partition(":")
    return bool(colon) and name.isidentifier() and all(part.isidentifier() for part in module.split("."))


def make_own(path: str, **options: Any) -> Any:
    """An instance of the class at `package.module:ClassName`, made with `options` alone (none in training).

    Nothing is wrapped round it: it truncates and terminates as it says itself. The module is looked for where Python
    looks, and in the current folder. Raises `InputError` where it cannot be imported or holds no such environment.
    """
    module_name, _, name = path.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # the `ppo-dap` command, unlike `python`, does not look there by itself
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # whatever the user's module raises while it is imported
        raise InputError(f"task {path!r}: {module_name} cannot be imported: {_line(error)}") from error
    found = getattr(module, name, None)
    if found is None:
        raise unknown(f"class of {module_name}", name, [n for n, value in vars(module).items() if _is_env(value)])
    if not _is_env(found):
        raise InputError(f"task {path!r} is {_kind(found)}, not a class derived from gymnasium.Env")
    try:
        return found(**options)
    except Exception as error:
        how = "without arguments" if not options else f"with {', '.join(options)}"
        raise InputError(f"task {path!r} cannot be made {how}: {_line(error)}") from error


def _is_env(value: Any) -> bool:
    import gymnasium

    return inspect.isclass(value) and issubclass(value, gymnasium.Env)


def _kind(value: Any) -> str:
    return f"the class {value.__qualname__}" if inspect.isclass(value) else f"of type {type(value).__name__}"


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
