"""The commands that make things: logs, priors, runs."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from ppo_dap import config as configs
from ppo_dap.commands.options import each_once
from ppo_dap.errors import InputError, unknown
from ppo_dap.prior_config import FITTED, PRIOR_CONFIGS
from ppo_dap.storage import require_folder
from ppo_dap.training.manifest import prepare_jax


def quickstart(options: argparse.Namespace) -> int:
    """The main job on the shipped sample."""
    prepare_jax()
    from ppo_dap.study.quickstart import quickstart

    return 0 if quickstart(require_folder("out", options.out)) else 1


def check_logs(options: argparse.Namespace) -> int:
    """The verdict on logs; exit code 0, 1 (warnings) or 2 (unusable)."""
    from ppo_dap import logs as logs_package
    from ppo_dap.logs.report import require_html

    if options.html is not None:
        require_html(options.html)
    logs = logs_package.load_logs(options.logs, **_reading(options))
    task = options.task or logs.task
    bounds: dict[str, Any] = {}
    against: dict[str, Any] = {"task": options.task}
    if task is not None:
        from ppo_dap.tasks import describe

        spec = describe(task)
        bounds = {"action_low": spec.action_low, "action_high": spec.action_high}
        against["observation_size"] = spec.observation_size
    report = logs_package.check_logs(logs, **against, **bounds)
    if options.html is not None:
        logs_package.write_report(logs, report, options.html, **bounds)
    if options.json:
        print(json.dumps([dataclasses.asdict(finding) for finding in report.lines]))
    else:
        print(report)
        if options.html is not None:
            print(f"report: {options.html}")
    return report.exit_code


def _reading(options: argparse.Namespace) -> dict[str, Any]:
    """How the logs are to be read, beside their place."""
    given = {"columns": options.columns and each_once("--columns", options.columns), "max_bytes": options.max_bytes}
    return {name: value for name, value in given.items() if value is not None}


def pretrain(options: argparse.Namespace) -> int:
    """Stage I."""
    prepare_jax()
    given = _prior_options(options)
    from ppo_dap.logs import best_episodes, load_logs
    from ppo_dap.logs.coverage import cover, coverage_statistics
    from ppo_dap.priors import fit_prior
    from ppo_dap.priors.prior import require_prior_place

    require_prior_place(options.out)
    logs = load_logs(options.logs, options.task, seed=options.seed, **_reading(options))
    if options.logs_filter < 1:
        logs = best_episodes(logs, options.logs_filter)
    logs = cover(logs, options.coverage, options.seed)
    bounds: dict[str, Any] = {}
    if logs.task is not None:
        from ppo_dap.logs import require_compatible
        from ppo_dap.tasks import describe

        spec = describe(logs.task)
        sizes = {"observation_size": spec.observation_size, "action_size": spec.action_size}
        require_compatible(logs, task=logs.task, **sizes)
        bounds = {"action_low": spec.action_low, "action_high": spec.action_high}
    bounds |= {name: getattr(options, name) for name in ("action_low", "action_high") if getattr(options, name)}

    if options.coverage != "wide" and not options.quiet:
        kept = ", ".join(f"{name} {value:,.4g}" for name, value in coverage_statistics(logs).items())
        print(f"coverage {options.coverage}: {kept}", file=sys.stderr)

    def show(p: Any) -> None:
        print(
            f"step {p.step:,}/{p.max_steps:,}: loss {p.train_loss:.4f}, held out {p.validation_loss:.4f}, "
            f"{p.seconds:.0f} s",
            file=sys.stderr,
        )

    prior = fit_prior(
        logs, options.kind, seed=options.seed, progress=None if options.quiet else show, **bounds, **given
    )
    prior.save(options.out)
    summary = prior.training
    print(
        f"prior {options.out}: {summary['rows']:,} rows of {logs.num_episodes} episodes, {summary['steps']:,} steps in "
        f"{summary['seconds']:.0f} s, held-out loss {summary['validation_loss']:.4f}"
    )
    return 0


def _prior_options(options: argparse.Namespace) -> dict[str, Any]:
    """The given fields of the kind's settings; a bad one is told before JAX is imported."""
    if options.kind not in FITTED:
        raise unknown("kind", options.kind, FITTED)
    config = PRIOR_CONFIGS[options.kind]
    every = {f.name for kind in FITTED for f in dataclasses.fields(PRIOR_CONFIGS[kind])}
    given = {name: getattr(options, name) for name in sorted(every) if name in options}
    own = {f.name for f in dataclasses.fields(config)}
    for name in given:
        if name not in own:
            raise InputError(f"{name} is no setting of a {options.kind} prior: leave it out")
    config(**given)
    return given


def train_run(options: argparse.Namespace) -> int:
    """Stage II."""
    prepare_jax()
    given = {name: value for name, value in vars(options).items() if name in configs.field_groups()}
    configs.make(options.preset, **given)  # a bad option is told before JAX is imported
    from ppo_dap.logs import load_logs
    from ppo_dap.training.run import train

    logs = None if options.logs is None else load_logs(options.logs, **_reading(options))
    run = train(
        options.task,
        options.method,
        prior=options.prior,
        logs=logs,
        out=options.out,
        preset=options.preset,
        resume=options.resume,
        progress=not options.quiet,
        **given,
    )
    last = run.evaluations[-1]
    strictly, declared = run.verdict()
    if not run.finished:
        print(f"{options.out}: stopped at {run.metrics[-1]['env_steps']:,} steps; go on with --resume", file=sys.stderr)
    if options.json:
        print(json.dumps(last | {"audit": strictly}))
    else:
        _print_profile(run.metrics)
        print(
            f"{options.out}: {last['env_steps']:,} steps, return {last['return_mean']:,.1f} over {last['episodes']} "
            f"episodes, audit {_verdict(strictly, declared)}"
        )
    return 0 if declared and run.finished else 1


def _verdict(strictly: bool, declared: bool) -> str:
    if strictly:
        return "holds"
    return "says: not strictly on-policy, as the method's row does" if declared else "VIOLATED: see `ppo-dap audit`"


def _print_profile(metrics: Sequence[Mapping[str, Any]]) -> None:
    """Where an iteration's time went: one line for the host, and one for what went on beside it."""
    from ppo_dap.training.clock import profile

    lines = profile(metrics)
    for beside, label in ((False, "an iteration's {total:,.0f} ms"), (True, "meanwhile, on the device")):
        parts = [line for line in lines if line.beside == beside and line.seconds > 0]
        if parts:
            total = sum(line.seconds for line in parts) / (len(metrics) - 1) * 1e3
            print(label.format(total=total) + ": " + ", ".join(f"{line.name} {line.share:.0%}" for line in parts))


def collect(options: argparse.Namespace) -> int:
    """Logs of a run's policy, or tiers of logs by behaviour policies that are trained for them."""
    prepare_jax()
    if options.folder is None:
        return _collect_tiers(options)
    if options.task or options.tier or options.all:
        raise InputError(f"RUN {options.folder} is logged as it is: leave --task, --tier and --all out")
    if options.train_steps is not None:
        raise InputError(f"--train-steps {options.train_steps} is of a behaviour run, and RUN is there: leave it out")
    from ppo_dap.logs.npz import require_npz, save_npz
    from ppo_dap.training.collect import collect_logs
    from ppo_dap.training.run import load_run

    run, out = load_run(options.folder), require_npz(options.out)
    noise = 1.0 if options.noise is None else options.noise
    logs = collect_logs(run.policy, run.config["task"], options.steps, options.seed, noise=noise)
    save_npz(logs, out)
    summary = logs.episode_returns()
    assert summary is not None  # collected logs have rewards
    row = {"out": options.out, "rows": logs.num_rows, "episodes": logs.num_episodes}
    row |= {"return": float(summary.mean()), "sha256": logs.hash()}
    if options.json:
        print(json.dumps(row))
    else:
        print("{out}: {rows:,} rows, {episodes} episodes, return {return:,.0f}, sha256 {sha256}".format(**row))
    return 0


def _collect_tiers(options: argparse.Namespace) -> int:
    from ppo_dap.tasks import CATALOGUE, describe
    from ppo_dap.training import tiers

    if options.all and (options.task or options.tier):
        raise InputError("--all says which tasks and tiers: leave --task and --tier out")
    tasks = list(CATALOGUE) if options.all else options.task or []
    wanted = ["medium", "medium-replay", "medium-expert"] if options.all else options.tier or ["medium"]
    if not tasks:
        raise InputError("nothing to log: name a RUN, a --task, or --all")
    if options.noise is not None:
        raise InputError(f"--noise {options.noise:g} is for a RUN: tiers have the policies' own, leave it out")
    tiers.check_tiers(wanted)
    tasks = [describe(task).task for task in tasks]
    folder, rows = require_folder("out", options.out), []
    request = {"rows": options.steps, "seed": options.seed, "steps": options.train_steps or 1_000_000, "folder": folder}
    plan = {task: tiers.estimate(task, wanted, **request) for task in tasks}
    for task, seconds in plan.items():
        print(f"{task}: {', '.join(wanted)}: about {seconds / 60:.0f} min", file=sys.stderr)
    print(f"in all about {sum(plan.values()) / 60:.0f} min on one core; what is there already is kept", file=sys.stderr)
    for task, tier in itertools.product(tasks, wanted):
        rows.append(row := tiers.make_tier(task, tier, **request))
        if not options.json:
            text = "{out}: {rows:,} rows, {episodes:,} episodes, return {return:,.1f}, sha256 {sha256}"
            print(text.format(**row), flush=True)
    if options.json:
        print(json.dumps(rows))
    return 0
