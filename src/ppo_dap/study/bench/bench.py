"""`ppo-dap bench`: what PPO, the method and its parts cost, as ratios measured inside one run.

Every figure is a median over repeats that take turns (A B A B). Training runs are processes of their own, timed by
their own clock from the second iteration on, so that start-up and compilation are apart.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ppo_dap.errors import PPODAPError
from ppo_dap.training.manifest import manifest, prepare_jax
from ppo_dap.training.recording import read_table

VARIANTS: dict[str, tuple[str, ...]] = {
    "ppo": ("--method", "ppo"),
    "dap": (),
    "dap_fast": ("--sampler", "dpmpp_2m", "--sampler-steps", "10"),
    "dap_full_states": ("--proposal-fraction", "1"),
}
"""What is timed; all but PPO get the prior, and nothing else differs from the recipe and preset `paper`."""
LOG_ROWS = 100_000
PEERS = ("sb3", "sbx", "tianshou", "skrl", "cleanrl")


@dataclass
class Bench:
    """One run of the benchmark, in a folder of its own that is removed afterwards."""

    folder: Path
    steps: int
    repeats: int
    peers: Path | None
    say: Callable[[str], None]

    def task(self, task: str) -> dict[str, Any]:
        """All figures of one task."""
        behaviour = self.folder / f"{task}-behaviour"
        train_for(behaviour, task, ("--method", "ppo"), LOG_ROWS)
        logs, prior = self.folder / f"{task}.npz", self.folder / f"{task}-prior"
        _run(["collect", str(behaviour), "--steps", str(LOG_ROWS), "--out", str(logs)])
        start = time.perf_counter()
        _run(["pretrain", "--logs", str(logs), "--out", str(prior), "--quiet"])
        row: dict[str, Any] = {"fit_s": time.perf_counter() - start}
        self.say(f"{task}: prior fitted to {LOG_ROWS:,} rows in {row['fit_s']:.0f} s, with start-up")
        speeds, memory, audits = self._interleaved(task, behaviour, prior)
        row["steps_per_second"] = {name: statistics.median(values) for name, values in speeds.items()}
        row |= self._ratios(speeds, memory)
        row["audit_share"] = statistics.median(audits)
        row |= self._starts(task, prior)
        row |= self._side_by_side(task, prior)
        row["sampler_of_gemm"] = float(_python("-m", "ppo_dap.study.bench.ceiling", "sampler", str(prior)))
        return row

    def _interleaved(self, task: str, behaviour: Path, prior: Path):
        """Steps per second and peak memory by what was run, a value a repeat, and the method's shares of audits."""
        speeds: dict[str, list[float]] = defaultdict(list)
        memory: dict[str, list[float]] = defaultdict(list)
        audits: list[float] = []
        for repeat in range(self.repeats):
            policy = str(behaviour / "policy.safetensors")
            ceiling = _python("-m", "ppo_dap.study.bench.ceiling", "env", task, policy, str(self.steps))
            speeds["ceiling"].append(float(ceiling))
            for name, options in VARIANTS.items():
                folder = self.folder / f"{task}-{name}-{repeat}"
                given = options if name == "ppo" else (*options, "--prior", str(prior))
                memory[name].append(self._train(folder, task, given))
                metrics = read_table(folder, "metrics")
                speeds[name].append(speed(metrics))
                audits += [audit_share(metrics)] if name == "dap" else []
            for peer in PEERS if self.peers else ():
                speeds[peer].append(self._peer(peer, task))
            self.say(f"{task}, repeat {repeat + 1}: " + ", ".join(f"{n} {v[-1]:,.0f}" for n, v in speeds.items()))
        return speeds, memory, audits

    def _ratios(self, speeds: Mapping[str, Sequence[float]], memory: Mapping[str, Sequence[float]]) -> dict[str, float]:
        def ratio(above: str, below: str) -> float:
            """Median over the repeats of the ratio inside each."""
            pairs = zip(speeds[above], speeds[below], strict=True)
            return statistics.median(a / b for a, b in pairs)

        result = {
            "ppo_of_ceiling": ratio("ppo", "ceiling"),
            "dap_wall_x_ppo": ratio("ppo", "dap"),
            "dap_memory_x_ppo": statistics.median(memory["dap"]) / statistics.median(memory["ppo"]),
            "dap_fast_wall_x_ppo": ratio("ppo", "dap_fast"),
            "dap_full_states_wall_x_ppo": ratio("ppo", "dap_full_states"),
        }
        for peer in PEERS if self.peers else ():
            result |= {f"ppo_x_{peer}": ratio("ppo", peer), f"dap_x_{peer}": ratio("dap", peer)}
        return result

    def _starts(self, task: str, prior: Path) -> dict[str, float]:
        """Seconds from the command to the first finished iteration, with an empty compilation cache and a full one."""
        starts: dict[str, list[float]] = {"cold_start_s": [], "warm_start_s": []}
        for repeat in range(self.repeats):
            cache = self.folder / f"cache-{repeat}"
            for name, values in starts.items():
                folder = self.folder / f"{task}-{name}-{repeat}"
                values.append(self._first_iteration(folder, task, prior, cache))
            shutil.rmtree(cache)
        return {name: statistics.median(values) for name, values in starts.items()}

    def _first_iteration(self, folder: Path, task: str, prior: Path, cache: Path) -> float:
        arguments = _training(folder, task, ("--prior", str(prior)), 2048)
        start = time.perf_counter()
        process = _start(arguments, {"JAX_COMPILATION_CACHE_DIR": str(cache)})
        metrics = folder / "metrics.jsonl"
        while process.poll() is None and not (metrics.is_file() and metrics.stat().st_size):
            time.sleep(0.01)
        seconds = time.perf_counter() - start
        _finish(process, arguments)
        return seconds

    def _side_by_side(self, task: str, prior: Path) -> dict[str, float]:
        """Steps per second of two runs at once over those of one, on all the cores there are."""
        result = {}
        for name, options in {"ppo": ("--method", "ppo"), "dap": ("--prior", str(prior))}.items():
            ratios = []
            for repeat in range(self.repeats):
                folders = [self.folder / f"{task}-{name}-side-{repeat}-{i}" for i in range(3)]
                self._train(folders[0], task, options)
                both = [_training(folder, task, options, self.steps) for folder in folders[1:]]
                for process, arguments in [(_start(arguments), arguments) for arguments in both]:
                    _finish(process, arguments)
                one, *two = [speed(read_table(folder, "metrics")) for folder in folders]
                ratios.append(sum(two) / one)
            result[f"two_{name}_runs_x_one"] = statistics.median(ratios)
        return result

    def _train(self, folder: Path, task: str, options: Sequence[str]) -> float:
        return train_for(folder, task, options, self.steps)

    def _peer(self, peer: str, task: str) -> float:
        assert self.peers is not None
        script = Path("benchmarks") / "peers" / f"run_{peer}.py"
        command = [str(self.peers), str(script), "--task", task, "--steps", str(self.steps)]
        environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise PPODAPError(f"`{' '.join(command)}` failed: {done.stderr.strip().splitlines()[-1]}")
        return float(json.loads(done.stdout.strip().splitlines()[-1])["steps_per_second"])


def speed(metrics: Sequence[Mapping[str, Any]]) -> float:
    """Steps per second of a run from its second iteration on (the first compiles)."""
    seconds = sum(row["seconds_iteration"] for row in metrics[1:])
    return (metrics[-1]["env_steps"] - metrics[0]["env_steps"]) / seconds


def audit_share(metrics: Sequence[Mapping[str, Any]]) -> float:
    """Audits, monitoring and recording over the whole, by the time that each takes, hidden or not."""
    rows = metrics[1:]
    spent = sum(row["seconds_audit"] + row["seconds_recording"] for row in rows)
    return spent / sum(row["seconds_iteration"] for row in rows)


def bench(tasks: Sequence[str], steps: int, repeats: int, peers: Path | None, say: Callable[[str], None]) -> dict:
    """The figures of every task, with machine, versions and how long it took."""
    import tempfile

    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="ppo-dap-bench-") as folder:
        run = Bench(Path(folder), steps, repeats, peers, say)
        figures = {task: run.task(task) for task in tasks}
    prepare_jax()  # as the runs had it, and no sooner: the peers are started as their users start them
    about = manifest() | {"cores": os.cpu_count(), "seconds": time.perf_counter() - start}
    return {"command": " ".join(["ppo-dap", *sys.argv[1:]]), "machine": about, "tasks": figures}


def print_bench(figures: Mapping[str, Any]) -> None:
    """The figures as a table, a column a task, with the machine."""
    from rich.console import Console
    from rich.table import Table

    tasks: dict[str, dict[str, Any]] = figures["tasks"]
    flat = {
        task: {k: v for k, v in row.items() if k != "steps_per_second"}
        | {f"{name}, steps/s": value for name, value in row["steps_per_second"].items()}
        for task, row in tasks.items()
    }
    table = Table(title="Ratios are medians of pairs inside one run")
    table.add_column("figure")
    for task in tasks:
        table.add_column(task, justify="right")
    for name in next(iter(flat.values())):
        cells = (row.get(name) for row in flat.values())
        table.add_row(name, *("" if c is None else f"{c:,.0f}" if c >= 100 else f"{c:.3f}" for c in cells))
    Console(width=None if sys.stdout.isatty() else 100).print(table)
    machine = figures["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    device = "" if machine["device"] == "cpu" else f", {machine['device']}"
    print(f"{machine['processor']}, {machine['cores']} cores{device}; Python {machine['python']}, {versions}")
    print(f"{figures['command']}   ({machine['seconds']:,.0f} s)")


def train_for(folder: Path, task: str, options: Sequence[str], steps: int) -> float:
    """Train in a process of its own, with evaluation off; its peak memory in MiB."""
    arguments = _training(folder, task, options, steps)
    return _finish(_start(arguments), arguments)


def _training(folder: Path, task: str, options: Sequence[str], steps: int) -> list[str]:
    # No epoch is skipped: else a method that moves the policy further would get away with fewer updates.
    fixed = ["--eval-every", "0", "--eval-episodes", "1", "--kl-rule", "monitor", "--quiet"]
    return ["train", "--task", task, "--out", str(folder), "--steps", str(steps), *fixed, *options]


def _start(arguments: Sequence[str], environment: Mapping[str, str] | None = None) -> subprocess.Popen:
    command = [sys.executable, "-m", "ppo_dap.cli", *arguments]
    given = {**os.environ, **(environment or {})}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=given)


def _finish(process: subprocess.Popen, arguments: Sequence[str]) -> float:
    """Wait for one of our commands; its peak memory in MiB."""
    errors = process.stderr.read() if process.stderr else ""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise PPODAPError(f"`ppo-dap {' '.join(arguments)}` failed: {errors.strip().splitlines()[-1]}")
    return usage.ru_maxrss / 1024


def _run(arguments: Sequence[str]) -> None:
    _finish(_start(arguments), arguments)


def _python(*arguments: str) -> str:
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=os.environ | {"NPROC": "1"})
    if done.returncode:
        raise PPODAPError(f"`python {' '.join(arguments)}` failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout.strip().splitlines()[-1]
