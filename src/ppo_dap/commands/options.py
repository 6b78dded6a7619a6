"""Options that several commands have, and a flag for every field of the settings."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import math
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ppo_dap import config as configs
from ppo_dap.errors import InputError
from ppo_dap.fields import type_hints
from ppo_dap.prior_config import FITTED, PRIOR_CONFIGS


def number(kind: type, right: Callable[[Any], bool], what: str) -> Callable[[str], Any]:
    """An option's type: a number for which `right` holds."""

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not right(value):
            raise argparse.ArgumentTypeError(f"must be {what}, not {text!r}")
        return value

    return parse


seed = number(int, lambda v: 0 <= v < 2**32, "a whole number from 0 to 4294967295")


positive_count = number(int, lambda v: v > 0, "a whole number above 0")


positive_number = number(float, lambda v: 0 < v < math.inf, "a number above 0")


number_of_0_or_more = number(float, lambda v: 0 <= v < math.inf, "a number of 0 or more")


finite_number = number(float, math.isfinite, "a finite number")


def each_once(option: str, pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """What an option of the form NAME=... says of each name; raises `InputError` for a name that is there twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise InputError(f"{option} has {name} twice: give it once, with all that belongs to it: {name}=A,B")
        found[name] = value
    return found


def column(text: str) -> tuple[str, list[str] | None]:
    """A role and the columns that have it; none for `ROLE=`."""
    role, equals, names = text.partition("=")
    if not (role and equals):
        raise argparse.ArgumentTypeError(f"must be ROLE=NAME or ROLE=NAME,NAME,..., not {text!r}")
    return role, names.split(",") if names else None


def logs_option(parser: argparse.ArgumentParser, required: bool) -> None:
    """Which logs, and how to read them."""
    what = "shipped sample, .npz, D4RL .hdf5, .csv or .parquet table, LeRobot or Minari folder, or Minari id"
    parser.add_argument("--logs", required=required, metavar="LOGS", help=what)
    parser.add_argument(
        "--columns",
        nargs="+",
        type=column,
        metavar="ROLE=NAME,...",
        help="what a table's columns are, where their names do not say: observations, actions (names or prefixes), "
        "episode, step, rewards, terminated, truncated, done",
    )
    parser.add_argument(
        "--max-bytes",
        type=positive_count,
        metavar="N",
        help="of larger logs, episodes drawn by the seed are kept up to this (default: 256 MiB)",
    )


def filter_option(parser: argparse.ArgumentParser) -> None:
    """Which share of the logs, the best first."""
    parser.add_argument(
        "--logs-filter",
        type=number(float, lambda v: 0 < v <= 1, "a number above 0 and at most 1"),
        default=1.0,
        metavar="SHARE",
        help="share of the logs' rows to fit to: whole episodes, those of the highest return first (default: 1.0)",
    )


def config_options(parser: argparse.ArgumentParser) -> None:
    """A flag for every field of the config, by its name; what is not given stays with the preset."""
    for group, cls in type_hints(configs.Config).items():
        field_options(parser.add_argument_group(f"{group}: {(cls.__doc__ or '').splitlines()[0]}"), cls)


def prior_options(parser: argparse.ArgumentParser) -> None:
    """A flag for every field of every kind of prior; those that several kinds have are there once."""
    fitted, kinds = {kind: PRIOR_CONFIGS[kind] for kind in FITTED}, {}
    for kind, cls in fitted.items():
        for f in dataclasses.fields(cls):
            kinds.setdefault(f.name, []).append(kind)
    seen: set[str] = set()
    for kind, cls in fitted.items():
        section = parser.add_argument_group(f"{kind} prior: {(cls.__doc__ or '').splitlines()[0]}")
        field_options(section, cls, {name: others for name, others in kinds.items() if name not in seen})
        seen |= {f.name for f in dataclasses.fields(cls)}


def field_options(section: Any, cls: type, shared: Mapping[str, Sequence[str]] | None = None) -> None:
    """A flag for every field of a dataclass; what is not given is not in the result.

    `shared` names the fields to take, and the kinds of prior that have each.
    """
    hints, texts = type_hints(cls), field_docstrings(cls)
    for f in dataclasses.fields(cls):
        if shared is not None and f.name not in shared:
            continue
        others = shared[f.name] if shared is not None and len(shared[f.name]) > 1 else ()
        defaults = {str(PRIOR_CONFIGS[kind].__dataclass_fields__[f.name].default) for kind in others} or {
            str(f.default)
        }
        text = f"{texts[f.name]} (default: {' or '.join(sorted(defaults))})"
        section.add_argument(
            f"--{f.name.replace('_', '-')}",
            type=functools.partial(parse_value, hints[f.name]),
            default=argparse.SUPPRESS,
            metavar="X",
            help=(text + (f" [{', '.join(others)}]" if others else "")).replace("%", "%%"),
        )


def field_docstrings(cls: type) -> dict[str, str]:
    """The string below each field of a dataclass, its base's included."""
    texts = {}
    for part in reversed(cls.__mro__[:-1]):
        body = ast.parse(inspect.getsource(part)).body[0].body  # type: ignore[attr-defined]
        for statement, after in itertools.pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
                texts[statement.target.id] = " ".join(ast.literal_eval(after.value).split())  # type: ignore[union-attr]
    return texts


def parse_value(hint: Any, text: str) -> Any:
    """`text` as the field's type; what is wrong with the value itself is the config's to say."""
    kinds = typing.get_args(hint) or (hint,)
    if typing.get_origin(hint) is typing.Literal:
        return text
    if type(None) in kinds and text.lower() == "none":
        return None
    if bool in kinds:
        if text.lower() not in ("true", "false"):
            raise argparse.ArgumentTypeError(f"must be true or false, not {text!r}")
        return text.lower() == "true"
    kind = next(k for k in kinds if k is not type(None))
    try:
        return kind(text.replace("_", "")) if kind is int else kind(text)
    except ValueError:
        right = {int: "a whole number", float: "a number"}[kind] + (" or none" if type(None) in kinds else "")
        raise argparse.ArgumentTypeError(f"must be {right}, not {text!r}") from None
