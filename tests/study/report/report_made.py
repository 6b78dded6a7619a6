"""Run folders as `ppo-dap train` leaves them, made by hand in no time."""

import functools
import json

import numpy as np

from ppo_dap import config as configs
from ppo_dap.methods import get_method, resolve

STEPS = 50_000
POINTS = 6
SPLIT = {
    "env": 0.5, "policy": 0.1, "waiting": 0.05, "host": 0.05, "recording": 0.1, "gae": 0.02, "update": 0.3,
    "proposals": 0.0, "pet": 0.0, "audit": 0.004,
}  # fmt: skip
"""Seconds of an iteration of one second."""
GOOD = {"batch_fresh": 1.0, "ratio_error": 1e-6, "spr": 1.0, "pet_spr": 1.0, "oglr": 0.0}
STATIC = [
    {"clause": "(i)", "statement": "the advantages are made of V and D_on", "holds": True, "evidence": "proved"},
    {"clause": "(iv)", "statement": "no array of D_off reaches the new policy", "holds": True, "evidence": "proved"},
]


def evaluations(height, seed, steps=STEPS):
    rng = np.random.default_rng(seed)
    at = np.linspace(0, steps, POINTS).astype(int) + np.arange(POINTS) * (seed % 3)
    returns = [[float(value) for value in rng.normal(height * n / POINTS, 20, 2)] for n in range(1, POINTS + 1)]
    return [
        {"env_steps": int(a), "return_mean": sum(r) / 2, "return_std": 1.5, "episodes": 2, "returns": r}
        for a, r in zip(at, returns, strict=True)
    ]


@functools.cache
def settings(method, preset):
    return configs.flatten(resolve(get_method(method), configs.make(preset), {}))


def make_run(folder, method="ppo", seed=0, height=500.0, *, task="Hopper-v5", steps=STEPS, preset="paper", **changes):
    """`changes` are measured figures (of `GOOD` or seconds), settings, or `ends`: where an unfinished run is."""
    measured = {name: changes.pop(name) for name in list(changes) if name in GOOD or name.startswith("seconds_")}
    ends, prior = changes.pop("ends", steps), changes.pop("prior_hash", None)
    config = settings(method, preset) | {"seed": seed, "steps": steps} | changes
    description = {"task": task, "method": method, "preset": preset, "config": config, "prior_hash": prior}
    description |= {"logs_hash": None, "versions": {"jax": "0.10.2"}, "python": "3.11.7", "NPROC": "1"}
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(description))
    (folder / "audit.json").write_text(json.dumps({"static": STATIC}))
    rows = [row for row in evaluations(height, seed, steps) if ends == steps or row["env_steps"] <= ends]
    (folder / "evaluations.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    seconds = {f"seconds_{name}": value for name, value in SPLIT.items()} | {"seconds_iteration": 1.0}
    ends = max(ends, rows[-1]["env_steps"])
    lines = [GOOD | seconds | measured | {"env_steps": ends * n // 4, "iteration": n} for n in range(1, 5)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder
