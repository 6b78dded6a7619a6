"""The commands about runs, methods and the machine."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ppo_dap.errors import InputError
from ppo_dap.storage import require_place, without_nan, write_atomically
from ppo_dap.training.manifest import prepare_jax


def evaluate(options: argparse.Namespace) -> int:
    """Returns of a run's deterministic policy."""
    prepare_jax()
    from ppo_dap.training.evaluation import evaluate_policy
    from ppo_dap.training.run import load_run
    from ppo_dap.training.video import record_video, require_video

    run = load_run(options.folder)
    if options.video is not None:
        require_video(options.video)
    task = options.task or run.config["task"]
    _require_same_sizes(run, task)
    known = run.evaluations
    if not known:
        raise InputError(f"{run.folder} has no row in evaluations.jsonl: is it a whole run folder?")
    row = evaluate_policy(run.policy, task, options.episodes, options.seed).row(known[-1]["env_steps"])
    if options.json:
        print(json.dumps(row))
    else:
        print(
            f"{task}: return {row['return_mean']:,.1f} +- {row['return_std']:,.1f} over {row['episodes']} episodes, "
            f"length {row['length_mean']:,.0f}"
        )
    if options.video is not None:
        frames = record_video(run.policy, task, options.video, options.seed)
        print(f"{options.video}: {frames} frames", file=sys.stderr)
    return 0


def _require_same_sizes(run: Any, task: str) -> None:
    from ppo_dap.tasks import describe

    spec, policy = describe(task), run.policy
    found, right = (spec.observation_size, spec.action_size), (len(policy.observation_mean), len(policy.action_low))
    if found != right:
        what = "{} observations and {} actions"
        raise InputError(f"task {task} has {what.format(*found)}, the policy of {run.folder} {what.format(*right)}")


def bench(options: argparse.Namespace) -> int:
    """The benchmark."""
    from ppo_dap.study.bench.bench import bench, print_bench
    from ppo_dap.study.bench.sweep import sweep
    from ppo_dap.tasks import describe

    if options.sweep is not None and Path(options.sweep).suffix != ".csv":
        raise InputError(f"sweep {options.sweep} must end in .csv: its figure goes beside it, to a .png")
    for name in ("json", "sweep"):
        if getattr(options, name) is not None:
            require_place(name, getattr(options, name))
    tasks = options.task or ["Walker2d-v5", "HalfCheetah-v5"]
    for task in tasks:
        describe(task)
    if options.sweep is not None:
        sweep(tasks[0], Path(options.sweep), functools.partial(print, flush=True))
        return 0
    peers = None if options.peers is None else Path(options.peers)
    if peers is not None and not peers.is_file():
        raise InputError(f"peers {peers} is no interpreter: `make bench-peers` makes one")
    figures = bench(tasks, options.steps, options.repeats, peers, functools.partial(print, flush=True))
    print_bench(figures)
    if options.json is not None:
        write_atomically(Path(options.json), (json.dumps(figures, indent=1) + "\n").encode())
    return 0


def audit(options: argparse.Namespace) -> int:
    """The verdict on a run; exit code 1 on a violation that the method does not declare."""
    from ppo_dap.training.run import load_run

    run = load_run(options.folder)
    claims, (strictly, declared) = run.audit(), run.verdict()
    if options.json:
        print(json.dumps([dataclasses.asdict(claim) for claim in claims]))
    else:
        print("\n".join(map(str, claims)))
        text = "strictly on-policy (Definition 1)" if strictly else "NOT strictly on-policy"
        print(f"verdict: {text}" + (f", as method {run.config['method']} is declared" if declared > strictly else ""))
    return 0 if declared else 1


def reliability(options: argparse.Namespace) -> int:
    """How far a run's Q can be trusted (5.7)."""
    prepare_jax()
    from ppo_dap.study.diagnostics import reliability_report as study
    from ppo_dap.study.plots.png import require_png

    png = None if options.png is None else require_png(options.png)
    names = ("states", "rollouts", "horizon", "checkpoint", "seed")
    given = {name: getattr(options, name) for name in names}
    found = study.reliability(options.folder, options.prior, **given, progress=study.show_progress(options.states))
    return _diagnosed(found, options.json, study.print_reliability, png, study.reliability_figure)


def bound(options: argparse.Namespace) -> int:
    """The terms of Eq. 14 by iteration."""
    prepare_jax()
    from ppo_dap.study.diagnostics import bound as study
    from ppo_dap.study.plots.png import require_png

    png = None if options.png is None else require_png(options.png)
    found = study.bound(options.folder)
    return _diagnosed(found, options.json, study.print_bound, png, study.bound_figure)


def _diagnosed(found: Any, as_json: bool, show: Callable, png: Path | None, draw: Callable) -> int:
    """A diagnosis in words or JSON, and its figure where one is asked for."""
    if as_json:
        print(json.dumps(without_nan(found.report)))
    else:
        show(found.report)
    if png is not None:
        draw(found, png)
    return 0


def summary(options: argparse.Namespace) -> int:
    """Runs side by side, or methods against a baseline."""
    from ppo_dap.study.stats.compare import comparable, compare, markdown, overall, print_comparison, save_csv
    from ppo_dap.study.stats.summary import print_summary, summarise
    from ppo_dap.training.run import load_run

    if options.markdown and options.compare is None:
        raise InputError("--markdown prints a comparison: give --compare METHOD as well")
    if options.csv is not None:
        require_place("csv", options.csv)
    rows = summarise([load_run(folder) for folder in options.folders], options.epochs)
    fair = all(row["declared"] for row in rows)
    if options.compare is None:
        shown, over_tasks = rows, []
    else:
        finished = comparable(rows, options.compare)
        shown, over_tasks = compare(finished, options.compare), overall(finished, options.compare)
    if options.json and options.compare is not None:
        print(json.dumps(without_nan({"tasks": shown, "overall": over_tasks})))
    elif options.json:
        print(json.dumps(rows))
    elif options.markdown:
        print(markdown(shown, over_tasks, options.epochs))
    elif options.compare is not None:
        print_comparison(shown, over_tasks, options.epochs)
    else:
        print_summary(rows, options.epochs)
    if options.csv is not None:
        save_csv(shown, options.csv)
    return 0 if fair else 1


def report(options: argparse.Namespace) -> int:
    """A page of runs; exit code 1 on a violation that a method does not declare."""
    from ppo_dap.study.report.page import write_report

    command = ["ppo-dap", "report", *options.folders, "--out", options.out, "--epochs", f"{options.epochs:g}"]
    command += [] if options.compare is None else ["--compare", options.compare]
    command += ["--embed-mb", f"{options.embed_mb:g}"]
    settings = options.epochs, options.compare, options.embed_mb
    done = write_report(options.folders, options.out, *settings, command=shlex.join(command))
    left = {"not finished": done.unfinished, "unreadable": done.unreadable}
    named = ", ".join(f"{count} {what}" for what, count in left.items() if count)
    print(
        f"{options.out}: {done.runs} run{'s' * (done.runs != 1)}" + (f" ({named}: named on the page)" if named else "")
    )
    return 0 if done.fair else 1


def methods(options: argparse.Namespace) -> int:
    """The capability matrix."""
    from ppo_dap.methods import ALIASES, TABLES, capability_rows

    rows = capability_rows()
    if options.json:
        print(json.dumps(rows))
        return 0
    for title, columns in TABLES.items():
        widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in columns}
        print(title)
        for row in ({name: name for name in widths}, *rows):
            print("  " + "  ".join(row[name].ljust(width) for name, width in widths.items()).rstrip())
        print()
    print("also known as: " + ", ".join(f"{alias} = {name}" for alias, name in ALIASES.items()))
    print("reconstruction: the paper names the method, and no description of it can be read; see docs/methods.md")
    return 0
