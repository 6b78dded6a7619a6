"""Small grids of stubs, and a supervisor whose workers make these (stub_worker.py)."""

import os
import sys
from pathlib import Path

from ppo_dap.study.store import claims
from ppo_dap.study.store.cells import Cell
from ppo_dap.study.store.claims import Watch
from ppo_dap.study.store.grids import Entry, Study
from ppo_dap.study.store.plan import Plan
from ppo_dap.study.store.show import Show
from ppo_dap.study.store.store import Store
from ppo_dap.study.store.supervise import Supervisor, launch_here

COMMAND = (sys.executable, str(Path(__file__).with_name("stub_worker.py")))

FOLDERS = (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", ""))
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, FOLDERS))}
"""Of a process that imports these modules."""


def base(number=0, **how):
    """What a stub makes first: lines that depend on its settings."""
    return Cell("behaviour", {"task": "Hopper-v5", "seed": number, "steps": 5, **how})


def target(number, need=None, **how):
    settings = {"task": "Hopper-v5", "method": "ppo", "preset": "paper", "seed": number, "steps": 5, **how}
    return Cell("run", settings, {"prior": need} if need else {})


def study(*cells):
    return Study("stub", "a stub", 1.0, tuple(Entry(cell, {"seed": cell.settings.get("seed", 0)}) for cell in cells))


def small_grid(runs=4, **how):
    """Two first cells, and four runs on each, or another number."""
    return study(*(target(10 * b + i, base(b, **how), **how) for b in range(2) for i in range(runs)))


def supervisor(root, grid, workers=2, lease=claims.LEASE, command=COMMAND, launch=launch_here):
    plan = Plan(grid, Store(root), lambda task: 1e9)
    return Supervisor(plan, workers, Show(), command, launch, Watch(lease), poll=0.05)


def made(root):
    """How often each cell was made to the end."""
    return [len(path.read_text().splitlines()) for path in Path(root).rglob("made")]


def contents(root):
    """Every file of what was made, apart from how long it took and how often it was begun."""
    files = (path for path in Path(root).rglob("*") if path.is_file() and path.name not in ("attempts.jsonl", "made"))
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}
