"""The errors that a user can cause or must act on. The command line turns each into one line and an exit code."""

import difflib
from collections.abc import Iterable


class PPODAPError(Exception):
    """Base of every error that this package raises on purpose."""

    exit_code = 1


class InputError(PPODAPError, ValueError):
    """Bad input: names the field, the value and what would be right. Exit code 2."""

    exit_code = 2


class TrainingDiverged(PPODAPError, RuntimeError):
    """A loss or a parameter stopped being finite; names the iteration, the loss and the last good checkpoint."""


class AuditViolation(PPODAPError, RuntimeError):
    """A clause of Definition 1 does not hold."""


MANY = 20
"""More names than this are not listed when one of them is near."""


def unknown(what: str, value: object, known: Iterable[str]) -> InputError:
    """An `InputError` for a name that is not in `known`, with the nearest known name when one is near."""
    names = sorted(known)
    near = difflib.get_close_matches(str(value), names, n=1)
    if near and len(names) > MANY:
        return InputError(f"unknown {what} {value!r}: did you mean {near[0]!r}?")
    hint = f"did you mean {near[0]!r}? " if near else ""
    return InputError(f"unknown {what} {value!r}: {hint}known are {', '.join(names) or 'none'}")
