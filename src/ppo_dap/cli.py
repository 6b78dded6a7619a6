"""The commands: each parses its options and calls one public function. Heavy imports wait until they are needed."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import ppo_dap
from ppo_dap.commands import runs, stages, studies
from ppo_dap.commands.options import (
    config_options,
    filter_option,
    finite_number,
    logs_option,
    number_of_0_or_more,
    positive_count,
    positive_number,
    prior_options,
    seed,
)
from ppo_dap.errors import InputError, PPODAPError, unknown
from ppo_dap.prior_config import FITTED


class Parser(argparse.ArgumentParser):
    """Argparse with errors of one line, exit code 2, and the nearest known option for a misspelt one."""

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage."""
        raise InputError(message.removeprefix("argument "))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Argparse's, for a command or a choice, with the nearest known one."""
        if action.choices is not None and value not in action.choices:
            raise unknown(
                action.option_strings[0] if action.option_strings else str(action.metavar), value, action.choices
            )

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
    parser, warnings.showwarning = build_parser(), _show_warning
    try:
        options = parser.parse(sys.argv[1:] if arguments is None else arguments)
        if options.version:
            print(f"ppo-dap {ppo_dap.__version__}")
            return 0
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


def _show_warning(message: Any, category: type, filename: str, lineno: int, file: Any = None, line: Any = None) -> None:
    """A warning in one line, without the place in the code that it came from, and without Gymnasium's colours."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(message)).removeprefix("WARN: ")
    print(f"ppo-dap: warning: {text}", file=sys.stderr)


def build_parser() -> Parser:
    """All commands with their options."""
    parser = Parser(prog="ppo-dap", description="Logged trajectories in, faster PPO out, strictly on-policy.")
    parser.add_argument("--version", action="store_true", help="print the version and do nothing else")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    parser.subcommands = subparsers

    def command(name: str, run: Callable[[argparse.Namespace], int], text: str) -> Parser:
        sub = subparsers.add_parser(name, help=text, description=text, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    _from_logs_to_runs(command)
    _about_runs(command)
    return parser


Command = Callable[[str, Callable[[argparse.Namespace], int], str], Parser]
"""Adds a command: (name, what runs it, what it does)."""


def _from_logs_to_runs(command: Command) -> None:
    sub = command("quickstart", stages.quickstart, "the main job on the shipped sample, in a few minutes")
    sub.add_argument(
        "--out", default="quickstart", metavar="FOLDER", help="where everything goes (default: %(default)s)"
    )

    sub = command("check-logs", stages.check_logs, "say whether logs can be used, and what is odd about them")
    logs_option(sub, True)
    sub.add_argument("--task", metavar="ID", help="task to check dimensions and bounds against")
    sub.add_argument("--json", action="store_true", help="print the findings as JSON")
    sub.add_argument("--html", metavar="FILE", help="write the findings and pictures to one .html file as well")

    sub = command("pretrain", stages.pretrain, "Stage I: fit a prior to logs")
    logs_option(sub, True)
    sub.add_argument("--task", metavar="ID", help="task of the logs, where they do not say (gives the action bounds)")
    for bound in ("low", "high"):
        text = f"{bound}est action, a number or one for each action (default: the task's, or as the logs say)"
        sub.add_argument(f"--action-{bound}", nargs="+", type=finite_number, metavar="X", help=text)
    sub.add_argument("--out", required=True, metavar="FILE", help="file of the prior")
    sub.add_argument("--kind", default="diffusion", help=f"{', '.join(FITTED)} (default: %(default)s)")
    filter_option(sub)
    sub.add_argument("--coverage", default="wide", help="wide, medium or narrow: how much of the logs (default: wide)")
    sub.add_argument("--seed", type=seed, default=0, help="seed of the fit, and of the coverage (default: 0)")
    sub.add_argument("--quiet", action="store_true", help="print the result alone")
    prior_options(sub)

    sub = command("train", stages.train_run, "Stage II: train a method on a task")
    sub.add_argument(
        "--task", required=True, metavar="ID", help="a Gymnasium id, such as Hopper-v5, or package.module:Class"
    )
    sub.add_argument("--method", default="ppo-dap", help="see `ppo-dap methods` (default: %(default)s)")
    sub.add_argument(
        "--prior",
        metavar="FILE",
        help="prior that `ppo-dap pretrain` wrote, or random: the control that proposes anything",
    )
    logs_option(sub, False)
    sub.add_argument("--out", required=True, metavar="FOLDER", help="run folder")
    sub.add_argument(
        "--preset",
        default="paper",
        help="paper (Table 2), tuned, or tuned-warm, which needs logs (default: %(default)s)",
    )
    sub.add_argument("--resume", action="store_true", help="go on from the last checkpoint in --out")
    sub.add_argument("--quiet", action="store_true", help="no progress")
    sub.add_argument("--json", action="store_true", help="print the last evaluation as JSON")
    config_options(sub)


def _about_runs(command: Command) -> None:
    sub = command("evaluate", runs.evaluate, "returns of a run's deterministic policy")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--task", metavar="ID", help="another task of the same dimensions")
    sub.add_argument("--episodes", type=positive_count, default=10, help="(default: %(default)s)")
    sub.add_argument("--seed", type=seed, default=0, help="seed of the environments (default: 0)")
    sub.add_argument("--video", metavar="FILE", help="film an episode of its own to this .mp4 as well")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("bench", runs.bench, "what PPO and the method cost on this machine, as ratios; tens of minutes")
    sub.add_argument(
        "--task", action="append", metavar="ID", help="again for more (default: Walker2d-v5, HalfCheetah-v5)"
    )
    sub.add_argument("--steps", type=positive_count, default=81920, help="of each run (default: %(default)s)")
    sub.add_argument("--repeats", type=positive_count, default=3, help="medians are over these (default: %(default)s)")
    sub.add_argument("--peers", metavar="PYTHON", help="interpreter that has the peers: see `make bench-peers`")
    sub.add_argument(
        "--sweep", metavar="CSV", help="instead: cost against each knob of the method, as a table and figure"
    )
    sub.add_argument("--json", metavar="FILE", help="write everything to FILE as well")

    sub = command("audit", runs.audit, "verdict on a run by Definition 1; exit code 1 on a violation")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("summary", runs.summary, "ALC, return, cost and verdict of runs beside their paired PPO")
    sub.add_argument("folders", nargs="+", metavar="RUN", help="run folders")
    sub.add_argument(
        "--epochs", type=positive_number, default=40.0, help="T of ALC@T, in 5k steps (default: %(default)s)"
    )
    text = "instead: every method against METHOD on the same seeds, with intervals and exact tests; ppo, 'ppo (tuned)'"
    sub.add_argument(
        "--compare", metavar="METHOD", help=text + " and 'ppo-dap + lambda_kl=0.1' are methods of their own"
    )
    sub.add_argument("--markdown", action="store_true", help="print the comparison as Markdown")
    sub.add_argument("--csv", metavar="FILE", help="write the rows to a .csv as well")
    sub.add_argument("--json", action="store_true", help="print JSON")

    _report_options(command)
    sub = command("study", studies.study, "the paper's tables and figures: run what is missing of their runs")
    studies.study_options(sub)

    _diagnostics(command)
    _collect_options(command)
    sub = command("methods", runs.methods, "the methods and what each of them uses (Table 3)")
    sub.add_argument("--json", action="store_true", help="print JSON")


def _report_options(command: Command) -> None:
    sub = command("report", runs.report, "runs as one html page: who leads, curves, cost, audits, what differs, CSV")
    sub.add_argument("folders", nargs="+", metavar="RUN", help="run folders; unfinished and damaged ones are named")
    sub.add_argument("--out", default="report.html", metavar="FILE", help=".html to write (default: %(default)s)")
    sub.add_argument(
        "--epochs", type=positive_number, default=40.0, help="T of ALC@T, in 5k steps (default: %(default)s)"
    )
    text = "baseline of the comparison, named as `ppo-dap summary --compare` names it (default: ppo, if a run is)"
    sub.add_argument("--compare", metavar="METHOD", help=text)
    text = "films in the run folders go into the page up to this many MB together, the others are linked (default: 10)"
    sub.add_argument("--embed-mb", type=number_of_0_or_more, default=10.0, metavar="MB", help=text)
    sub.epilog = (
        "The page is one file that needs no network: send it, or open it from the disk. For example: "
        "`ppo-dap report runs/* --out report.html`, or, for runs of 50,000 steps, `ppo-dap report runs/ppo-* "
        "runs/dap-* --compare ppo --epochs 10`. Its curves zoom by dragging and go back by a double click. "
        "Exit code 1: a run is not what its method declares."
    )


def _diagnostics(command: Command) -> None:
    text = "how far a run's Q can be trusted (5.7): ranks, errors, calibration"
    sub = command("reliability", runs.reliability, text)
    sub.add_argument("folder", metavar="RUN", help="run folder of a method with a prior")
    sub.add_argument("--prior", required=True, metavar="FILE", help="the prior that it was trained with")
    sub.add_argument("--states", type=positive_count, default=64, help="visited states (default: %(default)s)")
    sub.add_argument("--rollouts", type=positive_count, default=8, help="of each action (default: %(default)s)")
    sub.add_argument("--horizon", type=positive_count, help="steps of one (default: until gamma^H is below 0.05)")
    sub.add_argument("--checkpoint", choices=("last", "best"), default="last", help="(default: %(default)s)")
    sub.add_argument("--seed", type=seed, default=0, help="of states, proposals and rollouts (default: 0)")
    sub.add_argument("--json", action="store_true", help="print JSON")
    sub.add_argument("--png", metavar="FILE", help="draw Q against the returns to this .png as well")

    sub = command("bound", runs.bound, "the terms of the performance bound (Eq. 14) over a run's iterations")
    sub.add_argument("folder", metavar="RUN", help="run folder")
    sub.add_argument("--json", action="store_true", help="print JSON")
    sub.add_argument("--png", metavar="FILE", help="draw the terms by iteration to this .png as well")


def _collect_options(command: Command) -> None:
    sub = command("collect", stages.collect, "log episodes of a run's policy, or make tiers of logs for a task")
    sub.add_argument("folder", nargs="?", metavar="RUN", help="run folder, to log its policy")
    sub.add_argument("--task", action="append", metavar="ID", help="or train behaviour policies for it; again for more")
    sub.add_argument(
        "--tier",
        action="append",
        metavar="TIER",
        help="random, medium, medium-replay, medium-expert, expert or mixed; again for more (default: medium)",
    )
    sub.add_argument(
        "--all", action="store_true", help="medium, medium-replay and medium-expert for all tasks of the paper"
    )
    sub.add_argument("--out", required=True, metavar="PATH", help=".npz to write; for tiers the folder they go to")
    sub.add_argument(
        "--steps", type=positive_count, default=100_000, help="rows at least, in whole episodes (default: %(default)s)"
    )
    sub.add_argument("--train-steps", type=positive_count, help="of a behaviour run, for tiers (default: 1000000)")
    sub.add_argument("--seed", type=seed, default=0, help="seed of training, environments and noise (default: 0)")
    sub.add_argument(
        "--noise",
        type=number_of_0_or_more,
        help="times the policy's own noise, for a RUN (default: 1.0)",
    )
    sub.add_argument("--json", action="store_true", help="print JSON")


if __name__ == "__main__":
    sys.exit(main())
