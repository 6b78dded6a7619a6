"""A prior from logs that are larger than memory should be: 5 GB of synthetic HDF5, and the most memory that it took.

    python benchmarks/large_logs.py [--gigabytes 5] [--steps 400] [--max-bytes 268435456]

The file is made in a temporary folder (so it needs the disk) and removed at the end. The figures are of the process
that reads and fits alone.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import h5py
import numpy as np

OBSERVATIONS, ACTIONS, LENGTH = 17, 6, 1000  # HalfCheetah's
ROW_BYTES = 4 * (OBSERVATIONS + ACTIONS + 1) + 2


def make(path: Path, num_bytes: float) -> int:
    """Write D4RL-layout episodes of about `num_bytes` in all; returns the rows."""
    rng = np.random.default_rng(0)
    episodes = int(num_bytes / ROW_BYTES / LENGTH)
    flags = ("terminals", "timeouts")
    shapes = {"observations": (OBSERVATIONS,), "actions": (ACTIONS,), "rewards": (), "terminals": (), "timeouts": ()}
    with h5py.File(path, "w") as file:
        arrays = {
            name: file.create_dataset(name, (episodes * LENGTH, *shape), bool if name in flags else "f4")
            for name, shape in shapes.items()
        }
        mix = rng.normal(size=(OBSERVATIONS, ACTIONS)).astype(np.float32) / 4
        for start in range(0, episodes * LENGTH, 100 * LENGTH):
            stop = min(start + 100 * LENGTH, episodes * LENGTH)
            observations = rng.standard_normal((stop - start, OBSERVATIONS), dtype=np.float32)
            arrays["observations"][start:stop] = observations
            arrays["actions"][start:stop] = np.tanh(observations @ mix)
            arrays["rewards"][start:stop] = observations[:, 0]
            arrays["timeouts"][start:stop] = np.arange(start, stop) % LENGTH == LENGTH - 1
    return episodes * LENGTH


def fit(path: Path, steps: int, max_bytes: int) -> None:
    """Load, fit and print what it took."""
    import ppo_dap

    warnings.showwarning = lambda message, *rest, **options: print(f"warning: {message}")
    start = time.perf_counter()
    logs = ppo_dap.load_logs(path, max_bytes=max_bytes)
    loaded = time.perf_counter() - start
    prior = ppo_dap.fit_prior(logs, max_steps=steps, action_low=-1.0, action_high=1.0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{prior.training['steps']} steps on {logs.num_rows:,} rows, drawn {prior.training.get('drawn')}")
    print(f"read in {loaded:.0f} s, peak memory of the process {peak:.2f} GiB")


def main() -> None:
    """Make the file here, read it in another process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gigabytes", type=float, default=5.0)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--max-bytes", type=int, default=2**28)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read is not None:
        fit(options.read, options.steps, options.max_bytes)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.hdf5"
        rows = make(path, options.gigabytes * 1e9)
        print(f"{path.stat().st_size / 1e9:.2f} GB, {rows:,} rows", flush=True)
        command = [sys.executable, __file__, "--read", path, "--steps", options.steps, "--max-bytes", options.max_bytes]
        subprocess.run([str(part) for part in command], check=True)


if __name__ == "__main__":
    main()
