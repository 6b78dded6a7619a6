"""A run whose weights have decayed goes on as plain PPO, with the bits that it would have had with its guide."""

import contextlib
import dataclasses
import errno
import json
import os

import numpy as np
import pytest
from safetensors.numpy import load_file

import ppo_dap
from ppo_dap.dap.objective import regained_std, weights_left
from ppo_dap.study.diagnostics.guided_run import load_guided
from ppo_dap.training import run as run_module
from ppo_dap.training import trainer
from ppo_dap.training.trainer import Trainer

OPTIONS = {"steps": 1500, "lambda_kl": 0.1, "lambda_aux": 0.3, "lambda_decay": 0.5, "progress": False}
"""12 iterations of up to 128 steps with a checkpoint after each third; the weights are gone after the seventh."""
IN_USE = 7


@pytest.fixture(scope="module")
def run(tmp_path_factory, hopper_prior, small):
    out = tmp_path_factory.mktemp("alone") / "run"
    return ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, **OPTIONS, **small)


def learned(run):
    return load_file(run.folder / "checkpoints" / "last.safetensors")


def assert_same(run, other):
    tensors, expected = learned(run), learned(other)
    assert tensors.keys() == expected.keys()
    assert all(tensors[name].tobytes() == expected[name].tobytes() for name in tensors)
    assert run.evaluations == other.evaluations


@contextlib.contextmanager
def checkpoint_lost(monkeypatch, number):
    """The disk is full at the run's last checkpoint of that number, which ends it."""
    save, calls = trainer.save_checkpoint, []

    def failing(path, *arguments):
        calls.extend([path] if path.name == "last.safetensors" else [])
        if len(calls) == number:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(path, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "save_checkpoint", failing)
        with pytest.raises(OSError, match="No space left"):
            yield


def test_what_it_learns_is_what_it_learns_with_an_idle_guide(tmp_path, monkeypatch, run, hopper_prior, small):
    monkeypatch.setattr(Trainer, "_go_on_alone", lambda trainer: None)
    idle = ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", **OPTIONS, **small)
    assert all(row["spr"] == 1 for row in idle.metrics)
    theirs, ours = learned(idle), learned(run)
    assert {name for name in theirs if name not in ours} == {name for name in theirs if "guide" in name} != set()
    assert all(theirs[name].tobytes() == ours[name].tobytes() for name in ours)
    assert run.evaluations == idle.evaluations
    for row, other in zip(run.metrics, idle.metrics, strict=True):
        same = [name for name in row if not name.startswith(("seconds_", "steps_per_second"))]
        assert {name: row[name] for name in same} == {name: other[name] for name in same}


def test_its_tables_end_with_the_guide_and_the_audit_knows(run):
    steps = [row["env_steps"] for row in run.metrics]
    assert steps[IN_USE - 2] < 750 <= steps[IN_USE - 1] < steps[-1]
    for name in ("spr", "q_loss", "pet_spr", "oglr", "kl_loss"):
        assert [name in row for row in run.metrics] == [True] * IN_USE + [False] * (len(steps) - IN_USE)
    assert all(row["batch_fresh"] == 1 for row in run.metrics)
    claims = {claim.statement: claim for claim in run.audit()}
    assert all(claim.holds for claim in claims.values())
    assert claims["SPR, smallest"].evidence == f"1 over {IN_USE} iterations"


def test_every_row_has_the_policys_spread_and_the_temperature_of_what_guides_it(run):
    spread = np.exp(load_file(run.folder / "policy.safetensors")["log_std"].astype(float)).mean()
    assert run.metrics[-1]["policy_std"] == pytest.approx(spread, rel=1e-6)
    assert len({row["policy_std"] for row in run.metrics}) == len(run.metrics)
    anneal, starts = run.config["config"]["beta_anneal"], [0, *(row["env_steps"] for row in run.metrics)]
    betas = np.interp(starts[:IN_USE], [0, anneal * OPTIONS["steps"]], [0, run.config["config"]["beta_max"]])
    assert [row["beta"] for row in run.metrics[:IN_USE]] == pytest.approx(betas)
    assert not any("beta" in row for row in run.metrics[IN_USE:])


def test_a_guide_that_fell_silent_too_soon_is_found(tmp_path, run):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.json", "audit.json"):
        (folder / name).write_bytes((run.folder / name).read_bytes())
    rows = run.metrics
    del rows[IN_USE - 1]["spr"]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert [claim.statement for claim in ppo_dap.load_run(folder).audit() if not claim.holds] == ["SPR, smallest"]


@pytest.mark.parametrize("leaking", ["guided", "alone"])
def test_a_leak_in_either_update_is_found(tmp_path, monkeypatch, hopper_prior, small, leaking):
    prove = run_module.prove

    def proved(learner, *rest):
        claims, guilty = prove(learner, *rest), (learner.guide is None) == (leaking == "alone")
        return [
            dataclasses.replace(claim, holds=claim.holds and not (guilty and "V and its trunk" in claim.statement))
            for claim in claims
        ]

    monkeypatch.setattr(run_module, "prove", proved)
    options = OPTIONS | {"steps": 256}
    found = ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", **options, **small).audit()
    assert ["V and its trunk" in claim.statement for claim in found if not claim.holds] == [True]
    assert len(found) == len({claim.statement for claim in found}) == 13


def test_the_last_checkpoint_of_the_guide_is_kept(run, hopper_prior):
    guided = load_guided(run.folder, hopper_prior)
    assert guided.state.iteration == IN_USE
    assert guided.guide.adapters is not None
    late = run.folder / "checkpoints" / "best.safetensors"
    before = late.read_bytes()
    late.write_bytes((run.folder / "checkpoints" / "last.safetensors").read_bytes())
    steps = run.metrics[-1]["env_steps"]
    with pytest.raises(ppo_dap.InputError, match=f"is of {steps:,} steps, when the run went on without its guide"):
        load_guided(run.folder, hopper_prior, "best")
    late.write_bytes(before)


@pytest.mark.parametrize("lost", [3, 4])
def test_it_resumes_from_before_and_from_after(tmp_path, monkeypatch, run, hopper_prior, small, lost):
    """The third checkpoint, which is lost, and so the second, from which the run goes on, are to either side."""
    out = tmp_path / "run"
    with checkpoint_lost(monkeypatch, lost):
        ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, **OPTIONS, **small)
    assert any("guide" in name for name in load_file(out / "checkpoints" / "last.safetensors")) == (lost == 3)
    resumed = ppo_dap.train("Hopper-v5", prior=hopper_prior, out=out, resume=True, **OPTIONS, **small)
    assert_same(resumed, run)
    assert load_guided(out, hopper_prior).state.iteration == IN_USE


def test_a_checkpoint_without_the_guide_that_is_still_needed(tmp_path, hopper_prior, small):
    options = {**OPTIONS, **small, "steps": 384}
    plain = ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "ppo", steps=384, progress=False, **small)
    late = {"lambda_decay": None}
    run = ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", **options | late)
    path = run.folder / "checkpoints" / "last.safetensors"
    path.write_bytes((plain.folder / "checkpoints" / "last.safetensors").read_bytes())
    with pytest.raises(ppo_dap.InputError, match="has no guide, which the run still needs"):
        ppo_dap.train("Hopper-v5", prior=hopper_prior, out=run.folder, resume=True, **options | late)


@pytest.mark.parametrize(
    ("share", "most", "end"), [(0.5, None, 750), (0.5, 400, 400), (0.1, 400, 150), (None, 400, 400)]
)
def test_weights_fall_in_a_line_to_the_first_of_both_ends(share, most, end):
    steps, ends = np.arange(0, 1500, 50), {"lambda_decay": share, "lambda_decay_steps": most}
    left = [weights_left(int(done), ends | {"steps": 1500}) for done in steps]
    assert left == pytest.approx(np.interp(steps, [0, end], [1, 0]))
    assert weights_left(1400, {"steps": 1500, "lambda_decay": None}) == 1


def test_a_limit_in_steps_ends_a_run_of_any_length(tmp_path, small):
    options = {**small, "progress": False, "lambda_decay_steps": 256}
    for steps in (512, 768):
        run = ppo_dap.train("Hopper-v5", "ppo-awr", out=tmp_path / str(steps), steps=steps, **options)
        left = [True, *(row["env_steps"] < 256 for row in run.metrics[:-1])]
        assert ["awr_loss" in row for row in run.metrics] == left
        assert sum(left) < len(left)


@pytest.mark.parametrize(
    ("share", "limit", "steps", "cut_off"),
    [
        (0.5, 100_000, 1_000_000, 0.8),
        (0.5, 100_000, 200_000, 0.0),
        (0.5, 100_000, 100_000, 0.0),
        (None, 250, 1000, 0.75),
        (0.5, None, 1000, 0.0),
    ],
)
def test_what_the_limit_cuts_off_the_spread_gets_back(share, limit, steps, cut_off):
    settings = {"lambda_decay": share, "lambda_decay_steps": limit, "steps": steps}
    assert regained_std(settings | {"std_after": 0.5}) == pytest.approx(0.5 * cut_off)
    assert regained_std(settings | {"std_after": 0.0}) == 0


@pytest.mark.parametrize("method", ["ppo-dap", "ppo-awr"])
def test_the_spread_is_given_back_once_when_the_weights_end(tmp_path, hopper_prior, small, method):
    """A quarter of the run has weights: three quarters of their time are cut off."""
    prior = hopper_prior if method == "ppo-dap" else None
    options = {**small, "steps": 1280, "progress": False, "lambda_decay_steps": 320}
    plain = ppo_dap.train("Hopper-v5", method, prior=prior, out=tmp_path / "plain", **options)
    wide = ppo_dap.train("Hopper-v5", method, prior=prior, out=tmp_path / "wide", std_after=2.0, **options)
    last = next(n for n, row in enumerate(wide.metrics) if row["env_steps"] >= 320)
    before, after = ([row["policy_std"] for row in run.metrics] for run in (plain, wide))
    assert after[:last] == before[:last]
    assert after[last] == pytest.approx(2.0 * 0.75, rel=1e-6)
    assert before[last] < 1.2
    assert 1.2 < after[last + 1] != after[last]  # and from there on it is PPO's
    assert all(claim.holds for claim in wide.audit())
    assert all(row["witnessed"] == 1 for row in wide.metrics)


def test_a_spread_that_was_given_back_is_not_given_back_again(tmp_path, monkeypatch, small):
    options = {**small, "steps": 1280, "progress": False, "lambda_decay_steps": 320, "std_after": 2.0}
    whole = ppo_dap.train("Hopper-v5", "ppo-awr", out=tmp_path / "whole", **options)
    with checkpoint_lost(monkeypatch, 3):
        ppo_dap.train("Hopper-v5", "ppo-awr", out=tmp_path / "cut", **options)
    assert_same(ppo_dap.train("Hopper-v5", "ppo-awr", out=tmp_path / "cut", resume=True, **options), whole)


def test_imitation_of_its_own_actions_ends_as_well(tmp_path, small):
    options = {**small, "steps": 768, "progress": False, "lambda_decay": 0.5}
    run = ppo_dap.train("Hopper-v5", "ppo-awr", out=tmp_path / "run", **options)
    logged = ["awr_loss" in row for row in run.metrics]
    left = [True, *(row["env_steps"] < 384 for row in run.metrics[:-1])]
    assert logged == left
    assert not all(left)
    assert not list(run.folder.glob("checkpoints/guided*"))
    assert all(claim.holds for claim in run.audit())
