"""What a check says, and all of them together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ppo_dap.logs.jumps import Jumps
from ppo_dap.logs.neighbours import Mixture, Neighbours

EXIT_CODES = {"ok": 0, "warning": 1, "error": 2}


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    level: Literal["ok", "warning", "error"]
    name: str
    message: str


@dataclass(frozen=True)
class Report:
    """The findings of `check_logs`; `str(report)` is a table for a terminal."""

    lines: tuple[Finding, ...]
    jumps: Jumps | None = None
    neighbours: Neighbours | None = None
    mixture: Mixture | None = None

    @property
    def exit_code(self) -> int:
        """0 all ok, 1 a warning, 2 an error."""
        return max((EXIT_CODES[line.level] for line in self.lines), default=0)

    def __str__(self) -> str:
        width = max((len(line.name) for line in self.lines), default=0)
        return "\n".join(f"{line.level:<7}  {line.name:<{width}}  {line.message}" for line in self.lines)


def columns(found: object) -> str:
    """Column numbers for a message; long lists are cut."""
    numbers = [str(number) for number in found]  # type: ignore[attr-defined]
    return ", ".join(numbers[:12]) + (f" and {len(numbers) - 12} more" if len(numbers) > 12 else "")
