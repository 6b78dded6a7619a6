"""Files that a command can be given: logs, priors and runs, whole and damaged."""

import json
import shutil
import subprocess
import sys

import h5py
import numpy as np
from safetensors.numpy import save_file

from ppo_dap.config import Config, flatten

DAMAGED = (
    ("run-audit-cut", "audit.json", '{"static": ['),
    ("run-audit-bare", "audit.json", "{}"),
    ("run-rowless", "evaluations.jsonl", ""),
    ("run-list", "evaluations.jsonl", "[1, 2]\n"),
    ("run-part", "config.json", '{"task": "Pendulum-v1", "method": "ppo", "preset": "paper", "config": {"steps": 1}}'),
    ("run-seedless", "config.json", '{"task": "a", "method": "ppo", "preset": "b", "prior_hash": null, "config": {}}'),
)
"""Runs of which one file is not what it was: (name, file, what is in it)."""
TASK = "Pendulum-v1"  # 3 observations, 1 action in [-2, 2], no EnvPool to wait for


def arrays(observation_size=3, action_size=1, rows=12):
    rng = np.random.default_rng(0)
    truncated = np.zeros(rows, bool)
    truncated[rows // 2 - 1 :: rows // 2] = True
    return {
        "observations": rng.normal(size=(rows, observation_size)).astype(np.float32),
        "actions": rng.uniform(-2, 2, (rows, action_size)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "truncated": truncated,
    }


def write_logs(folder):
    good = arrays()
    holed = {**good, "observations": good["observations"].copy()}
    holed["observations"][5, 1] = np.nan
    contents = {
        "good": good,
        "nan": holed,
        "wide": arrays(observation_size=4),
        "two": arrays(action_size=2),
        "hopper": {**good, "task": np.array("Hopper-v5")},
        "pickled": {**good, "actions": np.array([{"a": 1}] * 12, dtype=object)},
        "keys": {**good, "observation": good["observations"]},
        "none": {},
        "rowless": {name: value[:0] for name, value in good.items()},
    }
    for name, content in contents.items():
        np.savez(folder / f"{name}.npz", **content)
    whole = (folder / "good.npz").read_bytes()
    (folder / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.npz").write_bytes(b"")
    with h5py.File(folder / "good.hdf5", "w") as file:
        for name, value in good.items():
            file["timeouts" if name == "truncated" else name] = value
    whole = (folder / "good.hdf5").read_bytes()
    (folder / "cut.hdf5").write_bytes(whole[: len(whole) // 2])
    (folder / "logs.csv").write_text("1,2\n")
    (folder / "logs.txt").write_text("1,2\n")


def write_priors(folder):
    import jax.numpy as jnp

    from ppo_dap.prior_config import DiffusionConfig
    from ppo_dap.priors.diffusion import Denoiser
    from ppo_dap.priors.prior import Prior

    config = DiffusionConfig(width=4)

    def save(name, task, observation_size=3, action_size=1, high=2.0):
        moments = jnp.zeros(observation_size), jnp.ones(observation_size), jnp.ones(())
        high = np.full(action_size, high, np.float32)
        probe = np.zeros((2, observation_size), np.float32), np.zeros((2, action_size), np.float32)
        denoiser = Denoiser.create(np.random.default_rng(0), config, *moments, action_size)
        Prior(denoiser, -high, high, task, "hash", {}, *probe).save(folder / name)

    save("prior", TASK)
    save("prior-wide", "Hopper-v5", observation_size=11, action_size=3)
    save("prior-two", None, action_size=2)
    save("prior-other", "Swing-v0")
    save("prior-bounds", None, high=1.0)
    whole = (folder / "prior").read_bytes()
    (folder / "prior-cut").write_bytes(whole[: len(whole) // 2])
    (folder / "prior-empty").write_bytes(b"")
    (folder / "prior-text").write_text("not a prior\n")
    save_file({"a": np.zeros(2)}, folder / "prior-foreign")
    header = {"kind": "prior", "format": 3, "prior": "diffusion"}
    save_file({"a": np.zeros(2)}, folder / "prior-newer", {"meta": json.dumps(header)})
    header = {"kind": "prior", "format": 2, "prior": "flaw"}
    save_file({"a": np.zeros(2)}, folder / "prior-kind", {"meta": json.dumps(header)})


def write_runs(folder):
    from ppo_dap.nets.policy import Policy

    one, three = np.ones(1, np.float32), np.ones(3, np.float32)
    layers = ((np.ones((1, 3), np.float32),), (np.zeros(1, np.float32),))
    policy = Policy(*layers, -one, 0 * three, three, 10.0, -2 * one, 2 * one, TASK)
    for name in ("run", "run-newer", "run-policyless"):
        (folder / name).mkdir()
        description = {
            "task": TASK,
            "method": "ppo",
            "preset": "paper",
            "prior_hash": None,
            "config": flatten(Config()) | {"steps": 7},
        }
        (folder / name / "config.json").write_text(json.dumps(description))
        (folder / name / "evaluations.jsonl").write_text(json.dumps({"env_steps": 5, "return_mean": 1.0}) + "\n")
        (folder / name / "metrics.jsonl").write_text(json.dumps({"env_steps": 5}) + "\n")
    policy.save(folder / "run" / "policy.safetensors")
    meta = {"meta": json.dumps({"kind": "policy", "format": 99})}
    save_file({"a": np.zeros(2)}, folder / "run-newer" / "policy.safetensors", meta)
    for name, file, text in DAMAGED:
        shutil.copytree(folder / "run", folder / name)
        (folder / name / file).write_text(text)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "config.json").write_text('{"task": "Pend')
    (folder / "other").mkdir()
    (folder / "other" / "notes.txt").write_text("mine\n")
    (folder / "file").write_text("mine\n")
    (folder / "bare").mkdir()


def snapshot(*folders):
    return {path: path.read_bytes() if path.is_file() else None for folder in folders for path in folder.rglob("*")}


def shell(here, *arguments):
    """The command as a user runs it: no type checker, warnings as they come."""
    return subprocess.run([sys.executable, "-m", "ppo_dap.cli", *arguments], cwd=here, capture_output=True, text=True)
