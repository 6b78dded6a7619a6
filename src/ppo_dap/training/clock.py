"""Where an iteration's time goes: on the host by what it does, on the device by stage, without waiting for either."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import jax

HOST = {
    "env": "environment",
    "policy": "policy",
    "waiting": "waiting for the actor",
    "host": "statistics, random numbers",
    "recording": "recording",
}
DEVICE = {
    "gae": "GAE",
    "update": "actor, V and Q",
    "proposals": "proposals",
    "pet": "PET",
    "audit": "audits",
}


class Line(NamedTuple):
    """One line of a profile."""

    name: str
    beside: bool
    """Whether it is the device's time, which goes by while the host collects the next rollout."""
    seconds: float
    share: float
    """Of the iterations' wall-clock."""


def profile(metrics: Sequence[Mapping[str, Any]]) -> list[Line]:
    """Where the time of a run's iterations went, in all; the first, which compiles, is left out.

    The host's lines add up to the wall-clock.
    """
    rows = [row for row in metrics[1:] if "seconds_iteration" in row]
    total = sum(row["seconds_iteration"] for row in rows)
    if not total:
        return []

    def line(name: str, label: str, beside: bool) -> Line:
        seconds = sum(row.get(f"seconds_{name}", 0.0) for row in rows)
        return Line(label, beside, seconds, seconds / total)

    host = [line(name, label, False) for name, label in HOST.items()]
    rest = total - sum(entry.seconds for entry in host)
    host.append(Line("dispatch and the rest", False, rest, rest / total))
    return host + [line(name, label, True) for name, label in DEVICE.items()]


class Clock:
    """Seconds by name.

    The device works through the stages in the order in which they were dispatched, so a stage's time goes from when its
    predecessor was done (or from its own dispatch) to when its own result is there. A thread waits for that.
    """

    def __init__(self):
        self._stages: queue.SimpleQueue = queue.SimpleQueue()
        self._seconds: dict[str, float] = {}
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def dispatch(self, name: str, stage: Callable[..., Any], *arguments: Any) -> Any:
        """Call a jitted function, whose time on the device counts for `name`."""
        start = time.perf_counter()
        result = stage(*arguments)
        self._stages.put((name, start, jax.tree.leaves(result)[-1], self._seconds))
        return result

    @contextmanager
    def host(self, name: str) -> Iterator[None]:
        """Take the time of a block of the host's."""
        start = time.perf_counter()
        yield
        self.add(name, time.perf_counter() - start)

    def add(self, name: str, seconds: float) -> None:
        """Count `seconds` for `name`."""
        self._seconds[name] = self._seconds.get(name, 0.0) + seconds

    def turn(self) -> Callable[[], Mapping[str, float]]:
        """Begin a new iteration; returns what gives the last one's seconds, once its stages are done."""
        seconds, done = self._seconds, threading.Event()
        self._stages.put(done)
        self._seconds = {}

        def result() -> Mapping[str, float]:
            done.wait()
            return seconds

        return result

    def close(self) -> None:
        """End the thread."""
        self._stages.put(None)
        self._thread.join()

    def _watch(self) -> None:
        ready = 0.0
        while (item := self._stages.get()) is not None:
            if isinstance(item, threading.Event):
                item.set()
                continue
            name, start, result, seconds = item
            with suppress(Exception):  # whoever reads the result is told; here it must not leave `turn` waiting
                result.block_until_ready()
            start, ready = max(start, ready), time.perf_counter()
            seconds[name] = seconds.get(name, 0.0) + ready - start
