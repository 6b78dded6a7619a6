"""Bad input is one line on stderr and exit code 2, with nothing written."""

import pytest

from cli.cli_made import TASK, shell, snapshot
from ppo_dap.cli import main

BC = f"train --task {TASK} --method ppo-bc --warm-start actor --out out --logs"
PPO = f"train --task {TASK} --method ppo --out out"
DAP = f"train --task {TASK} --out out --prior"


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
    "empty file": ("@empty.npz", "empty.npz", "is empty", "must hold observations and actions"),
    "no arrays": ("@none.npz", "none.npz", "has no observations and no actions", "must have"),
    "no rows": ("@rowless.npz", "rowless.npz", "observations has shape (0, 3)", "must have at least one row"),
    "cut npz": ("@cut.npz", "cut.npz", "damaged", "must be a complete, readable file"),
    "cut hdf5": ("@cut.hdf5", "cut.hdf5", "damaged", "must be a complete, readable file"),
    "pickled": ("@pickled.npz", "pickled.npz", "actions holds pickled", "must be a numeric array"),
    "unknown key": ("@keys.npz", "unknown key 'observation'", "did you mean 'observations'"),
    "missing": ("@nothing.npz", "nothing.npz", "no such file"),
    "suffix": ("@logs.txt", "unknown file type '.txt'", ".npz, .hdf5, .h5, .csv, .parquet"),
    "table": ("@logs.csv", "logs.csv: has no observations", "must have columns such as obs_0"),
    "name": ("hopper-mediun", "unknown logs 'hopper-mediun'", "hopper-medium"),
    "folder": ("@other", "other: a folder without data/", "must be a Minari or LeRobot dataset"),
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
    "no prior": (f"train --task {TASK} --out out", "ppo-dap needs a diffusion prior", "pretrain --kind diffusion"),
    "prior for ppo": (f"{PPO} --prior @prior", "method ppo has no prior", "leave it out"),
    "prior: dimensions": (f"{DAP} @prior-wide", "logs of Hopper-v5", "observation_size 11", "observation_size 3"),
    "prior: actions": (f"{DAP} @prior-two", "another task", "action_size 2", "Pendulum-v1 has action_size 1"),
    "prior: task": (f"{DAP} @prior-other", "logs of Swing-v0, not of Pendulum-v1"),
    "prior: bounds": (f"{DAP} @prior-bounds", "action bounds", "not those of Pendulum-v1"),
    "prior: truncated": (f"{DAP} @prior-cut", "prior-cut is not a whole prior file"),
    "prior: empty": (f"{DAP} @prior-empty", "prior-empty is not a whole prior file"),
    "prior: text": (f"{DAP} @prior-text", "prior-text is not a whole prior file"),
    "prior: foreign": (f"{DAP} @prior-foreign", "not a prior", "`ppo-dap pretrain` writes one"),
    "prior: newer": (f"{DAP} @prior-newer", "prior format 3", "reads up to 2", "update ppo-dap"),
    "prior: kind": (f"{DAP} @prior-kind", "unknown prior kind 'flaw'", "diffusion"),
    "prior: missing": (f"{DAP} @nothing", "no prior file at", "ppo-dap pretrain"),
    "prior: folder": (f"{DAP} @other", "no prior file at", "ppo-dap pretrain"),
    # Names.
    "method": (f"train --task {TASK} --method ppo-dab --out out", "unknown method 'ppo-dab'", "did you mean 'ppo-dap'"),
    "task": ("train --task Hoper-v5 --method ppo --out out", "unknown task 'Hoper-v5'", "did you mean 'Hopper-v5'"),
    "far task": ("train --task qqqq --method ppo --out out", "unknown task 'qqqq'", "Hopper-v5"),
    "task without a module": (f"train --task :{TASK} --method ppo --out out", "must be a Gymnasium id", ":Pendulum-v1"),
    "task of two colons": ("train --task a:b:c --method ppo --out out", "must be a Gymnasium id", "'a:b:c'"),
    "module without environments": (
        "train --task json:No --method ppo --out out",
        "class of json 'No'",
        "known are none",
    ),
    "bad task id": ("train --task Hop/per/x --method ppo --out out", "task 'Hop/per/x'"),
    "check-logs task": ("check-logs --logs @good.npz --task Pendulun-v1", "unknown task", "'Pendulum-v1'"),
    "pretrain task": ("pretrain --logs @good.npz --task Pendulun-v1 --out out", "unknown task", "'Pendulum-v1'"),
    "preset": (f"{PPO} --preset best", "unknown preset 'best'", "paper, tuned"),
    "option": (f"{PPO} --lamda-kl 1", "unknown option '--lamda-kl'", "did you mean '--lambda-kl'"),
    "option of another command": ("methods --steps 3", "unknown option '--steps'", "--json"),
    "abbreviated option": (f"{PPO} --lambda 1", "unknown option '--lambda'"),
    "argument": (f"{PPO} more", "unexpected argument 'more'"),
    "command": ("trian", "unknown COMMAND 'trian'", "did you mean 'train'", "summary"),
    "choice": ("reliability @run --prior @prior --checkpoint lst", "--checkpoint 'lst'", "did you mean 'last'", "best"),
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
    "pretrain bound": (
        "pretrain --logs @good.npz --out out --action-low x",
        "--action-low",
        "a finite number, not 'x'",
    ),
    "columns twice": (
        "check-logs --logs @logs.csv --columns actions=a actions=b",
        "--columns has actions twice",
        "actions=A,B",
    ),
    "only twice": ("study table4 --only task=a --only task=b", "--only has task twice", "task=A,B"),
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
    **{
        f"{what}: {place}": (command.format(f"@{place}"), what.split()[-1], place, *words)
        for what, command in {
            "train out": f"train --task {TASK} --method ppo --out {{}}",
            "collect out": f"collect --task {TASK} --tier random --out {{}}",
            "quickstart out": "quickstart --out {}",
            "study results": "study table4 --draw --results {}",
        }.items()
        for place, words in (("file/x", ("cannot be written", "Not a directory", "writable folder")),)
    },
    **{
        f"{what}: {place}": (command.format(f"@{place}"), what.split()[-1], place, *words)
        for what, command in {
            "pretrain prior": f"pretrain --logs @good.npz --task {TASK} --out {{}}",
            "summary csv": "summary @run --csv {}",
            "bench json": "bench --json {}",
        }.items()
        for place, words in (
            ("file/x", ("cannot be written", "Not a directory", "writable folder")),
            ("other", ("is a folder: name a file",)),
        )
    },
    "pretrain without a name": (f"pretrain --logs @good.npz --task {TASK} --out .", "prior .", "name a file"),
    "pretrain over its logs": (f"pretrain --logs @good.npz --task {TASK} --out @good.npz", "good.npz", "is no prior"),
    "collect in a file": ("collect @run --out @file/out.npz --steps 1", "file/out.npz", "cannot be written"),
    "collect noise of tiers": (f"collect --task {TASK} --out out --noise 2", "--noise 2", "leave it out"),
    "collect steps of training": ("collect @run --out out.npz --train-steps 9", "--train-steps 9", "leave it out"),
    "bench sweep": ("bench --sweep costs.png", "costs.png", "must end in .csv"),
    # Runs.
    **{
        f"{command} of {what}": (f"{command} @{what}" + tail, what, words)
        for command, tail in (("evaluate", ""), ("audit", ""), ("summary", ""), ("collect", " --out out.npz"))
        for what, words in (("other", "not a run folder"), ("nothing", "no config.json"), ("damaged", "damaged"))
    },
    "audit cut": ("audit @run-audit-cut", "audit.json is damaged", "what `ppo-dap train` wrote"),
    "summary of audit cut": ("summary @run-audit-cut", "audit.json is damaged"),
    "audit without claims": ("audit @run-audit-bare", "audit.json is damaged ('static')"),
    "evaluate without evaluations": ("evaluate @run-rowless", "run-rowless has no row in evaluations.jsonl"),
    "evaluate of lists": ("evaluate @run-list", "evaluations.jsonl is damaged", "line 1 is [1, 2]", "must be"),
    "summary of a part": ("summary @run-part", "config.json is damaged (it lacks prior_hash)", "must be what"),
    "summary without settings": ("summary @run-seedless", "config.json is damaged (it lacks seed, steps)"),
    "audit of no audit": ("audit @run", "has no audit.json"),
    "evaluate without policy": ("evaluate @run-policyless", "no policy file at", "--resume"),
    "evaluate newer": ("evaluate @run-newer", "policy format 99", "reads up to", "update ppo-dap"),
    "evaluate episodes": ("evaluate @run --episodes 0", "--episodes: must be a whole number above 0, not '0'"),
    "evaluate seed": ("evaluate @run --seed -1", "seed", "-1"),
    "evaluate task": ("evaluate @run --task CartPole-v1", "CartPole-v1", "Discrete(2)"),
    "evaluate dimensions": (
        "evaluate @run --task MountainCarContinuous-v0",
        "MountainCarContinuous-v0 has 2 observations and 1 actions",
        "3 observations and 1 actions",
    ),
    "collect steps": ("collect @run --out out.npz --steps 0", "steps", "above 0", "0"),
    "collect seed": ("collect @run --out out.npz --steps 1 --seed -1", "seed", "-1"),
    "collect noise": ("collect @run --out out.npz --steps 1 --noise nan", "noise", "nan"),
    "collect suffix": ("collect @run --out out.txt --steps 1", "out.txt", "must end in .npz"),
    "summary epochs": ("summary @run --epochs nan", "epochs", "nan"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(capsys, files, here, nothing_is_learned, case):
    is_refused(capsys, files, here, *BAD[case])


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
