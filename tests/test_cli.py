"""The commands: bad input is one line on stderr and exit code 2 with nothing written; the cheap good paths work."""

import dataclasses
import json
import subprocess
import sys
import typing
import warnings

import h5py
import numpy as np
import pytest
from safetensors.numpy import save_file

from ppo_dap.cli import field_docstrings, main
from ppo_dap.config import Config, field_groups, flatten
from ppo_dap.methods import METHODS

TASK = "Pendulum-v1"  # 3 observations, 1 action in [-2, 2], no EnvPool to wait for
COMMANDS = ("quickstart", "check-logs", "pretrain", "train", "evaluate", "audit", "summary", "collect", "methods")
BC = f"train --task {TASK} --method ppo-bc --warm-start actor --out out --logs"
PPO = f"train --task {TASK} --method ppo --out out"
DAP = f"train --task {TASK} --out out --prior"


def arrays(observation_size=3, action_size=1, rows=12):
    rng = np.random.default_rng(0)
    truncated = np.zeros(rows, bool)
    truncated[rows // 2 - 1 :: rows // 2] = True
    return {
        "observations": rng.normal(size=(rows, observation_size)).astype(np.float32),
        "actions": rng.uniform(-2, 2, (rows, action_size)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "truncated": truncated,
    }


def write_logs(folder):
    good = arrays()
    holed = {**good, "observations": good["observations"].copy()}
    holed["observations"][5, 1] = np.nan
    contents = {
        "good": good,
        "nan": holed,
        "wide": arrays(observation_size=4),
        "two": arrays(action_size=2),
        "hopper": {**good, "task": np.array("Hopper-v5")},
        "pickled": {**good, "actions": np.array([{"a": 1}] * 12, dtype=object)},
        "keys": {**good, "observation": good["observations"]},
        "none": {},
        "rowless": {name: value[:0] for name, value in good.items()},
    }
    for name, content in contents.items():
        np.savez(folder / f"{name}.npz", **content)
    whole = (folder / "good.npz").read_bytes()
    (folder / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.npz").write_bytes(b"")
    with h5py.File(folder / "good.hdf5", "w") as file:
        for name, value in good.items():
            file["timeouts" if name == "truncated" else name] = value
    whole = (folder / "good.hdf5").read_bytes()
    (folder / "cut.hdf5").write_bytes(whole[: len(whole) // 2])
    (folder / "logs.csv").write_text("1,2\n")


def write_priors(folder):
    import jax.numpy as jnp

    from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig
    from ppo_dap.priors.prior import DiffusionPrior

    config = DiffusionConfig(width=4)

    def save(name, task, observation_size=3, action_size=1, high=2.0):
        moments = jnp.zeros(observation_size), jnp.ones(observation_size), jnp.ones(())
        high = np.full(action_size, high, np.float32)
        probe = np.zeros((2, observation_size), np.float32), np.zeros((2, action_size), np.float32)
        denoiser = Denoiser.create(np.random.default_rng(0), config, *moments, action_size)
        DiffusionPrior(denoiser, config, -high, high, task, "hash", {}, *probe).save(folder / name)

    save("prior", TASK)
    save("prior-wide", "Hopper-v5", observation_size=11, action_size=3)
    save("prior-two", None, action_size=2)
    save("prior-other", "Swing-v0")
    save("prior-bounds", None, high=1.0)
    whole = (folder / "prior").read_bytes()
    (folder / "prior-cut").write_bytes(whole[: len(whole) // 2])
    (folder / "prior-empty").write_bytes(b"")
    (folder / "prior-text").write_text("not a prior\n")
    save_file({"a": np.zeros(2)}, folder / "prior-foreign")
    header = {"kind": "prior", "format": 2, "prior": "diffusion"}
    save_file({"a": np.zeros(2)}, folder / "prior-newer", {"meta": json.dumps(header)})
    header = {"kind": "prior", "format": 1, "prior": "flow"}
    save_file({"a": np.zeros(2)}, folder / "prior-kind", {"meta": json.dumps(header)})


def write_runs(folder):
    from ppo_dap.nets.policy import Policy

    one, three = np.ones(1, np.float32), np.ones(3, np.float32)
    layers = ((np.ones((1, 3), np.float32),), (np.zeros(1, np.float32),))
    policy = Policy(*layers, -one, 0 * three, three, 10.0, -2 * one, 2 * one, TASK)
    for name in ("run", "run-newer", "run-policyless"):
        (folder / name).mkdir()
        description = {
            "task": TASK,
            "method": "ppo",
            "preset": "paper",
            "prior_hash": None,
            "config": flatten(Config()) | {"steps": 7},
        }
        (folder / name / "config.json").write_text(json.dumps(description))
        (folder / name / "evaluations.jsonl").write_text(json.dumps({"env_steps": 5, "return_mean": 1.0}) + "\n")
        (folder / name / "metrics.jsonl").write_text(json.dumps({"env_steps": 5}) + "\n")
    policy.save(folder / "run" / "policy.safetensors")
    meta = {"meta": json.dumps({"kind": "policy", "format": 99})}
    save_file({"a": np.zeros(2)}, folder / "run-newer" / "policy.safetensors", meta)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "config.json").write_text('{"task": "Pend')
    (folder / "other").mkdir()
    (folder / "other" / "notes.txt").write_text("mine\n")
    (folder / "file").write_text("mine\n")
    (folder / "bare").mkdir()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_logs(folder)
    write_priors(folder)
    write_runs(folder)
    return folder


def snapshot(*folders):
    return {path: path.read_bytes() if path.is_file() else None for folder in folders for path in folder.rglob("*")}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The working folder, empty: a file that is written anywhere but where it should is seen."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def one_line(err, words):
    assert "Traceback" not in err
    assert err.endswith("\n")
    (line,) = err.splitlines()
    assert line.startswith("ppo-dap: ")
    for word in words:
        assert word in line, f"{word!r} is not in {line!r}"


def is_refused(capsys, files, here, command, *words):
    before = snapshot(files, here)
    code = main([part.replace("@", f"{files}/") for part in command.split()])
    captured = capsys.readouterr()
    one_line(captured.err, words)
    assert captured.out == ""
    assert code == 2
    assert snapshot(files, here) == before


LOGS = {
    "nan": ("@nan.npz", "nan.npz", "observations is nan", "row 5, column 1", "must be finite"),
    "empty file": ("@empty.npz", "empty.npz", "is empty", "must be an .npz with observations and actions"),
    "no arrays": ("@none.npz", "none.npz", "has no observations and no actions", "must have"),
    "no rows": ("@rowless.npz", "rowless.npz", "observations has shape (0, 3)", "must have at least one row"),
    "cut npz": ("@cut.npz", "cut.npz", "damaged", "must be a complete, readable file"),
    "cut hdf5": ("@cut.hdf5", "cut.hdf5", "damaged", "must be a complete, readable file"),
    "pickled": ("@pickled.npz", "pickled.npz", "actions holds pickled", "must be a numeric array"),
    "unknown key": ("@keys.npz", "unknown key 'observation'", "did you mean 'observations'"),
    "missing": ("@nothing.npz", "nothing.npz", "no such file"),
    "suffix": ("@logs.csv", "unknown file type '.csv'", ".npz, .hdf5 or .h5"),
    "name": ("hopper-mediun", "unknown logs 'hopper-mediun'", "hopper-medium"),
    "folder": ("@other", "other: a folder without data/", "must be a Minari dataset"),
}


@pytest.mark.parametrize("case", LOGS)
@pytest.mark.parametrize("command", [BC, "check-logs --logs", f"pretrain --task {TASK} --out out --logs"])
def test_bad_logs(capsys, files, here, command, case):
    source, *words = LOGS[case]
    is_refused(capsys, files, here, f"{command} {source}", *words)


BAD = {
    # Logs of another task.
    "logs: observations": (f"{BC} @wide.npz", "wide.npz", "observations has 4 columns but the task has 3"),
    "logs: actions": (f"{BC} @two.npz", "two.npz", "actions has 2 columns but the task has 1"),
    "logs: task": (f"{BC} @hopper.npz", "are of task 'Hopper-v5', not 'Pendulum-v1'", "must be logs of Pendulum"),
    "logs without use": (f"{PPO} --logs @good.npz", "logs are used by a warm start alone", "leave logs out"),
    "warm start without logs": (f"train --task {TASK} --method ppo-bc --out out", "warm_start 'actor' needs logs"),
    # Priors.
    "no prior": (f"train --task {TASK} --out out", "ppo-dap needs a prior", "ppo-dap pretrain"),
    "prior for ppo": (f"{PPO} --prior @prior", "method ppo has no prior", "leave it out"),
    "prior: dimensions": (f"{DAP} @prior-wide", "logs of Hopper-v5", "observation_size 11", "observation_size 3"),
    "prior: actions": (f"{DAP} @prior-two", "another task", "action_size 2", "Pendulum-v1 has action_size 1"),
    "prior: task": (f"{DAP} @prior-other", "logs of Swing-v0, not of Pendulum-v1"),
    "prior: bounds": (f"{DAP} @prior-bounds", "action bounds", "not those of Pendulum-v1"),
    "prior: truncated": (f"{DAP} @prior-cut", "prior-cut is not a whole prior file"),
    "prior: empty": (f"{DAP} @prior-empty", "prior-empty is not a whole prior file"),
    "prior: text": (f"{DAP} @prior-text", "prior-text is not a whole prior file"),
    "prior: foreign": (f"{DAP} @prior-foreign", "not a prior", "`ppo-dap pretrain` writes one"),
    "prior: newer": (f"{DAP} @prior-newer", "prior format 2", "reads up to 1", "update ppo-dap"),
    "prior: kind": (f"{DAP} @prior-kind", "unknown prior kind 'flow'", "diffusion"),
    "prior: missing": (f"{DAP} @nothing", "no prior file at", "ppo-dap pretrain"),
    "prior: folder": (f"{DAP} @other", "no prior file at", "ppo-dap pretrain"),
    # Names.
    "method": (f"train --task {TASK} --method ppo-dab --out out", "unknown method 'ppo-dab'", "did you mean 'ppo-dap'"),
    "task": ("train --task Hoper-v5 --method ppo --out out", "unknown task 'Hoper-v5'", "did you mean 'Hopper-v5'"),
    "far task": ("train --task qqqq --method ppo --out out", "unknown task 'qqqq'", "Hopper-v5"),
    "bad task id": ("train --task Hop/per/x --method ppo --out out", "task 'Hop/per/x'"),
    "check-logs task": ("check-logs --logs @good.npz --task Pendulun-v1", "unknown task", "'Pendulum-v1'"),
    "pretrain task": ("pretrain --logs @good.npz --task Pendulun-v1 --out out", "unknown task", "'Pendulum-v1'"),
    "preset": (f"{PPO} --preset best", "unknown preset 'best'", "paper, tuned"),
    "option": (f"{PPO} --lamda-kl 1", "unknown option '--lamda-kl'", "did you mean '--lambda-kl'"),
    "option of another command": ("methods --steps 3", "unknown option '--steps'", "--json"),
    "abbreviated option": (f"{PPO} --lambda 1", "unknown option '--lambda'"),
    "argument": (f"{PPO} more", "unexpected argument 'more'"),
    "command": ("trian", "COMMAND", "'trian'", "train", "summary"),
    "no task": ("train --method ppo --out out", "required", "--task"),
    "no out": (f"train --task {TASK} --method ppo", "required", "--out"),
    "no logs": ("check-logs", "required", "--logs"),
    "no value": (f"{PPO} --gamma", "--gamma", "expected one argument"),
    "discrete actions": (
        "train --task CartPole-v1 --method ppo --out out",
        "CartPole-v1",
        "action",
        "Discrete(2)",
        "box",
    ),
    "discrete actions, logs": ("check-logs --logs @good.npz --task CartPole-v1", "CartPole-v1", "Discrete(2)", "box"),
    # Options.
    "steps 3.5": (f"{PPO} --steps 3.5", "--steps", "must be a whole number, not '3.5'"),
    "steps 0": (f"{PPO} --steps 0", "steps must be a number above 0, not 0"),
    "gamma 2": (f"{PPO} --gamma 2", "gamma must be a number from 0 to 1, not 2.0"),
    "gamma word": (f"{PPO} --gamma high", "--gamma", "must be a number, not 'high'"),
    "num-envs": (f"{PPO} --num-envs 3", "rollout_steps 2048 must be a multiple of num_envs 3"),
    "kl-target nan": (f"{PPO} --kl-target nan", "kl_target must be a number above 0, not nan"),
    "top-k": (f"{PPO} --top-k 11", "top_k 11 must be at most num_proposals 10"),
    "top-k word": (f"{PPO} --top-k all", "--top-k", "must be a whole number or none, not 'all'"),
    "tensorboard": (f"{PPO} --tensorboard yes", "--tensorboard", "must be true or false, not 'yes'"),
    "learning-rate inf": (f"{PPO} --learning-rate inf", "learning_rate must be", "inf"),
    "seed": (f"{PPO} --seed -1", "seed must be a number from 0 to 4294967295, not -1"),
    "large seed": (f"{PPO} --seed 99999999999999999999", "seed must be", "99999999999999999999"),
    "contradiction": (f"{PPO} --warm-start actor", "warm_start 'actor' contradicts method ppo", "'none'"),
    "pretrain seed": ("pretrain --logs @good.npz --task Pendulum-v1 --out out --seed -1", "seed", "-1"),
    "pretrain seed word": ("pretrain --logs @good.npz --out out --seed x", "--seed", "'x'"),
    "pretrain without bounds": ("pretrain --logs @good.npz --out out", "action_low"),
    "pretrain observations": (f"pretrain --logs @wide.npz --task {TASK} --out out", "observations has 4", "has 3"),
    "pretrain actions": (f"pretrain --logs @two.npz --task {TASK} --out out", "2", "1"),
    # Outputs.
    "resume nothing": (f"{PPO} --resume", "nothing to resume in out", "no config.json"),
    "resume other files": (f"train --task {TASK} --method ppo --out @other --resume", "nothing to resume", "other"),
    "resume as another": (f"train --task {TASK} --method ppo --out @run --resume", "cannot resume", "started with"),
    "resume damaged": (f"train --task {TASK} --method ppo --out @damaged --resume", "damaged"),
    "out is a file": (f"train --task {TASK} --method ppo --out @file", "is a file", "name a folder"),
    "out holds a run": (f"train --task {TASK} --method ppo --out @run", "holds a run already", "new folder, or resume"),
    "out has files": (f"train --task {TASK} --method ppo --out @other", "other files in it", "name a new one"),
    # Runs.
    **{
        f"{command} of {what}": (f"{command} @{what}" + tail, what, words)
        for command, tail in (("evaluate", ""), ("audit", ""), ("summary", ""), ("collect", " --out out.npz"))
        for what, words in (("other", "not a run folder"), ("nothing", "no config.json"), ("damaged", "damaged"))
    },
    "audit of no audit": ("audit @run", "has no audit.json"),
    "evaluate without policy": ("evaluate @run-policyless", "no policy file at"),
    "evaluate newer": ("evaluate @run-newer", "policy format 99", "reads up to", "update ppo-dap"),
    "evaluate episodes": ("evaluate @run --episodes 0", "--episodes: must be a whole number above 0, not '0'"),
    "evaluate seed": ("evaluate @run --seed -1", "seed", "-1"),
    "evaluate task": ("evaluate @run --task CartPole-v1", "CartPole-v1", "Discrete(2)"),
    "evaluate dimensions": ("evaluate @run --task MountainCarContinuous-v0", "2", "3"),
    "collect steps": ("collect @run --out out.npz --steps 0", "steps", "above 0", "0"),
    "collect seed": ("collect @run --out out.npz --steps 1 --seed -1", "seed", "-1"),
    "collect noise": ("collect @run --out out.npz --steps 1 --noise nan", "noise", "nan"),
    "collect suffix": ("collect @run --out out.txt --steps 1", "out.txt", "must end in .npz"),
    "summary epochs": ("summary @run --epochs nan", "epochs", "nan"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(capsys, files, here, monkeypatch, case):
    import ppo_dap.priors.fit
    import ppo_dap.training.run

    def too_far(*arguments, **options):
        raise AssertionError("it was not refused before the learning")

    monkeypatch.setattr(ppo_dap.priors.fit, "train_denoiser", too_far)
    monkeypatch.setattr(ppo_dap.training.run, "_make_trainer", too_far)
    is_refused(capsys, files, here, *BAD[case])


def shell(here, *arguments):
    """The command as a user runs it: no type checker, warnings as they come."""
    return subprocess.run([sys.executable, "-m", "ppo_dap.cli", *arguments], cwd=here, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (f"{PPO} --guidance foo", ("guidance 'foo'", "energy, energy+gradient, gradient, none")),
        (f"{PPO} --warm-start critic", ("warm_start 'critic'", "actor, actor_critic, none")),
    ],
)
def test_a_choice_that_does_not_exist(here, options, words):
    done = shell(here, *options.split())
    one_line(done.stderr, words)
    assert (done.returncode, done.stdout, list(here.iterdir())) == (2, "", [])


def test_a_warning_is_one_line_too(files, here):
    """Logs that mark no episode ends are warned about, and the warning is no Python source line."""
    unmarked = {name: value for name, value in arrays(observation_size=4).items() if name != "truncated"}
    np.savez(here / "unmarked.npz", **unmarked)
    done = shell(here, "check-logs", "--logs", "unmarked.npz")
    assert done.returncode in (0, 1)
    assert "nothing marks an episode's end" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert ".py:" not in done.stderr


def test_pretrain_into_a_folder(capsys, files, here, monkeypatch):
    import ppo_dap.priors

    prior = ppo_dap.priors.load_prior(files / "prior")
    monkeypatch.setattr(ppo_dap.priors, "fit_prior", lambda logs, **options: prior)
    command = f"pretrain --logs @good.npz --task {TASK} --out @other"
    is_refused(capsys, files, here, command, "cannot write prior", "other")


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
    assert code in (0, 1)
    assert "dimensions" in captured.out
    assert "error" not in captured.out
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
