"""What the commands print and say in their help, where that is cheap to see."""

import dataclasses
import json
import tomllib
import typing
import warnings
from pathlib import Path

import numpy as np
import pytest

import ppo_dap
from cli.cli_made import TASK, arrays, shell
from ppo_dap.cli import main
from ppo_dap.commands.options import field_docstrings
from ppo_dap.config import Config, field_groups
from ppo_dap.methods import METHODS

COMMANDS = (
    "quickstart",
    "check-logs",
    "pretrain",
    "train",
    "evaluate",
    "audit",
    "summary",
    "collect",
    "bench",
    "bound",
    "methods",
    "reliability",
    "report",
    "study",
)


def test_a_warning_is_one_line_too(files, here):
    """Logs that mark no episode ends are warned about, and the warning is no Python source line."""
    unmarked = {name: value for name, value in arrays(observation_size=4).items() if name != "truncated"}
    np.savez(here / "unmarked.npz", **unmarked)
    done = shell(here, "check-logs", "--logs", "unmarked.npz")
    assert done.returncode in (0, 1)
    assert "nothing marks an episode's end" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert ".py:" not in done.stderr


@pytest.mark.parametrize("name", ["wide", "two"])
def test_check_logs_of_other_dimensions_says_so(capsys, files, here, name):
    assert main(["check-logs", "--logs", str(files / f"{name}.npz"), "--task", TASK]) == 2
    captured = capsys.readouterr()
    assert captured.err == ""
    (line,) = (line for line in captured.out.splitlines() if line.startswith("error"))
    assert "dimensions" in line
    assert "must be equal" in line
    assert list(here.iterdir()) == []


def test_check_logs_of_the_sample(capsys, here):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        code = main(["check-logs", "--logs", "hopper-medium"])
    captured = capsys.readouterr()
    assert code == 0
    assert "dimensions" in captured.out
    assert {line.split()[0] for line in captured.out.splitlines()} == {"ok"}
    assert captured.err == ""


def test_check_logs_as_json(capsys, files):
    assert main(["check-logs", "--logs", str(files / "good.hdf5"), "--json"]) in (0, 1)
    assert {"level", "name", "message"} == set(json.loads(capsys.readouterr().out)[0])


def test_methods(capsys):
    assert main(["methods"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert all(name in captured.out for name in METHODS)
    assert "diffusion-novg = ppo-dap-no-vg" in captured.out


def test_methods_as_json(capsys):
    assert main(["methods", "--json"]) == 0
    assert [row["method"] for row in json.loads(capsys.readouterr().out)] == list(METHODS)


def test_no_command_is_help(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in COMMANDS)


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"ppo-dap {ppo_dap.__version__}\n"
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert ppo_dap.__version__ == project["project"]["version"]


def test_a_warning_of_gymnasium_has_no_colours(files, here):
    done = shell(here, "check-logs", "--logs", str(files / "good.npz"), "--task", "Pendulum")
    assert done.stderr.startswith("ppo-dap: warning: Using the latest versioned environment `Pendulum-v1`")
    assert "\x1b" not in done.stderr


@pytest.mark.parametrize("command", [(), *((name,) for name in COMMANDS)])
def test_help(capsys, command):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("usage: ppo-dap")
    assert captured.err == ""


def test_every_setting_has_a_flag_and_help(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100000")
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for cls in typing.get_type_hints(Config).values():
        texts = field_docstrings(cls)
        for field in dataclasses.fields(cls):
            assert len(texts[field.name]) > 10
            flag = field.name.replace("_", "-")
            assert f"--{flag} X {texts[field.name]} (default: {field.default})" in text
    assert len(field_groups()) > 40


def test_evaluate_and_collect(capsys, files, here):
    run = str(files / "run")
    assert main(["evaluate", run, "--episodes", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 1
    assert main(["collect", run, "--steps", "200", "--out", "out.npz"]) == 0
    assert "out.npz: " in capsys.readouterr().out
    assert main(["check-logs", "--logs", "out.npz"]) in (0, 1)
