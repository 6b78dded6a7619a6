"""The verdict on a run that was made in two sittings, or of which something was lost."""

import json

import pytest

import ppo_dap
from ppo_dap.training.trainer import Trainer

STEPS = {"steps": 800, "progress": False, "eval_every": 0, "eval_episodes": 1}


def trained(out, small):
    return ppo_dap.train("Hopper-v5", "ppo", out=out, **STEPS, **{k: v for k, v in small.items() if k not in STEPS})


def broken(run):
    return [claim.statement for claim in run.audit() if not claim.holds]


def test_a_violation_before_a_run_was_cut_off_is_not_forgotten(tmp_path, monkeypatch, small):
    out = tmp_path / "run"

    def stop(self, name):
        real(self, name)
        if name == "last":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        real = Trainer.checkpoint
        patch.setattr(Trainer, "checkpoint", stop)
        with pytest.raises(KeyboardInterrupt):
            trained(out, small)
    proofs = json.loads((out / "audit.json").read_text())
    proofs["static"][1] |= {"holds": False, "evidence": "reached by q"}
    (out / "audit.json").write_text(json.dumps(proofs))
    options = {k: v for k, v in small.items() if k not in STEPS}
    run = ppo_dap.train("Hopper-v5", "ppo", out=out, resume=True, **STEPS, **options)
    assert run.finished
    assert broken(run) == [proofs["static"][1]["statement"]]


@pytest.mark.parametrize("lost", ["a row", "the end", "a broken line", "the proofs"])
def test_what_is_lost_of_a_run_does_not_hold(tmp_path, small, lost):
    run = trained(tmp_path / "run", small)
    lines = (run.folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    if lost == "the proofs":
        (run.folder / "audit.json").write_text('{"static": []}')
    elif lost == "a broken line":
        lines[2] = lines[2][:20] + "\n"
    else:
        del lines[2 if lost == "a row" else -1]
    (run.folder / "metrics.jsonl").write_text("".join(lines))
    assert len(broken(run)) == 2
    assert not any(run.verdict())


def test_another_prior_of_the_same_logs_cannot_resume_a_run(tmp_path, small, hopper_logs, hopper_prior):
    options = {k: v for k, v in small.items() if k not in STEPS} | STEPS | {"steps": 128}
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", **options)
    other = ppo_dap.fit_prior(hopper_logs, width=16, max_steps=20, chunk_steps=20, batch_size=64, seed=1)
    with pytest.raises(ppo_dap.InputError, match="prior_weights"):
        ppo_dap.train("Hopper-v5", prior=other, out=tmp_path / "run", resume=True, **options)
    ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", resume=True, **options)
