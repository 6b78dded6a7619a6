"""Who is at work on a cell: claims that survive kills, and hold among machines that share nothing but a folder.

A claim is a file `claim-N` in the cell's folder. The newest N holds; the next one is made with O_EXCL, so that one
process alone can take over from a holder that released its claim, died, or fell silent. A holder touches its file now
and then; silence is told by the watcher's own clock, since clocks of machines differ. A holder that finds a newer claim
than its own has been taken for dead, and must stop writing at once.
"""

from __future__ import annotations

import json
import os
import platform
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from ppo_dap.storage import write_atomically

LEASE = 120.0
"""Seconds of silence after which a holder on another machine is taken for dead."""
BEAT = 4.0
"""Seconds between two signs of life."""


class Newest(NamedTuple):
    """The claim that holds."""

    number: int
    content: dict[str, Any]
    beat: int
    """Modification time in ns; only whether it changes counts."""


def newest(folder: Path) -> Newest | None:
    """The claim that holds, or None where there has been none."""
    try:
        names = os.listdir(folder)
    except FileNotFoundError:
        return None
    found = [int(name[6:]) for name in names if name.startswith("claim-") and name[6:].isdigit()]
    if not found:
        return None
    path = folder / f"claim-{max(found)}"
    try:
        beat = path.stat().st_mtime_ns
        content = json.loads(path.read_text())
    except FileNotFoundError:  # it was renewed or removed under our eyes: look again
        return newest(folder)
    except ValueError:  # its maker has not written it out yet, and may never
        return Newest(max(found), {}, beat)
    return Newest(max(found), content, beat)


@dataclass
class Watch:
    """Tells which cells may be claimed. It has to be asked again and again to notice a silence."""

    lease: float = LEASE
    _seen: dict[Path, tuple[tuple[int, int], float]] = field(default_factory=dict)

    def free(self, folder: Path) -> int | None:
        """The number that a claim on this cell would have, or None while another process is at it."""
        last = newest(folder)
        if last is None:
            return 1
        if last.content.get("released") or died(last.content):
            return last.number + 1
        sign, now = (last.number, last.beat), time.monotonic()
        if folder not in self._seen or self._seen[folder][0] != sign:
            self._seen[folder] = sign, now
        return last.number + 1 if now - self._seen[folder][1] > self.lease else None


@dataclass(frozen=True)
class Claim:
    """A claim of this process."""

    folder: Path
    number: int

    @property
    def path(self) -> Path:
        """Its file."""
        return self.folder / f"claim-{self.number}"

    @property
    def holds(self) -> bool:
        """Whether no other process has taken over."""
        last = newest(self.folder)
        return last is not None and last.number == self.number

    def release(self) -> None:
        """Let others have the cell."""
        if self.holds:
            write_atomically(self.path, json.dumps({"released": True}).encode())

    def remove(self) -> None:
        """Take the claims on a finished cell away; nobody works on one again."""
        for number in range(1, self.number + 1):
            (self.folder / f"claim-{number}").unlink(missing_ok=True)


def take(folder: Path, number: int) -> Claim | None:
    """Claim a cell under the number that `Watch.free` gave; None if another process was faster."""
    claim = Claim(folder, number)
    last = newest(folder)
    if last is not None and last.number >= number:
        return None
    try:
        handle = os.open(claim.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return None
    with os.fdopen(handle, "w") as file:
        json.dump({"host": host(), "pid": os.getpid(), "started": _started(os.getpid())}, file)
    for older in range(1, number):
        (folder / f"claim-{older}").unlink(missing_ok=True)
    return claim


class Heart:
    """Signs of life of a claim, from a thread of its own, as long as the `with` lasts.

    `lost` is called when another process has taken over, or when the process that started this one is gone.
    """

    def __init__(self, claim: Claim, lost: Callable[[], None], every: float = BEAT):
        self._claim, self._lost, self._every = claim, lost, every
        self._parent, self._stop = os.getppid(), threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> Heart:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._stop.wait(self._every):
            try:
                gone = not self._claim.holds or os.getppid() != self._parent
                os.utime(self._claim.path)
            except FileNotFoundError:
                gone = True
            except OSError:  # a shared folder can be away for a moment
                continue
            if gone:
                self._lost()
                return


@cache
def host() -> str:
    """This machine, as long as it is up: process numbers mean something within it alone."""
    parts = [platform.node()]
    for read in (lambda: Path("/proc/sys/kernel/random/boot_id").read_text(), lambda: os.readlink("/proc/self/ns/pid")):
        try:
            parts.append(read().strip())
        except OSError:
            parts.append("")
    return " ".join(parts)


def died(content: dict[str, Any]) -> bool:
    """Whether a claim's holder ran on this machine and is no more."""
    if content.get("host") != host():
        return False
    if Path("/proc/self/stat").exists():
        return _started(content["pid"]) != content["started"]
    try:
        os.kill(content["pid"], 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def _started(pid: int) -> int | None:
    """When a process started, in clock ticks since the machine did; None for one that is no more, or cannot tell."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if state == "Z" else int(rest[18])
