"""Whole runs of what stands for ABPPO, PPO-GC and PPO-ARC, and that they resume with the same bits."""

import errno
import os

import numpy as np
import pytest
from safetensors.numpy import load_file

import ppo_dap
from training.test_resume import assert_same, fail_from

SMALL = {
    "num_envs": 4,
    "rollout_steps": 256,
    "minibatch_size": 64,
    "num_epochs": 2,
    "eval_episodes": 1,
    "eval_every": 0,
    "checkpoint_every": 2,
    "tensorboard": False,
    "progress": False,
}
ARC = SMALL | {"reuse_batches": 1, "contest_kl_weight": 100.0}


@pytest.mark.parametrize(
    "options",
    [
        {"surrogate": "authentic_boundary"},
        {"surrogate": "generalised_clip"},
        {"reuse_batches": 1},
        {"reuse_batches": 1, "surrogate": "generalised_clip", "clip_slope": -0.3},
    ],
    ids=lambda options: "-".join(map(str, options.values())),
)
def test_a_short_run_is_finite_and_its_audit_says_what_it_is(tmp_path, options):
    run = ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "run", steps=3 * 256 - 100, **SMALL | options)
    assert run.finished
    assert len(run.metrics) == 3
    for row in run.metrics:
        assert all(value is None or np.isfinite(value) for value in row.values())
        assert row["policy_kl"] > 0
        assert ("arc_reused" in row) == ("reuse_batches" in options)
    broken = {claim.clause for claim in run.audit()[:5] if not claim.holds}
    assert broken == ({"(i)"} if "reuse_batches" in options else set())


def test_a_run_that_reuses_resumes_with_the_same_bits(tmp_path, monkeypatch):
    """A full disk at the second checkpoint, within the life of a previous batch; then on from the first."""
    whole = ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "whole", steps=1400, **ARC)
    assert {row["arc_reused"] for row in whole.metrics} == {0, 1}  # both kinds of iteration are in it
    fresh = [row["batch_fresh"] for row in whole.metrics]
    assert all((share < 1) == bool(row["arc_reused"]) for share, row in zip(fresh, whole.metrics, strict=True))
    assert not all(claim.holds for claim in whole.audit() if "current batch" in claim.statement)

    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        fail_from(patch, 2, full)
        with pytest.raises(OSError, match="No space left"):
            ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "run", steps=1400, **ARC)
    kept = load_file(tmp_path / "run" / "checkpoints" / "last.safetensors")
    assert kept["learner.previous.state_ids"].max() == 2 * 256 - 1  # of the second iteration
    ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "run", steps=1400, resume=True, **ARC)
    assert_same(tmp_path / "run", tmp_path / "whole")
