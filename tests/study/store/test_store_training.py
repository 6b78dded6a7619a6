"""Workers of real runs that are killed while they train: what comes out is what would have come out."""

import contextlib
import json
import os
import signal
import sys
import threading
import time

from ppo_dap.study.store import cells
from ppo_dap.study.store.store import Store
from study.store.store_made import study, supervisor

OPTIONS = {
    "num_envs": 4, "rollout_steps": 128, "minibatch_size": 64, "num_epochs": 2, "eval_every": 512, "eval_episodes": 1,
    "checkpoint_every": 4, "tensorboard": False, "steps": 6144,
}  # fmt: skip
COMMAND = (sys.executable, "-m", "ppo_dap.study.store.worker")


def _learned(store, cell):
    """Everything of a run but how long it took."""
    out = store.out(cell)
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    timeless = [{k: v for k, v in row.items() if "second" not in k} for row in rows]
    names = ("config.json", "evaluations.jsonl", "policy.safetensors", "audit.json", "checkpoints/last.safetensors")
    return timeless, {name: (out / name).read_bytes() for name in names}


def _kill_in_training(store, cell, after, killed):
    """Kill the cell's worker once it has written `after` iterations, again and again."""
    for lines in after:
        while True:
            time.sleep(0.005)
            if store.done(cell):
                return
            with contextlib.suppress(OSError, ValueError, IndexError, KeyError):
                written = len((store.out(cell) / "metrics.jsonl").read_text().splitlines())
                (claim,) = store.folder(cell).glob("claim-*")
                if written > lines:
                    os.kill(json.loads(claim.read_text())["pid"], signal.SIGKILL)
                    killed.append(lines)
                    break


def test_runs_that_are_killed_learn_the_same(tmp_path, capsys):
    grid = study(cells.run("Pendulum-v1", "ppo", seed=3, **OPTIONS))
    (cell,) = grid.cells()
    plain = threading.Thread(target=supervisor(tmp_path / "plain", grid, command=COMMAND).run)
    plain.start()  # beside the other: most of what a worker does here is to start
    store, killed = Store(tmp_path / "killed"), []
    after = (1, 6)  # before the first checkpoint, and between two
    killer = threading.Thread(target=_kill_in_training, args=(store, cell, after, killed))
    killer.start()
    assert supervisor(store.root, grid, command=COMMAND).run()
    killer.join()
    plain.join()
    assert killed == [*after]
    assert _learned(store, cell) == _learned(Store(tmp_path / "plain"), cell)
    ((labels, run),) = store.runs(grid)
    assert labels == {"seed": 3}
    assert run.finished
    assert Store(tmp_path / "none").runs(grid) == []
    assert store.cost(cell)["peak_mib"] > 50
