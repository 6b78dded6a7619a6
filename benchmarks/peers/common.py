"""What the peers' scripts share: their options and the one JSON line that each prints."""

import argparse
import json

import torch

ENVS, ROLLOUT, ITERATION = 8, 256, 8 * 256  # environments, and steps of each and of all in an iteration


def arguments(description: str, *flags: tuple[str, str]) -> argparse.Namespace:
    """Parse task, steps and threads, and the on-off `flags` (name, help); set torch's threads."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--task", default="Walker2d-v5")
    parser.add_argument("--steps", type=int, default=20480, help="environment steps, the warm-up's 2048 included")
    parser.add_argument("--threads", type=int, help="torch.set_num_threads; torch's own default when left out")
    for name, text in flags:
        parser.add_argument(name, action="store_true", help=text)
    args = parser.parse_args()
    if args.steps % ITERATION or args.steps < 2 * ITERATION:
        parser.error(f"--steps must be a multiple of {ITERATION}, and at least twice that")
    if args.threads:
        torch.set_num_threads(args.threads)
    return args


def report(peer: str, version: str, task: str, steps: int, seconds: float) -> None:
    """Print the measurement."""
    result = {"peer": peer, "version": version, "task": task, "steps": steps}
    print(json.dumps({**result, "seconds": round(seconds, 3), "steps_per_second": round(steps / seconds, 1)}))
