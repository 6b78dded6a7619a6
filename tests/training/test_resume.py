"""Nothing is lost: kills, interrupts, full disks and removed folders."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from safetensors.numpy import load_file

import ppo_dap
from ppo_dap.errors import TrainingDiverged
from ppo_dap.training import trainer
from ppo_dap.training.clock import DEVICE, HOST

TIMING = ("seconds_", "steps_per_second")


def learned(folder):
    """Tensors of the last checkpoint, and the rows of both tables without what a clock said."""
    tables = [
        [{k: v for k, v in row.items() if not k.startswith(TIMING)} for row in rows]
        for rows in (ppo_dap.load_run(folder).metrics, ppo_dap.load_run(folder).evaluations)
    ]
    return load_file(folder / "checkpoints" / "last.safetensors"), tables


def assert_same(folder, reference):
    tensors, tables = learned(folder)
    expected, expected_tables = learned(reference)
    assert tensors.keys() == expected.keys()
    assert all(tensors[name].tobytes() == expected[name].tobytes() for name in tensors)
    assert tables == expected_tables


def command(prior, out, small, *more):
    options = [part for name, value in small.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    run = ["train", "--task", "Hopper-v5", "--prior", str(prior), "--out", str(out), "--quiet", "--steps", "1500"]
    return [sys.executable, "-m", "ppo_dap.cli", *run, *options, *more]


def wait_for_lines(folder, count):
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        path = folder / "metrics.jsonl"
        if path.is_file() and path.read_text().count("\n") >= count:
            return
        time.sleep(0.01)
    raise AssertionError("the run never got that far")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, hopper_prior, small):
    out = tmp_path_factory.mktemp("whole") / "run"
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, progress=False, **small)
    return out


def test_kill_and_resume_equals_an_uninterrupted_run(tmp_path, hopper_prior, small, uninterrupted):
    out = tmp_path / "run"
    process = subprocess.Popen(command(hopper_prior, out, small))
    # 4 lines are past the first checkpoint and before the second, and the kill falls anywhere within an iteration. (A
    # line is written in the next iteration, if no evaluation comes before.)
    wait_for_lines(out, 4)
    time.sleep(float(np.random.default_rng().uniform(0, 0.05)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, progress=False, resume=True, **small)
    assert_same(out, uninterrupted)


def test_interrupt_ends_with_a_checkpoint_and_says_how_to_go_on(tmp_path, hopper_prior, small):
    out = tmp_path / "run"
    process = subprocess.Popen(
        command(hopper_prior, out, small | {"steps": 100_000}), stderr=subprocess.PIPE, text=True
    )
    wait_for_lines(out, 4)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    run = ppo_dap.load_run(out)
    assert process.returncode == 1
    assert "--resume" in errors
    assert "Traceback" not in errors
    assert not run.finished
    header = (out / "checkpoints" / "last.safetensors").read_bytes()
    assert f'\\"iteration\\": {run.metrics[-1]["iteration"]}'.encode() in header


def test_after_an_interrupt_the_bits_are_those_of_an_uninterrupted_run(
    tmp_path, monkeypatch, capsys, small, uninterrupted, hopper_prior
):
    """It comes between two checkpoints, where environments of no other run restart."""
    out, iterate = tmp_path / "run", trainer.Trainer.iterate

    def interrupted(self, collector):
        iterate(self, collector)
        if self.state.iteration == 4:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(trainer.Trainer, "iterate", interrupted)
    options = {"prior": hopper_prior, "out": out, "steps": 1500, "progress": False} | small
    assert not ppo_dap.train("Hopper-v5", **options).finished
    assert f"{out}: stopping at the next checkpoint, after 2 more iterations; Ctrl-C again" in capsys.readouterr().err
    ppo_dap.train("Hopper-v5", resume=True, **options)
    assert_same(out, uninterrupted)


def test_every_iteration_says_where_its_time_went(uninterrupted):
    metrics = ppo_dap.load_run(uninterrupted).metrics
    names = {f"seconds_{name}" for name in (*HOST, *DEVICE)}
    for row in metrics:
        assert {name for name in row if name.startswith("seconds_")} == names | {"seconds_iteration"}
        assert min(row[name] for name in names) >= 0
        assert 0 < sum(row[f"seconds_{name}"] for name in HOST) <= row["seconds_iteration"]
    steps = np.diff([0, *(row["env_steps"] for row in metrics)])
    speeds = [row["steps_per_second"] * row["seconds_iteration"] for row in metrics]
    np.testing.assert_allclose(speeds, steps)
    assert [row["iteration"] for row in metrics] == list(range(1, len(metrics) + 1))


def test_another_config_cannot_resume_a_run(uninterrupted, hopper_prior, small):
    with pytest.raises(ppo_dap.InputError, match=r"gamma 0\.9: it was started with 0\.99"):
        ppo_dap.train("Hopper-v5", prior=hopper_prior, out=uninterrupted, steps=1500, resume=True, gamma=0.9, **small)


def test_a_run_of_a_version_that_knew_fewer_options_goes_on(tmp_path, uninterrupted, hopper_prior, small):
    """What it did not know was as it is by default."""
    out = shutil.copytree(uninterrupted, tmp_path / "run")
    config = json.loads((out / "config.json").read_text())
    del config["config"]["initial_std"]
    (out / "config.json").write_text(json.dumps(config))
    options = {"prior": hopper_prior, "out": out, "steps": 1500, "resume": True, "progress": False} | small
    assert ppo_dap.train("Hopper-v5", **options).finished
    with pytest.raises(ppo_dap.InputError, match=r"initial_std 0\.5: it was started with 1\.0"):
        ppo_dap.train("Hopper-v5", **options, initial_std=0.5)


def test_a_run_is_never_written_over(uninterrupted, hopper_prior, small):
    before = {p: p.read_bytes() for p in uninterrupted.rglob("*") if p.is_file()}
    with pytest.raises(ppo_dap.InputError, match="holds a run already"):
        ppo_dap.train("Hopper-v5", prior=hopper_prior, out=uninterrupted, steps=1500, **small)
    assert before == {p: p.read_bytes() for p in uninterrupted.rglob("*") if p.is_file()}


def fail_from(monkeypatch, call, action):
    """Replace `save_checkpoint` for "last" by `action` from its `call`-th call on."""
    original, calls = trainer.save_checkpoint, []

    def patched(path, *arguments):
        if path.name == "last.safetensors":
            calls.append(path)
            if len(calls) >= call:
                action(path)
        original(path, *arguments)

    monkeypatch.setattr(trainer, "save_checkpoint", patched)


def test_full_disk_leaves_the_last_good_checkpoint(tmp_path, monkeypatch, small, uninterrupted, hopper_prior):
    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        fail_from(patch, 2, full)
        with pytest.raises(OSError, match=r"No space left.*last good checkpoint is .*last\.safetensors"):
            ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, progress=False, **small)
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, progress=False, resume=True, **small)
    assert_same(out, uninterrupted)


def test_a_removed_checkpoint_folder_is_made_again(tmp_path, monkeypatch, small, uninterrupted, hopper_prior):
    fail_from(monkeypatch, 2, lambda path: shutil.rmtree(path.parent, ignore_errors=True))
    out = tmp_path / "run"
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, progress=False, **small)
    assert_same(out, uninterrupted)


def test_a_diverging_run_stops_and_names_iteration_loss_and_checkpoint(tmp_path, monkeypatch, small):
    original = trainer.iterate

    def poisoned(learner, frozen, rollout, normaliser, reward_std, schedule, *rest):
        new, metrics = original(learner, frozen, rollout, normaliser, reward_std, schedule, *rest)
        first = int(schedule.first_id) // small["rollout_steps"]
        return new, metrics | ({"value_loss": np.nan} if first == 4 else {})

    monkeypatch.setattr(trainer, "iterate", poisoned)
    out = tmp_path / "run"
    with pytest.raises(TrainingDiverged, match=r"iteration 4: value_loss is nan.*checkpoint is .*last\.safetensors"):
        ppo_dap.train("Hopper-v5", "ppo", out=out, steps=1500, progress=False, **small)
    assert all(np.isfinite(t).all() for t in load_file(out / "checkpoints" / "last.safetensors").values())


def test_exploding_losses_stop_a_run_without_help(tmp_path, small):
    with pytest.raises(TrainingDiverged, match="there is no checkpoint yet"):
        ppo_dap.train(
            "Hopper-v5", "ppo", out=tmp_path / "run", steps=1500, progress=False, **small | {"learning_rate": 1e12}
        )


def test_a_checkpoint_of_a_newer_version_is_refused(tmp_path, uninterrupted, hopper_prior, small):
    out = tmp_path / "run"
    shutil.copytree(uninterrupted, out)
    path = out / "checkpoints" / "last.safetensors"
    content = path.read_bytes()
    path.write_bytes(content.replace(b'\\"format\\": 1', b'\\"format\\": 9', 1))
    assert path.read_bytes() != content
    with pytest.raises(ppo_dap.InputError, match=r"checkpoint format 9.*reads up to 1"):
        ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, steps=1500, resume=True, **small)


def test_a_line_cut_off_by_a_kill_is_not_a_row(tmp_path, uninterrupted):
    out = tmp_path / "run"
    shutil.copytree(uninterrupted, out)
    whole = ppo_dap.load_run(out).metrics
    with open(out / "metrics.jsonl", "a") as file:
        file.write(json.dumps(whole[-1])[:20])
    assert ppo_dap.load_run(out).metrics == whole
