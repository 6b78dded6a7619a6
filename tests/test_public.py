"""The public functions, called as no type checker would let them be: each mistake is one line on what is right."""

import subprocess
import sys

import pytest

CALLS = {
    "load_logs(None)": "logs source is a NoneType: must be a shipped sample (hopper-medium), a .npz file",
    "load_logs(logs)": "logs source is a Logs: must be a shipped sample",
    "load_logs('t.csv', columns=['observations'])": "columns is ['observations']: must say for each role",
    "load_logs('t.csv', columns={'observations': 3})": "columns has observations 3: must be a column's name",
    "check_logs('hopper-medium')": "logs must be Logs, as ppo_dap.load_logs reads them, not a str",
    "fit_prior('hopper-medium')": "logs must be Logs, as ppo_dap.load_logs reads them, not a str",
    "fit_prior(logs, seed=-1)": "seed must be a whole number of 0 or more, not -1",
    "fit_prior(logs, seed='a')": "seed must be a whole number of 0 or more, not 'a'",
    "load_prior(None)": "prior must be a Prior, or the path of one, not None",
    "Guide(3, total_iterations=4)": "prior must be a Prior, or the path of one, not 3",
    "train(None, out='run')": "task must be a Gymnasium id or package.module:ClassName, not None",
    "train('Pendulum-v1', prior=3, out='run')": "prior must be a Prior, or the path of one, not 3",
    "train('Pendulum-v1', 'ppo-bc', logs=3, out='run')": "logs source is a int: must be a shipped sample",
}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What each call raises, in a process without a type checker."""
    folder = tmp_path_factory.mktemp("here")
    (folder / "t.csv").write_text("obs_0,act_0,episode\n1,2,0\n3,4,0\n")
    code = f"""
import ppo_dap
logs = ppo_dap.Logs([[0.0], [1.0]], [[0.0], [1.0]], [False, True])
for call in {list(CALLS)!r}:
    try:
        eval(f"ppo_dap.{{call}}")
    except ppo_dap.InputError as error:
        print(f"{{call}}\\t{{error}}")
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    assert [path.name for path in folder.iterdir()] == ["t.csv"]
    return dict(line.split("\t") for line in done.stdout.splitlines())


@pytest.mark.parametrize("call", CALLS)
def test_a_mistake_says_what_would_be_right(said, call):
    assert CALLS[call] in said[call]
