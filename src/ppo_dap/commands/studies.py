"""The command that runs studies."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from ppo_dap.commands.options import positive_count, seed
from ppo_dap.errors import InputError


def seeds(text: str) -> list[int]:
    """`0-7`, `3`, or `0,2,5-6`."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        try:
            low = seed(first)
            high = seed(last) if dash else low
        except argparse.ArgumentTypeError:
            low, high = 1, 0
        if high < low:
            raise argparse.ArgumentTypeError(f"must be seeds such as 0-7 or 0,2,5, not {text!r}")
        found += range(low, high + 1)
    if len(set(found)) < len(found):
        raise argparse.ArgumentTypeError(f"must name each seed once, not {text!r}")
    return found


def label(text: str) -> tuple[str, list[str]]:
    """`LABEL=VALUE,VALUE`."""
    name, equals, values = text.partition("=")
    if not (name and equals and values):
        raise argparse.ArgumentTypeError(f"must be LABEL=VALUE,VALUE,..., not {text!r}")
    return name, values.split(",")


def study_options(sub: argparse.ArgumentParser) -> None:
    """The options of `ppo-dap study`."""
    names = "table4 to table7, fig6 to fig12, ablation, coverage, reliability, audit, mixed; all of them; smoke: tiny"
    sub.add_argument("name", metavar="NAME", help=names)
    text = "where everything is kept; studies, and machines, can share it (default: %(default)s)"
    sub.add_argument("--store", default="studies", metavar="FOLDER", help=text)
    sub.add_argument("--dry-run", action="store_true", help="list the cells, hours and disk, and do nothing")
    sub.add_argument(
        "--workers", type=positive_count, default=_cores(), metavar="N", help="processes, a core each (default: cores)"
    )
    sub.add_argument("--seeds", type=seeds, metavar="0-7", help="for all seeds that the study declares")
    sub.add_argument("--steps", type=positive_count, metavar="N", help="for all numbers of steps that it declares")
    sub.add_argument(
        "--only",
        type=label,
        action="append",
        default=[],
        metavar="LABEL=VALUE,...",
        help="runs with these labels alone: task, logs, arm, method, preset, part, ...; again for more",
    )
    sub.add_argument("--json", action="store_true", help="with --dry-run: print JSON")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def study(options: argparse.Namespace) -> int:
    """Plan a study and run what is missing; exit code 1 if a cell could not be made."""
    from ppo_dap.study.plan import Plan, print_plan, summary
    from ppo_dap.study.store import open_store
    from ppo_dap.study.studies import make_study, only

    if options.json and not options.dry_run:
        raise InputError("--json prints the plan: use it with --dry-run")
    chosen = only(make_study(options.name, seeds=options.seeds, steps=options.steps), dict(options.only))
    plan = Plan(chosen, open_store(Path(options.store)), _speed)
    if options.dry_run:
        if options.json:
            cells = [cell.description() | {"done": cell in plan.done, "text": str(cell)} for cell in plan.cells]
            print(json.dumps(plan.totals() | {"study": chosen.name, "list": cells}))
        else:
            print_plan(plan, options.workers)
        return 0
    from ppo_dap.study.supervise import raise_on_terminate, run_plan

    raise_on_terminate()
    if plan.missing:
        print(summary(plan, options.workers), flush=True)
    return 0 if run_plan(plan, options.workers) else 1


def _speed(task: str) -> float:
    from ppo_dap.training.manifest import prepare_jax

    prepare_jax()
    from ppo_dap.training.tiers import speed_of

    return max(speed_of(task) for _ in range(2))  # the first half second has the start of its threads in it
