"""docs/tutorial-own-logs.md does what it says: its blocks are run, in order."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from ppo_dap.cli import main

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorial-own-logs.md"
QUICK = {"width": 8, "batch_size": 256, "max_steps": 400, "chunk_steps": 200}


def blocks():
    return re.findall(r"^```(\w*)\n(.*?)^```$", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)


def test_the_tutorial_runs(tmp_path, monkeypatch, capsys):
    import ppo_dap.priors

    fit = ppo_dap.priors.fit_prior
    for module in (ppo_dap, ppo_dap.priors):  # the whole fit takes half a minute
        monkeypatch.setattr(
            module, "fit_prior", lambda logs, *kind, **options: fit(logs, *kind, **QUICK, **options), raising=False
        )
    monkeypatch.chdir(tmp_path)
    space, printed = {}, ""
    for language, text in blocks():
        if language == "python":
            exec(compile(text, TUTORIAL.name, "exec"), space)
        elif language == "":
            assert main(shlex.split(text)[1:]) in (0, 1)
        printed += capsys.readouterr().out
        if language == "text" and not text.startswith("ppo-dap: "):
            assert _lines(text) <= _lines(printed)
    assert "prior prior: 3,600 rows of 40 episodes" in printed
    push, rest = space["actions"].mean(axis=(1, 2))
    assert push > 1.2
    assert abs(rest) < 0.8
    np.testing.assert_array_equal(ppo_dap.load_prior("prior").action_high, [2.0])


def _lines(text):
    return {" ".join(line.split()) for line in text.splitlines()}


@pytest.mark.filterwarnings("default")
def test_what_it_says_of_a_forgotten_episode(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (script, *_), commands = [text for language, text in blocks() if language == "python"], blocks()
    exec(compile(script, TUTORIAL.name, "exec"), {})
    (command,) = (text for language, text in commands if language == "" and "check-logs" in text)
    (said,) = (text for language, text in commands if language == "text" and text.startswith("ppo-dap: "))
    assert main(shlex.split(command.replace(" episode=run", ""))[1:]) == 2
    assert capsys.readouterr().err.splitlines()[-1:] == said.splitlines()


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("torque", "--columns: must be ROLE=NAME"),
        ("effort=torque", "unknown role in columns 'effort'"),
        ("actions=tork", "columns has actions ['tork']"),
    ],
)
def test_columns_that_are_none(tmp_path, monkeypatch, capsys, columns, words):
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_text("obs_0,torque,episode\n1,2,0\n1,3,0\n")
    assert main(["check-logs", "--logs", "a.csv", "--columns", columns]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.filterwarnings("default")
def test_the_budget_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["check-logs", "--logs", "hopper-medium", "--max-bytes", "1000000"]) in (0, 1)
    captured = capsys.readouterr()
    assert "drawn uniformly by seed 0, as all are more than max_bytes 1,000,000" in captured.err
