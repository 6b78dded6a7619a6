"""Runs what a plan lacks, in worker processes; as many supervisors as one likes may share a store."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from typing import Any

from ppo_dap.study.store.cells import Cell
from ppo_dap.study.store.claims import Watch
from ppo_dap.study.store.plan import Plan
from ppo_dap.study.store.show import Show
from ppo_dap.study.store.worker import DONE, FAILED, LOST, STOPPED, TAKEN

COMMAND = (sys.executable, "-m", "ppo_dap.study.store.worker")
"""What makes a cell, given store, cell and claim."""
ATTEMPTS = 2
"""A cell that fails this often is given up."""
DEATHS = 12
"""So is one whose worker was killed this often without a checkpoint in between."""


@dataclass(frozen=True)
class Worker:
    """A worker's process, wherever it runs."""

    ended: Future[tuple[int | None, str]]
    """Its exit code (-n: killed by signal n; None: lost, with its machine) and the last line of its stderr, or the
    reason of its loss."""
    interrupt: Callable[[], None]
    """Asks it to stop, as Ctrl-C does."""
    kill: Callable[[], None]
    """Ends it at once."""


Launch = Callable[[Sequence[str]], Worker]
"""Starts a worker's command somewhere."""


def launch_here(command: Sequence[str]) -> Worker:
    """Start a worker on this machine, in a session of its own: Ctrl-C reaches it through us alone, and once."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=os.environ | {"NPROC": "1"},
        start_new_session=True,
    )
    ended: Future[tuple[int | None, str]] = Future()

    def attend() -> None:
        _, errors = process.communicate()
        lines = errors.decode(errors="replace").strip().splitlines()
        ended.set_result((process.returncode, lines[-1] if lines else ""))

    threading.Thread(target=attend, daemon=True).start()
    return Worker(ended, lambda: process.send_signal(signal.SIGINT), process.kill)


@dataclass
class Supervisor:
    """Starts a worker for each cell that can be made, and counts how they end."""

    plan: Plan
    workers: int
    show: Show
    command: Sequence[str] = COMMAND
    launch: Launch = launch_here
    watch: Watch = field(default_factory=Watch)
    poll: float = 2.0
    """Seconds between two looks at what other supervisors do."""
    failed: dict[Cell, str] = field(default_factory=dict)
    """Cells that were given up, with the error's last line."""
    running: dict[Cell, Worker] = field(default_factory=dict)

    def __post_init__(self):
        self.store = self.plan.store
        self.open = dict.fromkeys(self.plan.missing)
        self.done = set(self.plan.done)
        # What failed before we came is tried again: whoever starts a study anew has mended something.
        self._before = {cell: len(self.store.failures(cell.name)) for cell in self.open}
        self._errors: dict[Cell, list[str]] = {}
        self._deaths: dict[Cell, tuple[Any, int]] = {}
        self._ended: queue.Queue[tuple[Cell, Future[tuple[int | None, str]]]] = queue.Queue()

    def run(self) -> bool:
        """Until there is nothing left to do; returns whether everything is done. After Ctrl-C workers end at their
        next checkpoint, after a second one at once.
        """
        try:
            with self.show:
                while self.open or self.running:
                    self._start_some()
                    self.show.update(self)
                    self._wait()
                    if not self.running and self._stuck():
                        break
                self.show.update(self)
        except KeyboardInterrupt:
            self._stop()
            raise
        return len(self.done) == len(self.plan.cells)

    def blocked(self) -> list[Cell]:
        """Cells that cannot be made since something that they need was given up."""
        lost: set[Cell] = set(self.failed)
        for cell in self.open:
            if any(need in lost for need in cell.needs.values()):
                lost.add(cell)
        return [cell for cell in self.open if cell in lost]

    def left(self) -> float:
        """Seconds to go, by the plan's estimates."""
        return sum(self.plan.seconds(cell) for cell in (*self.open, *self.running)) / self.workers

    def _stuck(self) -> bool:
        return len(self.blocked()) == len(self.open)

    def _start_some(self) -> None:
        """Fill the free places; on the way notice what others have done."""
        for cell in list(self.open):
            if len(self.running) >= self.workers:
                return
            if not all(need in self.done for need in cell.needs.values()):
                continue
            if self.store.done(cell):
                self._settle(cell)
            elif not self._give_up(cell):
                number = self.watch.free(self.store.folder(cell))
                if number is not None:
                    self._start(cell, number)

    def _start(self, cell: Cell, number: int) -> None:
        self.store.prepare(cell)
        worker = self.launch([*self.command, str(self.store.root.absolute()), cell.name, str(number)])
        del self.open[cell]
        self.running[cell] = worker
        worker.ended.add_done_callback(lambda ended: self._ended.put((cell, ended)))

    def _wait(self) -> None:
        """Until a worker ends, or for `poll` seconds."""
        try:
            ended = [self._ended.get(timeout=self.poll)]
            while not self._ended.empty():
                ended.append(self._ended.get())
        except queue.Empty:
            return
        for cell, how in ended:
            del self.running[cell]
            self._judge(cell, *how.result())

    def _judge(self, cell: Cell, code: int | None, line: str) -> None:
        if code == DONE:
            self._settle(cell)
            return
        self.open[cell] = None
        if code in (TAKEN, LOST, STOPPED):
            return
        if code is None or code < 0 or code > 128:
            self._died(cell, line if code is None else signal.Signals(-code).name if code < 0 else f"code {code}")
        else:
            self._errors.setdefault(cell, []).append(line or f"its worker ended with code {code}")
        if not self._give_up(cell) and code == FAILED:
            self.show.say(f"{cell}: failed, is tried once more: {line}")

    def _died(self, cell: Cell, how: str) -> None:
        """Killed, by whomever: begun again, unless it never gets any further (it may be short of memory)."""
        reached = [path.stat().st_mtime_ns for path in self.store.out(cell).rglob("last.safetensors")]
        before, count = self._deaths.get(cell, (None, 0))
        self._deaths[cell] = reached, count + 1 if before == reached else 1
        self.show.say(f"{cell}: its worker was killed ({how}), goes on")
        if self._deaths[cell][1] >= DEATHS:
            self._errors[cell] = [f"its worker was killed {DEATHS} times ({how}) and got no further"] * ATTEMPTS

    def _give_up(self, cell: Cell) -> bool:
        """Whether the cell has failed too often, here and at other supervisors together."""
        own, all_ = self._errors.get(cell, []), self.store.failures(cell.name)[self._before[cell] :]
        errors = own if len(own) >= len(all_) else all_
        if len(errors) < ATTEMPTS:
            return False
        self.open.pop(cell, None)
        self.failed[cell] = errors[-1]
        self.show.say(f"{cell}: FAILED: {errors[-1]} ({self.store.folder(cell)})")
        return True

    def _settle(self, cell: Cell) -> None:
        self.open.pop(cell, None)
        self.done.add(cell)
        self.plan.learn(cell)
        self.show.finished(self, cell)

    def _stop(self) -> None:
        """End the workers: as a person at their terminal would."""
        self.show.say(f"stopping: {len(self.running)} workers write their checkpoints")
        try:
            for worker in self.running.values():
                worker.interrupt()
            wait([worker.ended for worker in self.running.values()])
        except KeyboardInterrupt:
            for worker in self.running.values():
                worker.kill()


def raise_on_terminate() -> None:
    """Have SIGTERM end us as Ctrl-C does."""

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)


def run_plan(plan: Plan, workers: int, show: Show | None = None, launch: Launch = launch_here) -> bool:
    """Make what is missing; returns whether everything is there now, and prints what is not.

    Raises `InputError` for a store that holds a cell under other settings, `OSError` for one that cannot be written.
    """
    start = time.perf_counter()
    supervisor = Supervisor(plan, workers, show or Show(), launch=launch)
    complete = supervisor.run()
    taken = (time.perf_counter() - start) / 3600
    count = f"{len(supervisor.done)} of {len(plan.cells)}"
    supervisor.show.say(f"{plan.study.name}: {count} cells are there ({taken:.2f} h)")
    for cell, error in supervisor.failed.items():
        supervisor.show.say(f"failed: {cell}: {error}")
    for cell in supervisor.blocked():
        supervisor.show.say(f"not made, for want of what failed: {cell}")
    return complete
