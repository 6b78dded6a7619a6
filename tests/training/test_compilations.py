"""After the second iteration nothing is compiled any more: not by schedules, checkpoints, evaluations or their ends."""

import jax
import pytest

import ppo_dap
from ppo_dap.training.recording import Recorder

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compilations():
    """A list that grows by one with each compilation (programs that the persistent cache gives count as well)."""
    seen = []

    def listen(event, seconds, **_):
        if event == COMPILED:
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize("kl_rule", ["stop_epochs", "reduce_lr"])
def test_nothing_is_compiled_after_the_second_iteration(
    tmp_path, small, hopper_prior, monkeypatch, compilations, kl_rule
):
    counts, add = [], Recorder.add

    def count(recorder, table, row):
        if table == "metrics":
            counts.append(len(compilations))
        add(recorder, table, row)

    monkeypatch.setattr(Recorder, "add", count)
    options = {"steps": 1024, "progress": False, "kl_rule": kl_rule, "lambda_decay": 0.5, "pet_frequency": 15}
    run = ppo_dap.train("Hopper-v5", prior=hopper_prior, out=tmp_path / "run", seed=3, **{**small, **options})
    assert len(counts) == len(run.metrics) >= 8
    assert counts[1] > 0  # the listener hears
    assert counts[1] == counts[-1]
    jax.jit(lambda x: x * 1.2345)(2.0)
    assert len(compilations) > counts[-1]  # and would have heard more
