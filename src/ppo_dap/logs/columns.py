"""Which column of a table means what: by its name, or as the user says."""

import re
from collections.abc import Mapping, Sequence

from ppo_dap.errors import InputError, unknown

Columns = Mapping[str, str | Sequence[str] | None]
"""What the user says of a table's columns: for each of `ROLES` a column's name, or None to leave it out; for
observations and actions names or prefixes of columns, in the order that they shall have."""

STEMS = {
    "observations": ("obs", "observation", "observations", "state", "states"),
    "actions": ("act", "action", "actions"),
}
"""A column named so, or so and then `_`, `.`, `/`, `[` and more, is of the observations or of the actions."""
OPTIONAL = {
    "episode": ("episode", "episode_id", "episode_index"),
    "step": ("step", "frame_index"),
    "times": ("time", "times", "timestamp", "t"),
    "rewards": ("reward", "rewards", "next.reward"),
    "terminated": ("terminated", "terminal", "terminals"),
    "truncated": ("truncated", "timeout", "timeouts"),
    "done": ("done", "dones", "next.done"),
}
"""The other roles, and the names that mean them; the first that is there counts."""
UNUSED = ("index", "task_index")  # LeRobot's own bookkeeping
ROLES = (*STEMS, *OPTIONAL)
LISTED = 12  # names of columns in a message
RULE = "must have columns such as obs_0, obs_1, ... and act_0, ..., or be told them by columns"


def choose_columns(names: Sequence[str], columns: Columns | None) -> tuple[dict[str, list[str]], list[str]]:
    """The columns of each role (one, but for observations and actions), and those that no role has.

    Columns of one prefix that all end in numbers are put in the order of these numbers, others stay in the table's.
    Raises `InputError` for an unknown role, a column that is not there or has two roles, numbers with gaps, and tables
    without observations or actions.
    """
    columns = columns or {}
    if not isinstance(columns, Mapping):
        raise InputError(f"columns is {columns!r}: must say for each role which columns it has, as a mapping")
    for role, given in columns.items():
        if role not in ROLES:
            raise unknown("role in columns", role, ROLES)
        if given is not None and not isinstance(given, str | Sequence):
            raise InputError(f"columns has {role} {given!r}: must be a column's name, or several")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"column {min(twice)!r} is there twice: must be there once")
    chosen = {role: _of_stem(role, names, columns.get(role)) for role in STEMS}
    for role, known in OPTIONAL.items():
        given = columns.get(role, ())
        if given is None:
            continue
        wanted = [given] if isinstance(given, str) else list(given)
        found = [name for name in wanted or known if name in names]
        if wanted and len(found) != 1:
            raise InputError(f"columns has {role} {given!r}: must be one of {_listed(names)}")
        if found:
            chosen[role] = found[:1]
    roles: dict[str, str] = {}
    for role, found in chosen.items():
        for name in found:
            if name in roles:
                raise InputError(f"column {name!r} is of {roles[name]} and of {role}: must be of one")
            roles[name] = role
    used = {*roles, *UNUSED, *(name for known in OPTIONAL.values() for name in known)}
    return chosen, [name for name in names if name not in used and not name.startswith("next")]


def _of_stem(role: str, names: Sequence[str], given: str | Sequence[str] | None) -> list[str]:
    if given is not None:
        prefixes = [given] if isinstance(given, str) else list(given)
        found = [name for prefix in prefixes for name in _with_prefix(names, prefix)]
        missing = [prefix for prefix in prefixes if not _with_prefix(names, prefix)]
        if missing or not prefixes:
            raise InputError(f"columns has {role} {missing or given!r}: must be names or prefixes of {_listed(names)}")
        return found
    stems = [stem for stem in STEMS[role] if any(_is_of(stem, name) for name in names)]
    if not stems:
        raise InputError(f"has no {role} (found {_listed(names)}): {RULE}")
    if len(stems) > 1:
        raise InputError(f"has columns of {' and of '.join(stems)}, both {role}: {RULE}")
    return _in_order([name for name in names if _is_of(stems[0], name)])


def _is_of(stem: str, name: str) -> bool:
    return re.match(rf"{stem}($|[_./\[])", name) is not None


def _with_prefix(names: Sequence[str], prefix: str) -> list[str]:
    return [prefix] if prefix in names else _in_order([name for name in names if prefix and name.startswith(prefix)])


def _in_order(names: list[str]) -> list[str]:
    """By the numbers that all names end in, where they do; a gap in them is an error, not another column's place."""
    ends = [re.fullmatch(r"(.*?)(\d{1,9})\]?", name, re.DOTALL) for name in names]
    if len(names) < 2 or not all(ends) or len({end[1] for end in ends if end}) > 1:
        return names
    numbers = {int(end[2]): name for end, name in zip(ends, names, strict=True) if end}
    ordered = sorted(numbers)
    if len(numbers) < len(names) or ordered[-1] - ordered[0] + 1 != len(names):
        found = ", ".join(numbers[number] for number in ordered[:LISTED])
        raise InputError(f"columns {found} are numbered with gaps: must have all, or be named by columns")
    return [numbers[number] for number in ordered]


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(repr(name[:60]) for name in names[:LISTED])
    return f"{shown} and {len(names) - LISTED} more" if len(names) > LISTED else shown or "no columns"
