"""The commands: each parses its options and calls one public function. Nothing heavy is imported before it is needed."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import json
import sys
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ppo_dap import config as configs
from ppo_dap.errors import InputError, PPODAPError, unknown


class Parser(argparse.ArgumentParser):
    """Argparse with errors of one line, exit code 2, and the nearest known option for a misspelt one."""

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage."""
        raise InputError(message.removeprefix("argument "))

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """The options; raises `InputError` for anything that is none."""
        options, rest = self.parse_known_args(arguments)
        if rest:
            command = self.subcommands.choices.get(options.command, self) if options.command else self
            known = [o for action in command._actions for o in action.option_strings]
            raise (
                unknown("option", rest[0], known)
                if rest[0].startswith("-")
                else InputError(f"unexpected argument {rest[0]!r}")
            )
        return options

    subcommands: Any = None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 done, 1 a violated check or a failed run, 2 bad input."""
    parser = build_parser()
    try:
        options = parser.parse(sys.argv[1:] if arguments is None else arguments)
        if options.command is None:
            parser.print_help()
            return 0
        return options.run(options)
    except PPODAPError as error:
        print(f"ppo-dap: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"ppo-dap: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("ppo-dap: interrupted", file=sys.stderr)
        return 1


def build_parser() -> Parser:
    """All commands with their options."""
    parser = Parser(prog="ppo-dap", description="Logged trajectories in, faster PPO out, strictly on-policy.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    parser.subcommands = commands

    def command(name: str, run: Callable[[argparse.Namespace], int], text: str) -> Parser:
        sub = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    sub = command("quickstart", _quickstart, "the main job on the shipped sample, in a few minutes")
    sub.add_argument(
        "--out", default="quickstart", metavar="FOLDER", help="where everything goes (default: %(default)s)"
    )

    sub = command("check-logs", _check_logs, "say whether logs can be used, and what is odd about them")
    _logs_option(sub, True)
    sub.add_argument("--task", metavar="ID", help="task to check dimensions and bounds against")
    sub.add_argument("--json", action="store_true", help="print the findings as JSON")

    sub = command("pretrain", _pretrain, "Stage I: fit the diffusion prior to logs")
    _logs_option(sub, True)
    sub.add_argument("--task", metavar="ID", help="task of the logs, where they do not say (gives the action bounds)")
    sub.add_argument("--out", required=True, metavar="FILE", help="file of the prior")
    sub.add_argument("--seed", type=int, default=0, help="seed of the fit (default: 0)")
    sub.add_argument("--quiet", action="store_true", help="print the result alone")

    sub = command("train", _train, "Stage II: train a method on a task")
    sub.add_argument("--task", required=True, metavar="ID", help="a Gymnasium id, such as Hopper-v5")
    sub.add_argument("--method", default="ppo-dap", help="see `ppo-dap methods` (default: %(default)s)")
    sub.add_argument("--prior", metavar="FILE", help="prior that `ppo-dap pretrain` wrote")
    _logs_option(sub, False)
    sub.add_argument("--out", required=True, metavar="FOLDER", help="run folder")
    sub.add_argument("--preset", default="paper", help="paper (Table 2) or tuned (default: %(default)s)")
    sub.add_argument("--resume", action="store_true", help="go on from the last checkpoint in --out")
    sub.add_argument("--quiet", action="store_true", help="no progress")
    sub.add_argument("--json", action="store_true", help="print the last evaluation as JSON")
    _config_options(sub)

    sub = command("evaluate", _evaluate, "returns of a run's deterministic policy")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--task", metavar="ID", help="another task of the same dimensions")
    sub.add_argument("--episodes", type=int, default=10, help="(default: %(default)s)")
    sub.add_argument("--seed", type=int, default=0, help="seed of the environments (default: 0)")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("audit", _audit, "verdict on a run, clause by clause of Definition 1; exit code 1 on a violation")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("collect", _collect, "log episodes of a run's policy")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--out", required=True, metavar="FILE", help=".npz to write")
    sub.add_argument(
        "--steps", type=int, default=100_000, help="rows at least, in whole episodes (default: %(default)s)"
    )
    sub.add_argument("--seed", type=int, default=0, help="seed of environments and noise (default: 0)")
    sub.add_argument("--noise", type=float, default=1.0, help="times the policy's own noise (default: %(default)s)")

    sub = command("methods", _methods, "the methods and what each of them uses (Table 3)")
    sub.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _logs_option(parser: Parser, required: bool) -> None:
    parser.add_argument(
        "--logs", required=required, metavar="LOGS", help="shipped sample, .npz, D4RL .hdf5, or Minari folder or id"
    )


def _config_options(parser: Parser) -> None:
    """A flag for every field of the config, by its name; what is not given stays with the preset."""
    for group, cls in typing.get_type_hints(configs.Config).items():
        section = parser.add_argument_group(f"{group}: {(cls.__doc__ or '').splitlines()[0]}")
        hints, texts = typing.get_type_hints(cls), field_docstrings(cls)
        for f in dataclasses.fields(cls):
            section.add_argument(
                f"--{f.name.replace('_', '-')}",
                type=functools.partial(_parse_value, hints[f.name]),
                default=argparse.SUPPRESS,
                metavar="X",
                help=f"{texts[f.name]} (default: {f.default})".replace("%", "%%"),
            )


def field_docstrings(cls: type) -> dict[str, str]:
    """The string below each field of a dataclass."""
    body = ast.parse(inspect.getsource(cls)).body[0].body  # type: ignore[attr-defined]
    texts = {}
    for statement, after in itertools.pairwise(body):
        if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
            texts[statement.target.id] = " ".join(ast.literal_eval(after.value).split())  # type: ignore[union-attr]
    return texts


def _parse_value(hint: Any, text: str) -> Any:
    """`text` as the field's type; what is wrong with the value itself is the config's to say."""
    kinds = typing.get_args(hint) or (hint,)
    if typing.get_origin(hint) is typing.Literal:
        return text
    if type(None) in kinds and text.lower() == "none":
        return None
    if bool in kinds:
        if text.lower() not in ("true", "false"):
            raise argparse.ArgumentTypeError(f"must be true or false, not {text!r}")
        return text.lower() == "true"
    kind = next(k for k in kinds if k is not type(None))
    try:
        return kind(text.replace("_", "")) if kind is int else kind(text)
    except ValueError:
        right = {int: "a whole number", float: "a number"}[kind] + (" or none" if type(None) in kinds else "")
        raise argparse.ArgumentTypeError(f"must be {right}, not {text!r}") from None


def _set_up() -> None:
    from ppo_dap.training.manifest import set_core_count

    set_core_count()


def _quickstart(options: argparse.Namespace) -> int:
    _set_up()
    from ppo_dap.study.quickstart import quickstart

    return 0 if quickstart(Path(options.out)) else 1


def _check_logs(options: argparse.Namespace) -> int:
    from ppo_dap.logs import check_logs, load_logs

    logs = load_logs(options.logs, options.task)
    against: dict[str, Any] = {}
    if logs.task is not None:
        from ppo_dap.tasks import describe

        spec = describe(logs.task)
        against = {"action_low": spec.action_low, "action_high": spec.action_high}
        against["observation_size"] = spec.observation_size
    report = check_logs(logs, **against)
    if options.json:
        print(json.dumps([dataclasses.asdict(finding) for finding in report.lines]))
    else:
        print(report)
    return report.exit_code


def _pretrain(options: argparse.Namespace) -> int:
    _set_up()
    from ppo_dap.logs import load_logs
    from ppo_dap.priors import fit_prior

    logs = load_logs(options.logs, options.task)
    bounds: dict[str, Any] = {}
    if logs.action_low is None and logs.task is not None:
        from ppo_dap.tasks import describe

        spec = describe(logs.task)
        bounds = {"action_low": spec.action_low, "action_high": spec.action_high}

    def show(p: Any) -> None:
        print(
            f"step {p.step:,}/{p.max_steps:,}: loss {p.train_loss:.4f}, held out {p.validation_loss:.4f}, "
            f"{p.seconds:.0f} s",
            file=sys.stderr,
        )

    prior = fit_prior(logs, seed=options.seed, progress=None if options.quiet else show, **bounds)
    prior.save(options.out)
    summary = prior.training
    print(
        f"prior {options.out}: {summary['rows']:,} rows of {logs.num_episodes} episodes, {summary['steps']:,} steps in "
        f"{summary['seconds']:.0f} s, held-out loss {summary['validation_loss']:.4f}"
    )
    return 0


def _train(options: argparse.Namespace) -> int:
    _set_up()
    given = {name: value for name, value in vars(options).items() if name in configs.field_groups()}
    configs.make(options.preset, **given)  # a bad option is told before JAX is imported
    from ppo_dap.training.run import train

    run = train(
        options.task,
        options.method,
        prior=options.prior,
        logs=options.logs,
        out=options.out,
        preset=options.preset,
        resume=options.resume,
        progress=not options.quiet,
        **given,
    )
    last = run.evaluations[-1]
    violated = [claim for claim in run.audit() if not claim.holds]
    if not run.finished:
        print(f"{options.out}: stopped at {run.metrics[-1]['env_steps']:,} steps; go on with --resume", file=sys.stderr)
    if options.json:
        print(json.dumps(last | {"audit": not violated}))
    else:
        print(
            f"{options.out}: {last['env_steps']:,} steps, return {last['return_mean']:,.1f} over {last['episodes']} "
            f"episodes, audit {'VIOLATED: see `ppo-dap audit`' if violated else 'holds'}"
        )
    return 1 if violated or not run.finished else 0


def _evaluate(options: argparse.Namespace) -> int:
    _set_up()
    from ppo_dap.training.evaluation import evaluate_policy
    from ppo_dap.training.run import load_run

    if options.episodes < 1:
        raise InputError(f"--episodes must be a number above 0, not {options.episodes}")
    run = load_run(options.folder)
    task = options.task or run.config["task"]
    row = evaluate_policy(run.policy, task, options.episodes, options.seed).row(run.evaluations[-1]["env_steps"])
    if options.json:
        print(json.dumps(row))
    else:
        print(
            f"{task}: return {row['return_mean']:,.1f} +- {row['return_std']:,.1f} over {row['episodes']} episodes, "
            f"length {row['length_mean']:,.0f}"
        )
    return 0


def _audit(options: argparse.Namespace) -> int:
    from ppo_dap.training.run import load_run

    claims = load_run(options.folder).audit()
    violated = [claim for claim in claims if not claim.holds]
    if options.json:
        print(json.dumps([dataclasses.asdict(claim) for claim in claims]))
    else:
        print("\n".join(map(str, claims)))
        print(f"verdict: {'NOT strictly on-policy' if violated else 'strictly on-policy (Definition 1)'}")
    return 1 if violated else 0


def _collect(options: argparse.Namespace) -> int:
    _set_up()
    from ppo_dap.logs import save_npz
    from ppo_dap.training.collect import collect_logs
    from ppo_dap.training.run import load_run

    run = load_run(options.folder)
    logs = collect_logs(run.policy, run.config["task"], options.steps, options.seed, noise=options.noise)
    save_npz(logs, options.out)
    summary = logs.episode_returns()
    assert summary is not None  # collected logs have rewards
    print(
        f"{options.out}: {logs.num_rows:,} rows, {logs.num_episodes} episodes, return {summary.mean():,.0f}, "
        f"sha256 {logs.hash()}"
    )
    return 0


def _methods(options: argparse.Namespace) -> int:
    from ppo_dap.methods import ALIASES, capability_rows

    rows = capability_rows()
    if options.json:
        print(json.dumps(rows))
        return 0
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in rows[0]}
    for row in ({name: name for name in widths}, *rows):
        print("  ".join(row[name].ljust(width) for name, width in widths.items()).rstrip())
    print("also known as: " + ", ".join(f"{alias} = {name}" for alias, name in ALIASES.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
