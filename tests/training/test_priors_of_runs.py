"""Whole runs with another prior than the fitted diffusion one, or with less of the method; and which are refused."""

import json

import jax
import numpy as np
import pytest

import ppo_dap
from ppo_dap.errors import InputError
from ppo_dap.priors import random_prior
from ppo_dap.tasks import describe

TASK = "Hopper-v5"
TINY = {
    "num_envs": 4, "rollout_steps": 64, "minibatch_size": 32, "num_epochs": 1, "hidden_size": 8, "q_hidden_size": 8,
    "num_proposals": 3, "sampler_steps": 2, "pet_minibatch_size": 16, "adapter_rank": 2, "eval_episodes": 1,
    "eval_every": 0, "steps": 100, "tensorboard": False, "progress": False,
}  # fmt: skip


@pytest.fixture(autouse=True)
def quick_compilation():
    """No bit is compared here."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def trained(out, method, prior, **options):
    return ppo_dap.train(TASK, method, prior=prior, out=out, **TINY | options)


@pytest.mark.parametrize(
    ("method", "kind"), [("ppo-behavior-kl", "behaviour"), ("ppo-flow", "flow"), ("ppo-retrieval", "retrieval")]
)
def test_a_prior_of_another_kind_is_refused(tmp_path, hopper_prior, method, kind):
    with pytest.raises(InputError) as caught:
        trained(tmp_path / "run", method, hopper_prior)
    assert str(caught.value) == (
        f"method {method} needs a {kind} prior, but this one is of kind 'diffusion': fit one with "
        f"`ppo-dap pretrain --kind {kind}`, or choose the method of that prior"
    )
    with pytest.raises(InputError, match=f"needs a {kind} prior: fit one with `ppo-dap pretrain --kind {kind}`"):
        trained(tmp_path / "run", method, None)
    assert not (tmp_path / "run").exists()


def test_the_random_control_cannot_do_what_a_diffusion_prior_can(tmp_path):
    for name, value in {"guidance": "gradient", "pet_frequency": 10, "prior_return_weight": 2.0}.items():
        with pytest.raises(InputError, match=f"{name} {value!r} contradicts method ppo-dap.*diffusion prior"):
            trained(tmp_path / "run", "ppo-dap", "random", **{name: value})
    assert not (tmp_path / "run").exists()


def assert_trained(run):
    assert run.finished
    assert len(run.metrics) == 2
    for row in run.metrics:
        assert all(value is None or np.isfinite(value) for value in row.values())
        assert row["spr"] == 1
        assert row["oglr"] == 0 < row["oglr_ungated"]
    assert all(claim.holds for claim in run.audit())
    assert run.verdict() == (True, True)


def without_pet(run):
    """No adapters: nothing is tuned, nothing of it is logged or claimed, and the prior stays where it was."""
    names = {name for row in run.metrics for name in row}
    assert not [name for name in names if name.startswith("pet") or name in ("adapter_norm",)]
    assert all(row["prior_kl"] == row["prior_drift"] == 0 for row in run.metrics)
    assert not any("PET" in claim.statement for claim in run.audit())
    return True


def test_the_random_control_trains_with_energy_alone(tmp_path):
    run = trained(tmp_path / "run", "ppo-dap", "random")
    assert_trained(run)
    config = run.config["config"]
    assert (config["guidance"], config["pet_frequency"], config["prior_return"]) == ("energy", 0, "none")
    assert run.config["prior_hash"] == "random"
    assert all(row["guided_displacement"] == 0 for row in run.metrics)
    assert without_pet(run)


def test_no_pet_trains_without_adapters_and_with_the_gradient(tmp_path, hopper_prior):
    run = trained(tmp_path / "run", "ppo-dap-no-pet", hopper_prior)
    assert_trained(run)
    assert (run.config["config"]["guidance"], run.config["config"]["pet_frequency"]) == ("energy+gradient", 0)
    assert without_pet(run)
    # A batch that was not all its own: neither strictly on-policy, nor what the method's row says.
    path = run.folder / "metrics.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(row | {"spr": 0.9}) + "\n" for row in rows))
    spoilt = ppo_dap.load_run(run.folder)
    assert spoilt.verdict() == (False, False)
    assert [claim.clause for claim in spoilt.audit() if not claim.holds] == ["(ii)"]


def test_a_control_made_for_another_box_is_refused(tmp_path):
    spec = describe(TASK)
    other = random_prior(spec.observation_size, 2 * spec.action_low, 2 * spec.action_high)
    with pytest.raises(InputError, match=r"action bounds .* are not those of Hopper-v5"):
        trained(tmp_path / "run", "ppo-dap", other)
