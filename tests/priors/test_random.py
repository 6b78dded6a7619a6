import dataclasses

import jax
import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.priors import fit_prior, load_prior
from ppo_dap.priors.network import Network
from ppo_dap.priors.random import random_prior

LOW, HIGH = np.array([-2.0, 0.0, 1.0]), np.array([2.0, 0.5, 1.0])


@pytest.fixture(scope="module")
def control():
    return random_prior(4, LOW, HIGH, "Toy-v0")


def test_actions_are_uniform_in_the_box_whatever_the_state(control):
    states = np.random.default_rng(0).normal(size=(2, 4)) * np.array([[1.0], [100.0]])
    actions = np.asarray(control.sample(states, jax.random.key(0), 4000), np.float64)
    assert actions.shape == (2, 4000, 3)
    for sample in actions:
        for column in (0, 1):
            width = HIGH[column] - LOW[column]
            assert stats.kstest(sample[:, column], stats.uniform(LOW[column], width).cdf).pvalue > 0.01
        assert abs(np.corrcoef(sample[:, 0], sample[:, 1])[0, 1]) < 0.06
        assert np.all(sample[:, 2] == 1.0)
    again = control.sample(-states, jax.random.key(0), 4000)
    np.testing.assert_array_equal(actions, np.asarray(again, np.float64))


def test_its_spread_is_a_uniform_variables(control):
    """The third dimension has no range, and so no spread."""
    np.testing.assert_allclose(control.spread(), [1 / np.sqrt(3), 1 / np.sqrt(3), 0], rtol=0.02)


def test_the_test_of_uniformity_finds_what_is_not(control):
    """The planted fault: normal actions clipped to the box."""
    noise = np.clip(jax.random.normal(jax.random.key(0), (4000,)), -1, 1) * 2
    assert stats.kstest(noise, stats.uniform(-2, 4).cdf).pvalue < 0.01


def test_it_says_what_it_is(control):
    assert (control.kind, control.task, control.logs_hash) == ("random", "Toy-v0", "random")
    assert (control.observation_size, control.action_size) == (4, 3)
    assert isinstance(control.network, Network)
    assert control.condition("none").shape == (0,)
    assert stats.kstest(control.probe_observations.reshape(-1), stats.norm.cdf).pvalue > 0.01
    assert stats.kstest(control.probe_actions.reshape(-1), stats.uniform(-1, 2).cdf).pvalue > 0.01
    with pytest.raises(InputError, match="fitted with condition_on 'return'"):
        control.condition("top")


def test_a_loaded_control_is_the_same_one(control, tmp_path):
    control.save(tmp_path / "prior")
    loaded = load_prior(tmp_path / "prior")
    states = np.ones((3, 4))
    one, two = (p.sample(states, jax.random.key(1), 5) for p in (control, loaded))
    np.testing.assert_array_equal(one, two)
    for field in dataclasses.fields(control):
        if field.name != "network":
            np.testing.assert_equal(getattr(loaded, field.name), getattr(control, field.name))
    assert random_prior(4, LOW, HIGH).probe_actions.tobytes() == control.probe_actions.tobytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, LOW, HIGH), "observation_size must be an integer above 0, not 0"),
        ((4, -np.inf * np.ones(3), HIGH), "must be finite, low <= high"),
        ((4, HIGH, LOW), "must be finite, low <= high"),
        ((4, LOW, [1.0, 2.0]), "must be a number or 3 numbers"),
    ],
)
def test_impossible_sizes_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        random_prior(*arguments)


def test_it_is_not_fitted(logs):
    with pytest.raises(InputError, match=r"unknown prior kind 'random': known are .*retrieval"):
        fit_prior(logs, "random")
