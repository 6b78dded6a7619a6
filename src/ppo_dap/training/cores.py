"""Which core a run's rollout stays on.

The policy and the thread that steps the environments take turns. On one core the hand-over is a switch; on two it wakes
a sleeping core every time, which costs stepping rate, most on a virtual machine.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def pinned(enabled: bool) -> Iterator[int | None]:
    """Keep the calling thread, and those that it starts, on a core that no other run of this user has claimed.

    Gives the core, or None where there is none left, where it is not `enabled`, or where the system has no affinities.
    A claim is a locked file, so that it ends with the process however that ends.
    """
    if not (enabled and hasattr(os, "sched_setaffinity")):
        yield None
        return
    import fcntl

    allowed = os.sched_getaffinity(0)
    folder = Path(tempfile.gettempdir())
    for core in sorted(allowed):
        try:
            claim = open(folder / f"ppo-dap-{os.getuid()}-core-{core}.lock", "w")  # noqa: SIM115 (held while pinned)
        except OSError:
            continue
        with claim:
            try:
                fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            os.sched_setaffinity(0, {core})
            try:
                yield core
            finally:
                os.sched_setaffinity(0, allowed)
            return
    yield None
