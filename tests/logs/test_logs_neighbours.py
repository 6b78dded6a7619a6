"""Nearest-neighbour spread and mixture of policies, against brute force and against what made the logs."""

import dataclasses

import numpy as np
import pytest

from logs.logs_made import level, message
from ppo_dap.logs import Logs, check_logs
from ppo_dap.logs.neighbours import NEIGHBOURS, find_mixture, find_neighbours

EPISODES, LENGTH = 30, 60


def policies(gains, seed=0, noise=0.3, noise_memory=0.0):
    """Episodes on a shared stationary walk in the plane; episode e acts by gains[e % len(gains)] @ state + noise."""
    rng = np.random.default_rng(seed)
    states, actions = [], []
    for episode in range(EPISODES):
        state, held = rng.normal(size=2), rng.normal(size=1)
        for _ in range(LENGTH):
            held = noise_memory * held + np.sqrt(1 - noise_memory**2) * rng.normal(size=1)
            states.append(state)
            actions.append(np.atleast_1d(gains[episode % len(gains)] @ state) + noise * held)
            state = 0.9 * state + np.sqrt(1 - 0.81) * rng.normal(size=2)
    return Logs(np.array(states), np.array(actions), np.arange(EPISODES * LENGTH) % LENGTH == LENGTH - 1)


ONE = (np.array([1.0, -0.5]),)
TWO = (np.array([1.0, -0.5]), np.array([0.2, 0.9]))


def test_neighbours_equal_the_brute_force_ones():
    logs = policies(ONE)
    found = find_neighbours(logs)
    states = logs.observations.astype(np.float64)
    # Whitened distance is the Mahalanobis one, which knows no principal components.
    inverse = np.linalg.inv(np.cov(states.T))
    episode = np.arange(logs.num_rows) // LENGTH
    pool = np.random.default_rng(0)  # the draws of the code, so that the same rows are allowed as neighbours
    pool.choice(logs.num_rows, logs.num_rows, replace=False)
    pool = pool.random(logs.num_rows) < 0.5
    for query in range(0, len(found.rows), 97):
        row = found.rows[query]
        away = states - states[row]
        distance = np.einsum("ij,jk,ik->i", away, inverse, away)
        distance[(episode == episode[row]) | (pool != (row % LENGTH >= LENGTH / 2))] = np.inf
        near = np.argsort(distance)[:NEIGHBOURS]
        expected = ((logs.actions[row] - logs.actions[near]) ** 2).mean() / 2 / logs.actions.astype(np.float64).var()
        np.testing.assert_allclose(found.spread[query], expected, rtol=1e-4)
        np.testing.assert_allclose(found.distance[query], np.sqrt(distance[near].mean() / 4), rtol=1e-3)


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0])
def test_spread_is_the_noise_share_of_the_variance(noise):
    found = find_neighbours(policies(ONE, noise=noise))
    share = noise**2 / (noise**2 + 1.25)
    np.testing.assert_allclose(found.spread.mean(), share, atol=0.03)


def test_actions_out_of_step_with_their_states_are_found():
    logs = policies(ONE)
    assert level(check_logs(logs), "neighbour spread") == "ok"
    shuffled = np.random.default_rng(1).permutation(logs.actions)
    report = check_logs(dataclasses.replace(logs, actions=shuffled))
    assert level(report, "neighbour spread") == "warning"
    assert "the state hardly settles the action" in message(report, "neighbour spread")


def test_a_mixture_is_found_and_its_episodes_are_told_apart():
    report = check_logs(policies(TWO))
    assert level(report, "mixture") == "warning"
    assert report.mixture.share > 0.1
    first, second = report.mixture.halves
    group = np.arange(EPISODES) % 2 == 0
    assert abs(np.corrcoef(group, first)[0, 1]) > 0.7
    assert abs(np.corrcoef(group, second)[0, 1]) > 0.7


def test_a_shift_of_some_episodes_is_found():
    logs = policies(ONE)
    shifted = logs.actions + 0.5 * (np.arange(logs.num_rows) // LENGTH % 3 == 0)[:, None]
    assert level(check_logs(dataclasses.replace(logs, actions=shifted)), "mixture") == "warning"


def test_one_policy_is_accused_as_rarely_as_the_p_value_says():
    """80 logs of one policy: p-values are uniform (Kolmogorov-Smirnov, 0.1 % level) and none is at the bottom."""
    from scipy.stats import kstest

    results = []
    for seed in range(80):
        logs = policies(ONE, seed, noise=(0.0, 0.3, 3.0)[seed % 3]).select(np.arange(10))
        results.append(find_mixture(logs, find_neighbours(logs)).p_value)
    assert kstest(results, "uniform").pvalue > 0.001
    assert sum(p <= 0.001 for p in results) <= 1  # 0.08 expected; 2 or more once in 320 times


def test_few_rows_or_a_single_episode_are_not_checked():
    logs = policies(ONE)
    for few in (logs.select([0]), logs.select([0, 1]).take(np.arange(50, 70))):
        report = check_logs(few)
        assert len(find_neighbours(few).rows) == 0
        assert message(report, "neighbour spread").startswith("not checked")
        assert message(report, "mixture").startswith("not checked")
    seven = check_logs(logs.select(np.arange(7)))
    assert message(seven, "mixture").startswith("not checked")
    assert not message(seven, "neighbour spread").startswith("not checked")


def test_large_logs_are_compared_on_a_sample_by_a_fixed_seed(monkeypatch):
    logs = policies(TWO)
    monkeypatch.setattr("ppo_dap.logs.neighbours.MAX_ROWS", 900)
    found = find_neighbours(logs)
    assert found.num_rows == 900
    np.testing.assert_array_equal(found.rows, find_neighbours(logs).rows)
    assert level(check_logs(logs), "mixture") == "warning"


@pytest.mark.parametrize("name", ["observations", "actions"])
def test_constant_columns_are_no_trouble(name):
    logs = policies(ONE)
    padded = np.concatenate([getattr(logs, name), np.ones((logs.num_rows, 2))], axis=1)
    found = find_neighbours(dataclasses.replace(logs, **{name: padded}))
    np.testing.assert_allclose(found.spread.mean(), find_neighbours(logs).spread.mean(), rtol=1e-6)
    still = dataclasses.replace(logs, **{name: np.ones_like(getattr(logs, name))})
    assert check_logs(still).exit_code == 1
