"""Ctrl-C ends a run at its next checkpoint: one before its time would have the resumed run restart environments where
no other run does.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass
class Interrupt:
    """Whether the run was asked to end."""

    asked: bool = False
    _told: bool = False

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Ctrl-C is noted; a second one ends the run at once."""

        def note(signum, frame):
            self.asked = True
            signal.signal(signal.SIGINT, previous)

        try:
            previous = signal.signal(signal.SIGINT, note)
        except ValueError:  # not the main thread: whoever runs us handles signals
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, previous)

    def tell(self, folder: Path, left: int) -> None:
        """Say once that the run in `folder` ends after `left` more iterations, if it was asked to."""
        if self.asked and not self._told:
            text = f"stopping at the next checkpoint, after {left} more iterations; Ctrl-C again stops at once"
            print(f"{folder}: {text}", file=sys.stderr, flush=True)
            self._told = True
