"""A worker whose cells are chains of hashes: deterministic, resumable, as slow or as faulty as its settings say."""

import hashlib
import json
import os
import sys
import time

from ppo_dap.study.store.worker import main


def make(cell, out, needs):
    """A chain of hashes, a line and a checkpoint a step; what its needs hold is its start.

    `made` has a line each time that this came to its end: how many lines of the chain were there before.
    """
    settings = cell["settings"]
    if settings.get("fails"):
        raise ValueError(f"number {settings.get('seed')} cannot be made\nby anyone")
    if settings.get("fails_once") and not (out / "failed").exists():
        out.mkdir(parents=True)
        (out / "failed").touch()
        raise ValueError("not at once")
    if settings.get("full"):
        with open("/dev/full", "w") as file:
            file.write("no room")
    if settings.get("dies"):
        os.kill(os.getpid(), 9)
    out.mkdir(parents=True, exist_ok=True)
    start = [(need / "table").read_bytes() for need in needs.values()]
    state, table = hashlib.sha256(json.dumps([settings, list(map(repr, start))]).encode()).hexdigest(), out / "table"
    lines = table.read_text().splitlines() if table.exists() else []
    lines = [line for line in lines if len(line) == len(state)]
    table.write_text("".join(f"{line}\n" for line in lines))
    state = lines[-1] if lines else state
    with open(table, "a") as file:
        for _ in range(len(lines), 5):
            time.sleep(settings.get("slow", 0.0))
            state = hashlib.sha256(state.encode()).hexdigest()
            print(state, file=file, flush=True)
            (out / "last.safetensors").write_text(state)
    with open(out.parent / "made", "a") as file:
        print(len(lines), file=file)


if __name__ == "__main__":
    sys.exit(main(make=make, beat=0.1))
