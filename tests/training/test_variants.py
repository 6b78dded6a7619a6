"""Whole runs of what stands for ABPPO, PPO-GC and PPO-ARC, and that they resume with the same bits."""

import errno
import os

import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

import ppo_dap
from ppo_dap.ppo import reuse
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


def trained(out, method, steps=3 * 256 - 100, **options):
    return ppo_dap.train("Hopper-v5", method, out=out, steps=steps, **SMALL | options)


def assert_finite(run, iterations):
    assert len(run.metrics) == iterations
    for row in run.metrics:
        assert all(value is None or np.isfinite(value) for value in row.values())
        assert row["policy_kl"] > 0


@pytest.mark.parametrize("method", ["ppo-abppo", "ppo-gc"])
def test_another_surrogate_trains_and_is_strictly_on_policy(tmp_path, method):
    run = trained(tmp_path / "run", method)
    assert_finite(run, 3)
    assert not any("arc_reused" in row for row in run.metrics)
    assert all(claim.holds for claim in run.audit())


@pytest.fixture
def the_reused_batch_wins(monkeypatch):
    """The contest goes to the lower score: on the batch that PPO's candidate alone was made for, that is the other."""
    score = reuse.score

    def reversed_score(*arguments):
        value, kl = score(*arguments)
        return -value, kl

    monkeypatch.setattr(reuse, "score", reversed_score)


def test_a_run_that_reuses_a_batch_says_so_and_resumes_with_the_same_bits(tmp_path, monkeypatch, the_reused_batch_wins):
    """A full disk at the second checkpoint, within the life of a previous batch; then on from the first."""
    whole = trained(tmp_path / "whole", "ppo-arc", 1000)
    assert_finite(whole, 5)
    assert [row["arc_reused"] for row in whole.metrics] == [0, 1, 1, 1, 1]
    fresh = [row["batch_fresh"] for row in whole.metrics]
    assert fresh[0] == 1
    assert fresh[1:] == pytest.approx([0.5] * 4, abs=0.02)
    assert whole.verdict() == (False, True)  # not strictly on-policy, as its row of the table says
    broken = [claim for claim in whole.audit() if not claim.holds]
    assert [claim.clause for claim in broken] == ["(i)"] * 4
    assert [claim.evidence for claim in broken[:3]] == ["reached by previous"] * 3
    assert "current batch" in broken[3].statement

    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        fail_from(patch, 2, full)
        with pytest.raises(OSError, match="No space left"):
            trained(tmp_path / "run", "ppo-arc", 1000)
    kept = load_file(tmp_path / "run" / "checkpoints" / "last.safetensors")
    assert kept["learner.previous.state_ids"].max() == 2 * 256 - 1  # of the second iteration
    trained(tmp_path / "run", "ppo-arc", 1000, resume=True)
    assert_same(tmp_path / "run", tmp_path / "whole")


@pytest.mark.as_shipped
def test_a_run_whose_old_batches_never_win_is_ppo_bit_for_bit(tmp_path, monkeypatch):
    """Every contest is a draw, and a draw is PPO's: the second candidate, its orders and its batch leave no trace."""
    monkeypatch.setattr(reuse, "score", lambda *arguments: (jnp.float32(0), jnp.float32(0)))
    arc, ppo = trained(tmp_path / "arc", "ppo-arc"), trained(tmp_path / "ppo", "ppo")
    theirs, ours = (load_file(run.folder / "checkpoints" / "last.safetensors") for run in (ppo, arc))
    assert {name for name in ours if "previous" not in name} == theirs.keys() != ours.keys()
    assert all(ours[name].tobytes() == theirs[name].tobytes() for name in theirs)
    assert [row["policy_kl"] for row in arc.metrics] == [row["policy_kl"] for row in ppo.metrics]
