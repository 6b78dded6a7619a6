"""What a run keeps of itself when it is asked to, held against its records and what the task is known for."""

import json
import shutil

import numpy as np
import pytest

import ppo_dap
from ppo_dap.errors import InputError
from ppo_dap.training.collect import thin
from ppo_dap.training.history import History


def unhealthy(observation):
    """Hopper-v5 ends where the torso is below 0.7 or leans more than 0.2, by its documentation."""
    return observation[0] < 0.7 or abs(observation[1]) > 0.2 or (np.abs(observation[1:]) > 100).any()


@pytest.fixture(scope="module")
def kept(tmp_path_factory, small):
    out = tmp_path_factory.mktemp("kept") / "run"
    return ppo_dap.train("Hopper-v5", "ppo", out=out, steps=1200, progress=False, keep_history=True, **small)


@pytest.fixture(scope="module")
def episodes(kept):
    return History(kept.folder).episodes(len(kept.metrics))


def test_every_row_that_was_stepped_is_kept(kept, episodes):
    assert sum(len(episode.rewards) for episode in episodes) == kept.metrics[-1]["env_steps"]


def test_returns_are_those_that_training_counted(kept, episodes):
    """Collectors add returns up as they go; a whole episode's must be among an iteration's mean."""
    ended = [episode.rewards.sum() for episode in episodes if episode.terminated[-1]]
    means = [row["return_train"] for row in kept.metrics if row["return_train"] is not None]
    counted = np.array(ended, np.float64)
    assert len(counted) > 10
    assert counted.min() <= min(means)
    assert max(means) <= counted.max()


def test_episodes_end_where_the_hopper_falls(episodes):
    fallen = [episode for episode in episodes if episode.terminated[-1]]
    assert all(unhealthy(episode.final_observation) for episode in fallen)
    assert not any(unhealthy(row) for episode in episodes for row in episode.observations)
    assert not any(episode.terminated[:-1].any() for episode in episodes)
    cut = [episode for episode in episodes if not episode.terminated[-1]]
    assert cut  # environments start anew at each checkpoint
    assert not any(unhealthy(episode.final_observation) for episode in cut)


def test_an_episode_moves_as_one(episodes):
    """A step changes the torso's height by its velocity times the time step of 0.008 s."""
    for episode in episodes:
        seen = np.concatenate([episode.observations, episode.final_observation[None]])
        velocity = 0.5 * (seen[1:, 6] + seen[:-1, 6])
        np.testing.assert_allclose(np.diff(seen[:, 0]), 0.008 * velocity, atol=0.02)


def test_actions_are_as_executed(episodes):
    actions = np.concatenate([episode.actions for episode in episodes])
    assert actions.min() == -1.0
    assert actions.max() == 1.0


def test_a_policy_is_kept_for_each_evaluation(kept):
    policies = History(kept.folder).policies()
    assert sorted(policies) == [row["env_steps"] for row in kept.evaluations]
    observation = np.linspace(-1, 1, 11)
    np.testing.assert_array_equal(policies[max(policies)](observation), kept.policy(observation))
    assert (policies[0](observation) != kept.policy(observation)).any()


def test_a_run_that_was_cut_off_keeps_the_same(kept, tmp_path, small):
    out = tmp_path / "run"
    options = {"progress": False, "keep_history": True, **small}
    ppo_dap.train("Hopper-v5", "ppo", out=out, steps=1200, **options)
    # As after a kill in the second segment: the first checkpoint, and files of iterations that it does not know.
    for path in sorted((out / "history").glob("rollout-*.npz"))[3:5]:
        path.write_bytes(b"half of a fi")
    shutil.copy(out / "checkpoints" / "best.safetensors", out / "checkpoints" / "last.safetensors")
    (out / "policy.safetensors").unlink()
    ppo_dap.train("Hopper-v5", "ppo", out=out, steps=1200, resume=True, **options)
    for path in sorted((kept.folder / "history").iterdir()):
        assert path.read_bytes() == (out / "history" / path.name).read_bytes(), path.name


def test_nothing_is_kept_unasked(tmp_path, small):
    run = ppo_dap.train("Hopper-v5", "ppo", out=tmp_path / "run", steps=200, progress=False, **small)
    assert not (run.folder / "history").exists()
    assert json.loads((run.folder / "config.json").read_text())["config"]["keep_history"] is False
    for read in (lambda history: history.policies(), lambda history: history.episodes(1)):
        with pytest.raises(InputError, match="train with keep_history"):
            read(History(run.folder))


def test_thinning_is_even_over_time(episodes):
    total = sum(len(episode.rewards) for episode in episodes)
    assert thin(episodes, 10 * total) == episodes
    few = thin(episodes, total // 4)
    assert sum(len(episode.rewards) for episode in few) == pytest.approx(total / 4, abs=60)
    starts = np.cumsum([0, *(len(episode.rewards) for episode in episodes)])[:-1] / total
    chosen = [start for start, episode in zip(starts, episodes, strict=True) if any(episode is one for one in few)]
    # Of numbers spread evenly over 0 to 1 no quarter lacks its share.
    assert np.histogram(chosen, 4, (0, 1))[0].min() >= len(few) / 8
