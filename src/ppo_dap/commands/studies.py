"""The command that runs studies."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from ppo_dap.commands.options import each_once, positive_count, seed
from ppo_dap.errors import InputError
from ppo_dap.storage import require_folder

if TYPE_CHECKING:
    from ppo_dap.study.store.grids import Study
    from ppo_dap.study.store.plan import Plan
    from ppo_dap.study.store.store import Store


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
    sub.add_argument("--workers", type=positive_count, metavar="N", help="processes, a core each (default: cores)")
    text = "make the cells on this Ray cluster (HOST:PORT, auto or local); its nodes share the store's folder"
    sub.add_argument("--ray", metavar="ADDRESS", help=text)
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
    sub.add_argument("--draw", action="store_true", help="run nothing: tables and figures of what there is")
    text = "where its CSV files, tables and figures go (default: results in the store)"
    sub.add_argument("--results", metavar="FOLDER", help=text)
    text = "put the tables into this Markdown file, between its lines <!--study NAME--> and <!--/-->"
    sub.add_argument("--document", metavar="FILE", help=text)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def study(options: argparse.Namespace) -> int:
    """Plan a study and run what is missing; exit code 1 if a cell could not be made."""
    from ppo_dap.study.store.plan import Plan, print_plan
    from ppo_dap.study.store.store import open_store
    from ppo_dap.study.store.studies import make_study, only

    if options.json and not options.dry_run:
        raise InputError("--json prints the plan: use it with --dry-run")
    if options.dry_run and options.draw:
        raise InputError("--dry-run lists cells and --draw draws what is there: name one of them")
    if options.ray is not None and (options.dry_run or options.draw):
        raise InputError("--ray runs cells, --dry-run and --draw run none: leave it out, or name --workers")
    whole = make_study(options.name, seeds=options.seeds, steps=options.steps)
    chosen = only(whole, each_once("--only", options.only))
    plan = Plan(chosen, open_store(Path(options.store)), _speed)
    if options.dry_run:
        if options.json:
            cells = [cell.description() | {"done": cell in plan.done, "text": str(cell)} for cell in plan.cells]
            print(json.dumps(plan.totals() | {"study": chosen.name, "list": cells}))
        else:
            print_plan(plan, options.workers or _cores())
        return 0
    folder, complete = require_folder("results", options.results or plan.store.root / "results"), True
    if options.document is not None:
        from ppo_dap.study.draw import fill

        fill(Path(options.document), {}, folder)  # a mistake is told before the work, not after it
    if not options.draw:
        complete = _run(plan, options)
    _show(whole, plan.store, folder, options.document)
    return 0 if complete else 1


def _run(plan: Plan, options: argparse.Namespace) -> bool:
    """Make what is missing, here or on a Ray cluster; returns whether everything is there."""
    from ppo_dap.study.store.plan import summary
    from ppo_dap.study.store.supervise import launch_here, raise_on_terminate, run_plan

    raise_on_terminate()
    with contextlib.ExitStack() as stack:
        launch, workers = launch_here, options.workers or _cores()
        if options.ray is not None and plan.missing:
            from ppo_dap.study.store.ray_cluster import Cluster

            cluster = stack.enter_context(Cluster(options.ray, plan.store.root))
            launch, workers = cluster.launch, options.workers or cluster.cpus
        if plan.missing:
            print(summary(plan, workers), flush=True)
        return run_plan(plan, workers, launch=launch)


def _show(study: Study, store: Store, folder: Path, document: str | None) -> None:
    """Keep the results of what is there of the whole study, and draw them."""
    from ppo_dap.storage import write_atomically
    from ppo_dap.study.draw import draw, fill, save_pages
    from ppo_dap.study.figures.proposals import take_proposals
    from ppo_dap.study.results import gather, load_results
    from ppo_dap.study.store.studies import parts

    results = gather(store, study.cells(), load_results(folder))
    for part in parts(study):
        if part.name == "fig11":
            take_proposals(store, part, results)
    results.save(folder)
    pages = draw(study, load_results(folder), folder)  # from the files, whose numbers are rounded: the same ever after
    if document is not None:
        write_atomically(Path(document), fill(Path(document), pages, folder).encode())
        files = [Path(document)]
    else:
        files = save_pages(study, pages, folder)
    if not pages:
        print(f"no run of {study.name} is finished: nothing to draw")
    if len(pages) == 1:
        print(*(page.text for page in pages.values()))
    for path in files:
        print(path)


def _speed(task: str) -> float:
    from ppo_dap.training.manifest import prepare_jax

    prepare_jax()
    from ppo_dap.training.tiers import speed_of

    return max(speed_of(task) for _ in range(2))  # the first half second has the start of its threads in it
