"""Checking the fields of frozen settings: by their type hints, and by one rule a field."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal

from ppo_dap.errors import InputError, unknown

Rule = tuple[Callable[[Any], bool], str]
"""(whether a value will do, what would be right)."""

POSITIVE: Rule = (lambda v: v > 0, "a number above 0")
AT_LEAST_0: Rule = (lambda v: v >= 0, "a number of 0 or more")
SHARE: Rule = (lambda v: 0 < v <= 1, "a number above 0 and at most 1")


type_hints = functools.cache(typing.get_type_hints)
"""A class's own, evaluated once: a study checks thousands of settings."""


def validate_fields(settings: Any, rules: Mapping[str, Rule]) -> None:
    """Raise `InputError` for the first field of a dataclass whose type or value cannot work; it says what would."""
    hints = type_hints(type(settings))
    for field in dataclasses.fields(settings):
        _validate(field.name, getattr(settings, field.name), hints[field.name], rules.get(field.name))


def _validate(name: str, value: Any, hint: Any, rule: Rule | None) -> None:
    if typing.get_origin(hint) is Literal:
        if value not in typing.get_args(hint):
            raise unknown(f"value of {name}", value, typing.get_args(hint))
        return
    allowed = typing.get_args(hint) or (hint,)
    right_type = (isinstance(value, allowed) or (float in allowed and isinstance(value, int))) and (
        bool in allowed or not isinstance(value, bool)
    )
    if not right_type:
        kinds = " or ".join("None" if t is type(None) else t.__name__ for t in allowed)
        right = rule[1] if rule else kinds
        right = right.replace("a number", "an integer") if float not in allowed else right
        raise InputError(f"{name} must be {right}, not {value!r}")
    finite = not isinstance(value, float) or math.isfinite(value)
    if rule is not None and not (finite and rule[0](value)):
        raise InputError(f"{name} must be {rule[1]}, not {value!r}")
