"""Episode ends that no flag marks: a made-up task, and rollouts of MuJoCo tasks with their flags taken away."""

import dataclasses

import numpy as np
import pytest

from logs.logs_made import level, make_logs, message, pendulums
from ppo_dap.logs import Logs, check_logs
from ppo_dap.logs.jumps import ONE_IN, Jumps, find_jumps
from ppo_dap.tasks import describe, make_vector_env

TASKS = (*("Hopper-v5", "Walker2d-v5", "HalfCheetah-v5", "Ant-v5", "Swimmer-v5", "Pusher-v5", "HumanoidStandup-v5"),)
NUM_ENVS, STEPS = 16, 110


def driven_pendulums(seed):
    arrays = pendulums(seed=seed)
    return Logs(arrays["observations"], arrays["actions"], arrays["timeouts"])


def without(logs, ends):
    left = logs.episode_ends.copy()
    left[ends] = False
    return dataclasses.replace(logs, episode_ends=left, terminated=None)


def rollouts(task, kind, seed):
    """Every environment's rows one after the other; an episode ends where the task ends it or the rollout does."""
    spec, rng = describe(task), np.random.default_rng(seed)
    weights = rng.normal(size=(spec.observation_size, spec.action_size)) / np.sqrt(spec.observation_size)
    env = make_vector_env(task, NUM_ENVS, seed)
    rows = [[] for _ in range(NUM_ENVS)]
    observations = env.reset()
    for _ in range(STEPS):
        unit = rng.uniform(-1, 1, (NUM_ENVS, spec.action_size))
        if kind == "linear":
            unit = np.tanh(observations @ weights) + 0.2 * rng.normal(size=unit.shape)
        actions = (spec.action_low + (np.clip(unit, -1, 1) + 1) / 2 * (spec.action_high - spec.action_low)).astype("f")
        step = env.step(actions)
        for i in np.flatnonzero(step.valid):
            rows[i].append((observations[i], actions[i], step.terminated[i] | step.truncated[i]))
        observations = step.observations
    env.close()
    for part in rows:
        part[-1] = (*part[-1][:2], True)
    return Logs(*(np.stack(column) for column in zip(*(row for part in rows for row in part), strict=True)))


@pytest.mark.parametrize("kind", ["random", "linear"])
@pytest.mark.parametrize("task", TASKS)
def test_unmarked_ends_of_real_tasks_are_found_and_clean_logs_are_not_accused(task, kind):
    """On seeds that the thresholds were not chosen on. Both directions, with all marks gone and with a few."""
    logs = rollouts(task, kind, seed=2024)
    assert find_jumps(logs).rows.tolist() == []
    ends = np.flatnonzero(logs.episode_ends)[:-1]
    found = find_jumps(without(logs, ends)).rows
    assert set(found) <= set(ends)
    assert len(found) >= 0.85 * len(ends)
    some = ends[:: max(1, len(ends) // 5)]
    found = find_jumps(without(logs, some)).rows
    assert set(found) <= set(some)
    assert len(found) >= 0.6 * len(some)


@pytest.mark.parametrize("seed", range(4))
def test_two_unmarked_timeouts_are_named(seed):
    logs = driven_pendulums(seed)
    clean = check_logs(logs)
    assert level(clean, "unmarked ends") == "ok"
    assert "none found (one-step model of 6 columns, fitted to 1770 steps)" in message(clean, "unmarked ends")
    ends = np.flatnonzero(logs.episode_ends)[[10, 20]]
    report = check_logs(without(logs, ends))
    assert report.jumps.rows.tolist() == ends.tolist()
    assert report.exit_code == 1
    assert f"inside an episode after 2 rows: {ends[0]}, {ends[1]}: mark" in message(report, "unmarked ends")


def test_a_jump_of_the_whole_state_is_found_without_velocities():
    walk = np.cumsum(np.random.default_rng(0).normal(size=(500, 4)), axis=0)
    walk[250:] += 1000.0
    logs = Logs(walk, np.zeros((500, 1)), np.arange(500) == 499)
    assert find_jumps(logs).rows.tolist() == [249]


def test_columns_that_rest_drown_nothing():
    """Contact forces are 0 in most rows and large in some: such columns are left out, and constant ones."""
    logs = driven_pendulums(0)
    rng = np.random.default_rng(0)
    forces = np.where(rng.random((logs.num_rows, 20)) < 0.2, rng.normal(size=(logs.num_rows, 20)) * 100, 0)
    padded = np.concatenate([logs.observations, forces, np.ones((logs.num_rows, 5))], axis=1)
    padded = dataclasses.replace(logs, observations=padded)
    assert find_jumps(padded).rows.size == 0
    ends = np.flatnonzero(logs.episode_ends)[[5]]
    found = find_jumps(without(padded, ends))
    assert found.rows.tolist() == ends.tolist()
    assert found.num_columns == 6


def test_more_columns_than_the_fit_takes():
    """100 sensors of the same motion: the best of them are chosen, and the jump is still found."""
    logs = driven_pendulums(0)
    rng = np.random.default_rng(0)
    wide = np.concatenate([logs.observations, logs.observations @ rng.normal(size=(6, 94))], axis=1)
    wide = dataclasses.replace(logs, observations=wide)
    ends = np.flatnonzero(logs.episode_ends)[[5]]
    assert find_jumps(wide).rows.size == 0
    found = find_jumps(without(wide, ends))
    assert found.rows.tolist() == ends.tolist()
    assert 0 < found.num_columns <= 48


def test_large_logs_are_fitted_to_some_rows_and_all_are_looked_at(monkeypatch):
    monkeypatch.setattr("ppo_dap.logs.jumps.MAX_FIT_ROWS", 500)
    monkeypatch.setattr("ppo_dap.logs.jumps.CHUNK", 64)
    logs = driven_pendulums(1)
    ends = np.flatnonzero(logs.episode_ends)[[3, 17]]
    found = find_jumps(without(logs, ends))
    assert found.rows.tolist() == ends.tolist()
    assert 250 < found.num_fit_rows <= 500
    assert np.isfinite(found.mismatch).sum() == logs.num_rows - 28


def test_short_or_constant_logs_have_no_jumps_and_say_that_they_were_not_checked():
    still = Logs(np.ones((200, 4)), np.zeros((200, 1)), np.arange(200) == 199)
    for logs in (make_logs(), still):
        assert find_jumps(logs).rows.size == 0
        assert message(check_logs(logs), "unmarked ends").startswith("not checked")


def test_as_few_as_heavy_tails_have_are_no_warning():
    def jumps(rows, found):
        return Jumps(np.arange(found), np.zeros(rows), 3, rows)

    assert jumps(ONE_IN - 1, 1).suspicious
    assert not jumps(ONE_IN, 1).suspicious
    assert jumps(2 * ONE_IN - 1, 2).suspicious
    assert not jumps(100, 0).suspicious
