"""`Guide`: what another PPO gets from arrays alone, in its own environment's units."""

import math
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ppo_dap
from ppo_dap.config import flatten, make, replace
from ppo_dap.errors import InputError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "guide_in_another_ppo.py"
LOW, HIGH = np.array([-1.0, 100.0], np.float32), np.array([3.0, 500.0], np.float32)
ROWS, OBS = 64, 3
OPTIONS = {"num_proposals": 3, "sampler_steps": 2, "minibatch_size": 32, "pet_frequency": 100}


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(0)
    return ppo_dap.fit_prior(
        ppo_dap.Logs(
            observations=rng.normal(size=(256, OBS)),
            actions=rng.uniform(LOW, HIGH, (256, 2)),
            episode_ends=np.arange(1, 257) % 16 == 0,
            action_low=LOW,
            action_high=HIGH,
        ),
        width=16,
        max_steps=20,
        chunk_steps=20,
        batch_size=64,
    )


@pytest.fixture
def batch():
    rng = np.random.default_rng(1)
    return {
        "observations": rng.normal(size=(ROWS, OBS)).astype(np.float32),
        "actions": rng.uniform(LOW, HIGH, (ROWS, 2)).astype(np.float32),
        "rewards": rng.normal(size=ROWS).astype(np.float32),
        "next_values": rng.normal(size=ROWS).astype(np.float32),
        "terminated": rng.random(ROWS) < 0.1,
    }


def guide_of(prior, total_iterations=4, **options):
    return ppo_dap.Guide(prior, total_iterations=total_iterations, **(OPTIONS | options))


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_proposals_are_in_environment_units_and_know_their_rows(prior, batch):
    guide = guide_of(prior)
    for _ in range(2):
        proposals = guide(**batch)
        ids = np.asarray(proposals.state_ids)
        assert proposals.actions.shape == (len(ids), 3, 2)
        assert len(set(ids.tolist())) == len(ids) == 12  # a fifth of the rows
        np.testing.assert_array_equal(proposals.raw_observations, batch["observations"][ids])
        np.testing.assert_array_equal(proposals.observations, batch["observations"][ids])
        slack = 1e-5 * (HIGH - LOW)
        for actions in (np.asarray(proposals.actions), np.asarray(proposals.proxy_mean)):
            assert np.all(actions >= LOW - slack)
            assert np.all(actions <= HIGH + slack)
        # The proxy's moments in environment units, its floor of 0.1 in scaled actions.
        actions = np.asarray(proposals.actions)
        np.testing.assert_allclose(proposals.proxy_mean, actions.mean(1), rtol=1e-4, atol=1e-3)
        spread = np.maximum(actions.std(1), 0.1 * (HIGH - LOW) / 2)
        np.testing.assert_allclose(proposals.proxy_std, spread, rtol=1e-3, atol=1e-3)
    assert actions[..., 1].max() > 110  # not left in [-1, 1]


def test_metrics_are_finite_and_every_state_is_of_the_batch(prior, batch):
    guide = guide_of(prior)
    for _ in range(2):
        guide(**batch)
        assert {"ess", "spr", "q_loss", "pet_loss", "pet_spr", "adapter_norm"} <= set(guide.metrics)
        assert all(math.isfinite(value) for value in guide.metrics.values())
        assert guide.metrics["spr"] == guide.metrics["pet_spr"] == 1


@pytest.mark.parametrize("fraction", [0.2, 1.0])
def test_rows_in_which_nothing_happened_get_no_proposals(prior, batch, fraction):
    valid = np.arange(ROWS) % 4 != 0
    guide = guide_of(prior, proposal_fraction=fraction)
    ids = np.asarray(guide(**batch, valid=valid).state_ids)
    assert len(ids) > 0
    assert valid[ids].all()
    assert guide.metrics["spr"] == 1


def test_rows_in_which_nothing_happened_teach_nothing(prior, batch):
    valid = np.arange(ROWS) % 4 != 0
    other = {name: value.copy() for name, value in batch.items()}
    other["rewards"][~valid], other["actions"][~valid] = 1000.0, HIGH
    one, two = guide_of(prior), guide_of(prior)
    for _ in range(2):
        assert_same(one(**batch, valid=valid), two(**other, valid=valid))
    assert one.metrics == two.metrics


def test_the_seed_decides(prior, batch):
    first, again, other = (guide_of(prior, seed=seed)(**batch) for seed in (1, 1, 2))
    assert_same(first, again)
    assert not np.array_equal(first.actions, other.actions)


def test_jax_and_numpy_arrays_give_the_same(prior, batch):
    assert_same(guide_of(prior)(**batch), guide_of(prior)(**{name: jnp.asarray(x) for name, x in batch.items()}))


def test_beta_rises_from_0_with_the_calls(prior, batch):
    guide = guide_of(prior, total_iterations=2, guidance="energy", beta_anneal=0.5, beta_max=20.0)
    ess = []
    for _ in range(2):
        guide(**batch)
        ess.append(guide.metrics["ess"])
    assert guide.iteration == 2
    assert ess[0] == pytest.approx(3)  # beta 0: even weights over the 3 proposals
    assert ess[1] < 2.95


def test_pet_moves_the_adapters_and_not_the_prior(prior, batch):
    before = jax.tree.map(np.array, prior.network)
    guide, still = guide_of(prior), guide_of(prior, pet_frequency=0)
    for _ in range(2):
        guide(**batch)
        still(**batch)
    assert guide.metrics["adapter_norm"] > 0
    assert "adapter_norm" not in still.metrics  # there are no adapters
    assert guide.prior is prior
    assert_same(before, prior.network)


def changed(**changes):
    return lambda batch: batch | {name: change(batch[name]) for name, change in changes.items()}


def first(value):
    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


def rows(count):
    return lambda batch: {name: np.resize(x, (count, *x.shape[1:])) for name, x in batch.items()}


BAD_BATCHES = {
    "observations of another width": (changed(observations=lambda x: x[:, :2]), r"observations .*should have \(n, 3\)"),
    "one observation": (changed(observations=lambda x: x[0]), r"observations has shape \(3,\)"),
    "actions of another width": (changed(actions=lambda x: x[:, :1]), r"actions .*should have \(64, 2\)"),
    "fewer rewards": (changed(rewards=lambda x: x[1:]), r"rewards .*should have \(64,\)"),
    "a column of values": (changed(next_values=lambda x: x[:, None]), r"next_values has shape \(64, 1\)"),
    "fewer ends": (changed(terminated=lambda x: x[1:]), "terminated has shape"),
    "fewer flags": (lambda batch: batch | {"valid": np.ones(ROWS - 1, bool)}, "valid has shape"),
    "words": (
        lambda batch: batch | {"rewards": np.full(ROWS, "good")},
        r"rewards is a ndarray, should be numbers .* \(64,\)",
    ),
    "no flag": (changed(terminated=lambda x: 2.0 * x), "terminated has 2, should be False or True"),
    "half valid": (lambda batch: batch | {"valid": np.full(ROWS, 0.5)}, r"valid has 0\.5, should be False or True"),
    "NaN": (changed(rewards=first(np.nan)), "rewards has NaN"),
    "infinite": (changed(observations=first(np.inf)), "observations has NaN or infinite"),
    "too few rows": (rows(16), "16 rows is smaller than minibatch_size 32"),
    "no whole minibatches": (rows(48), "48 rows must be a multiple of minibatch_size 32"),
}


@pytest.mark.parametrize("name", BAD_BATCHES)
def test_a_bad_batch_is_refused_in_one_line_and_changes_nothing(prior, batch, name):
    change, message = BAD_BATCHES[name]
    guide = guide_of(prior)
    with pytest.raises(InputError, match=message) as caught:
        guide(**change(batch))
    assert "\n" not in str(caught.value)
    assert guide.iteration == 0
    assert guide.metrics == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"total_iterations": 0}, "total_iterations must be a whole number above 0, not 0"),
        ({"num_proposal": 3}, "num_proposal'.*num_proposals"),
        ({"preset": "papers"}, "papers'.*paper"),
        ({"beta_max": -1.0}, "beta_max must be"),
        ({"mode_seeking": 0.5}, "mode_seeking 0.5 needs this package's own PPO: a Guide has 0.0"),
        ({"std_floor": 0.3}, "std_floor 0.3 needs this package's own PPO: a Guide has 0.0"),
        ({"warm_start": "actor"}, "warm_start 'actor' needs this package's own PPO: a Guide has 'none'"),
        ({"preset": "tuned", "q_target": "gae"}, "q_target 'gae' needs this package's own PPO: a Guide has 'td'"),
    ],
)
def test_bad_options_are_refused_in_one_line(prior, options, message):
    with pytest.raises(InputError, match=message) as caught:
        guide_of(prior, **options)
    assert "\n" not in str(caught.value)


def test_it_takes_a_prior_by_its_file(prior, batch, tmp_path):
    prior.save(tmp_path / "prior")
    assert_same(guide_of(tmp_path / "prior")(**batch), guide_of(prior)(**batch))


def test_of_a_preset_it_has_all_but_what_needs_the_policy(prior, batch):
    guide = guide_of(prior, preset="tuned")
    tuned = make("tuned")
    left_out = {"mode_seeking": 0.0, "guidance_gate": False, "std_floor": 0.0, "std_after": 0.0}
    of_preset, of_guide = flatten(tuned), flatten(guide.config)
    assert all(of_preset[name] != off == of_guide[name] for name, off in left_out.items())
    assert guide.config.objective == replace(tuned, std_floor=0.0, std_after=0.0).objective
    assert np.isfinite(guide(**batch).actions).all()


def test_the_example_runs_and_is_short():
    assert len(EXAMPLE.read_text().splitlines()) < 80
    environment = os.environ | {"PYTHONWARNINGS": "default"}
    command = [sys.executable, str(EXAMPLE), "--iterations", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("iteration 1: return -")
