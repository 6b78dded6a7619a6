"""PPO is untouched: with both weights at zero PPO-DAP is PPO, bit for bit, on real tasks with the real recipe."""

import pytest
from safetensors.numpy import load_file

import ppo_dap
from ppo_dap.training.collect import collect_logs

pytestmark = pytest.mark.as_shipped

STEPS = 20 * 2048 - 1000


@pytest.mark.parametrize("task", ["Hopper-v5", "Pusher-v5"])
def test_ppo_dap_with_zero_weights_is_ppo(tmp_path, task):
    options = {"steps": STEPS, "eval_every": 0, "eval_episodes": 1, "progress": False, "tensorboard": False}
    plain = ppo_dap.train(task, "ppo", out=tmp_path / "ppo", **options)
    logs = collect_logs(plain.policy, task, 500)
    prior = ppo_dap.fit_prior(logs, width=16, max_steps=20, chunk_steps=20, batch_size=64)
    options |= {"lambda_kl": 0, "lambda_aux": 0, "num_proposals": 3, "sampler_steps": 2}
    guided = ppo_dap.train(task, "ppo-dap", prior=prior, out=tmp_path / "dap", **options)
    assert len(guided.metrics) == len(plain.metrics) >= 20
    theirs = load_file(tmp_path / "ppo" / "checkpoints" / "last.safetensors")
    ours = load_file(tmp_path / "dap" / "checkpoints" / "last.safetensors")
    assert len(theirs) > 20
    assert all(ours[name].tobytes() == theirs[name].tobytes() for name in theirs)
    # The guide was at work all the same.
    assert any("guide" in name for name in ours)
    assert all(row["spr"] == 1 and row["q_loss"] > 0 for row in guided.metrics)
