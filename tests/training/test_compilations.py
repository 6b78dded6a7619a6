"""Nothing is compiled for networks, nor after the second iteration: not by schedules, checkpoints or evaluations."""

import jax
import pytest

import ppo_dap
from ppo_dap import config as configs
from ppo_dap.priors import load_prior
from ppo_dap.training.algorithm import create_learner
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


def test_networks_and_their_optimizers_begin_without_a_program(hopper_prior, compilations):
    config = configs.make("tuned", hidden_size=48, q_hidden_size=40, adapter_rank=3, q_calibration="affine")
    learner = create_learner((11, 3), config, load_prior(hopper_prior).network)
    assert learner.guide.adapters is not None
    assert not compilations
    jax.jit(lambda x: x * 2.3456)(2.0)
    assert compilations
