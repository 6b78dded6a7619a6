"""Workers on the nodes of a Ray cluster.

Ray lives in a process of its own, the agent (`python -m ppo_dap.study.store.ray_cluster`): it prints what it likes,
takes signals over, waits two minutes for an address where nobody answers, and ends its process with the cluster.
The agent and the planner exchange lines of JSON; the agent ends when the planner does, and Ray then ends its tasks.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import logging
import os
import queue
import secrets
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from ppo_dap.errors import InputError, PPODAPError
from ppo_dap.study.store.supervise import Worker
from ppo_dap.study.store.worker import FAILED, STOPPED, told

WAIT = 60.0
"""Seconds that a cluster has to answer."""
CHECK_WAIT = 60.0
"""Seconds that its nodes have to look at the store."""
SAME = ("PYTHONPATH", "JAX_DEFAULT_MATMUL_PRECISION", "JAX_PLATFORMS", "OMP_NUM_THREADS", "XLA_FLAGS")
"""What a worker finds in its environment as the planner does; the rest is the node's. Ray sets one of them itself."""
LOOK = """
import pathlib, sys, ppo_dap.study.store.worker
mark = pathlib.Path(sys.argv[1])
if not mark.is_file():
    sys.exit("another folder has this name there" if mark.parent.is_dir() else "there is no such folder")
"""
"""What a node runs before work begins: whether it can import the worker, and sees a file that the planner has made."""


class Cluster:
    """The Ray cluster at `address` (HOST:PORT, auto or local) as a place for workers, as long as the `with` lasts.

    Raises `InputError` without Ray, if no cluster answers within `wait` seconds, and for a node on which a worker
    cannot start or which does not see the folder `root`.
    """

    cpus: int
    """What the nodes have in all: each worker takes one."""

    def __init__(self, address: str, root: Path, wait: float = WAIT):
        if "://" in address:
            raise InputError(f"--ray {address}: must be HOST:PORT, auto or local, from a machine of the cluster")
        if importlib.util.find_spec("ray") is None:
            raise InputError("--ray needs the extra `ray`: pip install ppo-dap[ray]")
        self._address, self._lock = address, threading.Lock()
        self._workers: dict[int, Future[tuple[int | None, str]]] = {}
        self._number, self._gone = 0, False
        self._said: queue.Queue[dict[str, Any]] = queue.Queue()
        self._agent = subprocess.Popen(
            [sys.executable, "-m", __name__, address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0"},
            start_new_session=True,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self._expect("joined", wait)
            with marked(root) as mark:
                self.cpus = self.look(mark)
        except BaseException:
            self._agent.kill()
            self.close()
            raise

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def launch(self, command: Sequence[str]) -> Worker:
        """Start the arguments of a Python's command with the Python of whichever node has a CPU to spare."""
        ended: Future[tuple[int | None, str]] = Future()
        with self._lock:
            number = self._number = self._number + 1
            self._workers[number] = ended
            gone = self._gone
        if gone:
            self._lose()
        self._ask(number=number, command=command[1:])
        return Worker(
            ended, lambda: self._ask(number=number, force=False), lambda: self._ask(number=number, force=True)
        )

    def look(self, mark: Path) -> int:
        """Have every node look for a file in the store; returns their CPUs. Raises `InputError` if one lacks it."""
        self._ask(look=str(mark))
        return self._expect("cpus", None)["cpus"]

    def close(self) -> None:
        """Leave the cluster; workers that still run end by themselves."""
        with contextlib.suppress(OSError):
            self._agent.stdin.close()  # type: ignore[union-attr]
        try:
            self._agent.wait(WAIT)
        except subprocess.TimeoutExpired:
            self._agent.kill()
            self._agent.wait()
        self._reader.join()

    def _ask(self, **request: Any) -> None:
        with contextlib.suppress(OSError, ValueError), self._lock:  # if the agent is gone, `_read` says so
            print(json.dumps(request), file=self._agent.stdin, flush=True)

    def _expect(self, what: str, wait: float | None) -> dict[str, Any]:
        try:
            said = self._said.get(timeout=wait)
        except queue.Empty:
            raise InputError(f"--ray {self._address}: no Ray cluster answered within {wait:g} s") from None
        if what not in said:
            raise InputError(f"--ray {self._address}: {said['error']}")
        return said

    def _read(self) -> None:
        with self._agent.stdout as lines:  # type: ignore[union-attr]
            for line in lines:
                said = json.loads(line)
                if "ended" in said:
                    self._workers.pop(said["ended"]).set_result((said["code"], said["line"]))
                else:
                    self._said.put(said)
        with self._lock:
            self._gone = True
        self._said.put({"error": "Ray ended without a word"})
        self._lose()

    def _lose(self) -> None:
        """Tell who waits for a worker that there is no cluster any more."""
        with self._lock:
            lost, self._workers = self._workers, {}
        for ended in lost.values():
            error = f"the Ray cluster at {self._address} is gone: call again when it is back, and the study goes on"
            ended.set_exception(PPODAPError(error))


@contextlib.contextmanager
def marked(root: Path) -> Iterator[Path]:
    """A file in the store that no other folder has, as long as the `with` lasts."""
    mark = root.absolute() / f".ray-{secrets.token_hex(8)}"
    (root / "cells").mkdir(parents=True, exist_ok=True)  # without it a folder is no store
    mark.touch()
    try:
        yield mark
    finally:
        mark.unlink(missing_ok=True)


def run_command(arguments: Sequence[str], variables: Mapping[str, str | None]) -> tuple[int, str]:
    """A Ray task: run this node's Python with `arguments`; returns its exit code and the last line of its stderr.

    `ray.cancel` has it interrupt the command and go on waiting. The agent is a main program, so Ray sends nodes this
    function itself and not its name: it uses nothing of this module.
    """
    import os
    import signal
    import subprocess
    import sys

    asked: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    # Ray blocks SIGINT in what it starts, and a command inherits that.
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    try:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={name: value for name, value in (os.environ | dict(variables)).items() if value is not None},
            start_new_session=True,
        )
        passed_on = False
        while True:
            try:
                _, errors = process.communicate(timeout=0.2)
                break
            except subprocess.TimeoutExpired:
                if asked and not passed_on:
                    process.send_signal(signal.SIGINT)
                    passed_on = True
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(signal.SIGINT, before)
    lines = errors.decode(errors="replace").strip().splitlines()
    return process.returncode, lines[-1] if lines else ""


def one_line(error: BaseException) -> str:
    """Ray's errors are long."""
    text = " ".join(str(error).split())
    return text if len(text) < 200 else f"{text[:200]}..."


def check_nodes(task: Any, variables: Mapping[str, str | None], mark: Path) -> int:
    """Have each node with a CPU look for the file `mark` in the store; returns their CPUs in all."""
    import ray
    from ray import exceptions
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    nodes = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
    looks = []
    for node in nodes:  # it takes no CPU: it does not wait for what others run there
        there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        where = task.options(num_cpus=0, scheduling_strategy=there)
        looks.append(where.remote(["-c", LOOK, str(mark)], variables))
    for node, look in zip(nodes, looks, strict=True):
        try:
            code, line = ray.get(look, timeout=CHECK_WAIT)
        except exceptions.RayError as error:
            code, line = FAILED, f"{type(error).__name__}: {one_line(error)}"
        if code:
            name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            need = "each needs ppo-dap installed, and the store as the same folder"
            raise InputError(f"node {name} cannot work on the store {mark.parent}: {line}; {need}")
    if not nodes:
        raise InputError("no node of the cluster has a CPU")
    return sum(int(node["Resources"]["CPU"]) for node in nodes)


def how_it_ended(result: Future[tuple[int, str]]) -> tuple[int | None, str]:
    """What `Worker.ended` holds, of a task's result; ends the agent if it has lost its own node, and so the cluster."""
    from ray import exceptions

    try:
        return result.result()
    except exceptions.LocalRayletDiedError:
        os._exit(1)
    except exceptions.TaskCancelledError:  # before it began, or by force
        return STOPPED, ""
    except exceptions.RayTaskError as error:  # an error of `run_command`: the node cannot start processes
        return FAILED, told(error.cause)
    except exceptions.RayError as error:
        return None, type(error).__name__


def serve(tell: Callable[..., None], address: str) -> None:
    """Join the cluster, then do what the lines of stdin ask for, until they end."""
    import ray

    dashboard = False if address == "local" else None
    ray.init(address, include_dashboard=dashboard, log_to_driver=False, logging_level=logging.CRITICAL)
    tell(joined=address)
    variables = {name: os.environ.get(name) for name in SAME} | {"NPROC": "1"}
    if variables["PYTHONPATH"]:  # as it is read here: nodes have other working folders
        variables["PYTHONPATH"] = os.pathsep.join(map(os.path.abspath, variables["PYTHONPATH"].split(os.pathsep)))
    # Whether to begin again is for the planner to say: it knows who holds the cell, and how often its workers died.
    task = ray.remote(num_cpus=1, max_retries=0)(run_command)
    running: dict[int, Any] = {}

    def finish(number: int, result: Future[tuple[int, str]]) -> None:
        code, line = how_it_ended(result)
        running.pop(number, None)
        tell(ended=number, code=code, line=line)

    for line in sys.stdin:
        request = json.loads(line)
        number = request.get("number")
        if "look" in request:
            try:
                tell(cpus=check_nodes(task, variables, Path(request["look"])))
            except InputError as error:
                tell(error=str(error))
        elif "command" in request:
            running[number] = task.remote(request["command"], variables)
            running[number].future().add_done_callback(functools.partial(finish, number))
        elif number in running:
            ray.cancel(running[number], force=request["force"])
    ray.shutdown()


def main(address: str) -> int:
    """The agent."""
    lock, lines = threading.Lock(), os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what Ray prints goes where its logs go

    def tell(**said: Any) -> None:
        with contextlib.suppress(OSError), lock:  # the planner may be gone
            print(json.dumps(said), file=lines, flush=True)

    try:
        serve(tell, address)
    except (Exception, SystemExit) as error:
        tell(error=one_line(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
