"""The main job on the shipped sample: fit the prior, train PPO and PPO-DAP on paired seeds, show what the logs paid."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from ppo_dap.errors import PPODAPError
from ppo_dap.study.stats.summary import print_summary, summarise
from ppo_dap.training.run import Run, load_run

SAMPLE, TASK, STEPS, EPOCHS, SEEDS = "hopper-medium", "Hopper-v5", 200_000, 40, (0, 1)


def quickstart(out: Path) -> bool:
    """Run it in `out`, one process a core; returns whether every audit held. Takes a few minutes on two cores.

    What is in `out` already is kept: called again it goes on where it was cut off.
    """
    start = time.perf_counter()
    prior = out / "prior"
    print(f"Logs: the shipped sample {SAMPLE!r}. Task: {TASK}, {STEPS:,} steps a run. Everything goes to {out}.")
    with ThreadPoolExecutor(max_workers=max(1, min(2, os.cpu_count() or 1))) as pool:
        jobs = {("ppo", seed): pool.submit(_train, out, "ppo", seed, None) for seed in SEEDS[:1]}
        fitted = pool.submit(_fit, prior)
        jobs |= {("ppo", seed): pool.submit(_train, out, "ppo", seed, None) for seed in SEEDS[1:]}
        jobs |= {("ppo-dap", seed): pool.submit(_train, out, "ppo-dap", seed, (prior, fitted)) for seed in SEEDS}
        for job in (fitted, *jobs.values()):
            job.result()
    runs = {key: load_run(_folder(out, *key)) for key in jobs}
    rows = summarise([runs[method, seed] for seed in SEEDS for method in ("ppo", "ppo-dap")], EPOCHS)
    print_summary(rows, EPOCHS, f"{TASK}, logs {SAMPLE}: what the logs paid")
    print(f"Audit, clause by clause: ppo-dap audit {runs['ppo-dap', SEEDS[0]].folder}")
    _draw(runs, out / "learning_curves.png")
    print(f"\nLearning curves: {out / 'learning_curves.png'}   ({time.perf_counter() - start:.0f} s in all)")
    return all(row["audit"] for row in rows)


def _folder(out: Path, method: str, seed: int) -> Path:
    return out / f"{method}-seed{seed}"


def _fit(prior: Path) -> None:
    if not prior.is_file():
        print("  " + _command("pretrain", "--logs", SAMPLE, "--out", str(prior)).strip().splitlines()[-1], flush=True)


def _train(out: Path, method: str, seed: int, prior: tuple[Path, Future] | None) -> None:
    options = ["--task", TASK, "--method", method, "--steps", str(STEPS), "--seed", str(seed)]
    if prior is not None:
        prior[1].result()
        options += ["--prior", str(prior[0]), "--preset", "tuned"]
    folder = _folder(out, method, seed)
    started = (folder / "config.json").is_file()
    if not (started and load_run(folder).finished):
        _command("train", *options, "--out", str(folder), "--quiet", *(["--resume"] if started else []))
    last = load_run(folder).evaluations[-1]
    print(f"  {method:8} seed {seed}: done, last return {last['return_mean']:,.0f}", flush=True)


def _command(*arguments: str) -> str:
    """What one of our own commands prints, run in a process of its own, with one core."""
    done = subprocess.run(
        [sys.executable, "-m", "ppo_dap.cli", *arguments],
        env=os.environ | {"NPROC": "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise PPODAPError(f"`ppo-dap {' '.join(arguments)}` failed: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


def _draw(runs: dict[tuple[str, int], Run], path: Path) -> None:
    from ppo_dap.study.plots.curves import learning_curves

    names = {"PPO": "ppo", "PPO-DAP (tuned)": "ppo-dap"}
    groups = {label: [runs[method, seed] for seed in SEEDS] for label, method in names.items()}
    learning_curves(groups, path, f"{TASK}: the same PPO with and without {SAMPLE} logs")
