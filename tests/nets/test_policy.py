import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file
from scipy.stats import norm

from ppo_dap.errors import InputError
from ppo_dap.nets.actor import Actor
from ppo_dap.nets.policy import Policy, load_policy, scale_actions, unscale_actions

LOW, HIGH = np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32)
CLIP = 2.0


@pytest.fixture(scope="module")
def actor():
    actor = Actor.create(np.random.default_rng(0), 3, 2, 8)
    return jax.tree.map(
        lambda leaf: leaf + 0.2 * jnp.sin(jnp.arange(leaf.size, dtype=jnp.float32)).reshape(leaf.shape), actor
    )


@pytest.fixture(scope="module")
def policy(actor):
    return Policy(
        tuple(np.asarray(layer.weight) for layer in actor.mlp.layers),
        tuple(np.asarray(layer.bias) for layer in actor.mlp.layers),
        np.asarray(actor.log_std),
        np.array([0.5, -1.0, 100.0], np.float32),
        np.array([2.0, 0.1, 30.0], np.float32),
        CLIP,
        LOW,
        HIGH,
        "Toy-v0",
    )


def observations(n=50):
    return (np.random.default_rng(0).standard_normal((n, 3)) * [2, 0.1, 30] + [0.5, -1, 100]).astype(np.float32)


def test_means_equal_the_actors_at_normalised_observations(actor, policy):
    normalised = np.clip((observations() - policy.observation_mean) / policy.observation_std, -CLIP, CLIP)
    np.testing.assert_allclose(policy.mean(observations()), actor(jnp.asarray(normalised)), rtol=1e-4, atol=1e-5)
    assert np.abs(policy.mean(observations()) - actor(jnp.asarray(observations()))).max() > 0.1


def test_observations_beyond_the_clip_count_as_at_it(policy):
    edge = (policy.observation_mean + CLIP * policy.observation_std)[None]
    far, inside = policy.observation_mean + np.array([[1e6], [0.5]], np.float32) * policy.observation_std
    np.testing.assert_allclose(policy.mean(far[None]), policy.mean(edge), rtol=1e-4, atol=1e-5)
    assert np.abs(policy.mean(inside[None]) - policy.mean(edge)).max() > 1e-2


def test_scaling_goes_there_and_back_with_asymmetric_bounds():
    corners = np.array([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]], np.float32)
    np.testing.assert_allclose(unscale_actions(corners, LOW, HIGH), [LOW, HIGH, [1.0, 0.25]])
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    np.testing.assert_allclose(scale_actions(unscale_actions(actions, LOW, HIGH), LOW, HIGH), actions, atol=1e-6)
    np.testing.assert_array_equal(unscale_actions(np.array([[-9.0, 9.0]]), LOW, HIGH), [[LOW[0], HIGH[1]]])


def test_call_is_deterministic_for_one_and_for_many(policy):
    batch = policy(observations())
    np.testing.assert_array_equal(policy(observations()), batch)
    assert batch.shape == (50, 2)
    assert ((batch >= LOW) & (batch <= HIGH)).all()
    for i in (0, 7):
        np.testing.assert_allclose(policy(observations()[i]), batch[i], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(policy(observations()[0].tolist()), batch[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(scale_actions(batch, LOW, HIGH), np.clip(policy.mean(observations()), -1, 1), atol=1e-5)


@pytest.mark.parametrize("shape", [(), (2,), (4,), (5, 4), (1, 1, 3)])
def test_observations_of_another_shape_are_refused(policy, shape):
    with pytest.raises(InputError, match=r"takes \(3,\) or \(n, 3\)") as caught:
        policy(np.zeros(shape))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ([[0, 0, 0], [0, np.nan, 0]], r"observation is nan at \[1, 1\]"),
        ([0, 0, np.nan], r"observation is nan at \[2\]"),
        (["a", "b", "c"], "observation must be numbers, not"),
        ([[0, 0, 0], [0]], "observation must be numbers, not"),
    ],
)
def test_observations_that_are_no_numbers_are_refused(policy, observation, message):
    with pytest.raises(InputError, match=message) as caught:
        policy(observation)
    assert "\n" not in str(caught.value)


def test_log_prob_of_noise_is_that_of_the_action_it_makes(policy):
    noise = np.random.default_rng(0).standard_normal((50, 2), dtype=np.float32)
    mean, std = policy.mean(observations()), np.exp(policy.log_std)
    expected = norm.logpdf(mean + std * noise, mean, std).sum(-1)
    np.testing.assert_allclose(policy.log_prob_of_noise(noise), expected, rtol=1e-3, atol=1e-4)
    grid = policy.log_prob_of_noise(noise.reshape(10, 5, 2))  # a rollout has time and environments
    np.testing.assert_array_equal(grid, policy.log_prob_of_noise(noise).reshape(10, 5))


@pytest.mark.parametrize("task", ["Toy-v0", None])
def test_a_saved_policy_is_the_same(policy, tmp_path, task):
    policy = dataclasses.replace(policy, task=task)
    policy.save(tmp_path / "new" / "policy.safetensors")
    loaded = load_policy(tmp_path / "new" / "policy.safetensors")
    mine, theirs = (dataclasses.asdict(p) for p in (policy, loaded))
    assert (mine.pop("task"), theirs.pop("task")) == (task, task)
    jax.tree.map(np.testing.assert_array_equal, mine, theirs)
    np.testing.assert_array_equal(loaded(observations()), policy(observations()))


def test_a_policy_file_without_its_tensors_is_refused(policy, tmp_path):
    save_file(
        {"log_std": np.zeros(2, np.float32)}, tmp_path / "p", metadata={"meta": '{"kind": "policy", "format": 1}'}
    )
    with pytest.raises(InputError) as caught:
        load_policy(tmp_path / "p")
    assert "\n" not in str(caught.value)
