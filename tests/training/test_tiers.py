"""Tiers of logs: which policy made what, held against the behaviour run's own records."""

import json

import minari
import numpy as np
import pytest

import ppo_dap
from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.logs.card import card_text, describe_logs
from ppo_dap.training import tiers

TASK, ROWS, STEPS, SEED = "InvertedPendulum-v5", 600, 6000, 7


FOLDER = "invertedpendulum-v5"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """All tiers of one task, by one command."""
    folder = tmp_path_factory.mktemp("logs")
    names = [part for tier in tiers.TIERS for part in ("--tier", tier)]
    sizes = ["--steps", str(ROWS), "--train-steps", str(STEPS), "--seed", str(SEED)]
    assert main(["collect", "--task", TASK, *names, *sizes, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def behaviour(store):
    return ppo_dap.load_run(store / "behaviours" / f"{TASK}-ppo-{STEPS}-{SEED}")


def card(store, tier):
    return json.loads((store / FOLDER / f"{tier}-v0" / "card.json").read_text())


def evaluations(run):
    return {row["env_steps"]: row["return_mean"] for row in run.evaluations}


@pytest.mark.parametrize("tier", tiers.TIERS)
def test_a_tier_is_what_its_card_says(store, tier):
    folder, about = store / FOLDER / f"{tier}-v0", card(store, tier)
    logs = ppo_dap.load_logs(folder)
    assert logs.hash() == about["sha256"]
    assert logs.task == TASK
    assert logs.num_rows == about["rows"] >= (0.8 * ROWS if tier == "medium-replay" else ROWS)
    returns = np.array([logs.rewards[rows].sum(dtype=np.float64) for rows in logs.episode_slices()])
    assert about["returns"]["mean"] == pytest.approx(returns.mean(), abs=1e-2)
    assert sum(about["returns"]["histogram"]["episodes"]) == logs.num_episodes == len(returns)
    assert about["actions"]["at_bound"][0] == pytest.approx(np.mean(np.abs(logs.actions[:, 0]) == 3), abs=1e-4)
    assert f"--tier {tier} " in about["command"]
    assert about["versions"]["envpool"]
    text = (folder / "README.md").read_text()
    assert about["sha256"] in text
    assert about["command"] in text
    assert text.count("#") > 10  # the histogram has bars


def test_random_is_the_policy_before_any_update(store, behaviour):
    (policy,) = card(store, "random")["policies"]
    assert policy["at_step"] == 0
    assert policy["return"] == behaviour.evaluations[0]["return_mean"]


def test_medium_is_the_first_a_third_of_the_way(store, behaviour):
    (policy,) = card(store, "medium")["policies"]
    returns = evaluations(behaviour)
    best, first = max(returns.values()), returns[0]
    assert (returns[policy["at_step"]] - first) / (best - first) >= 1 / 3
    assert all((value - first) / (best - first) < 1 / 3 for at, value in returns.items() if at < policy["at_step"])


def test_expert_is_the_best(store, behaviour):
    (policy,) = card(store, "expert")["policies"]
    assert policy["return"] == max(evaluations(behaviour).values())


def test_medium_expert_is_half_of_each(store):
    whole = ppo_dap.load_logs(store / FOLDER / "medium-expert-v0")
    medium = ppo_dap.load_logs(store / FOLDER / "medium-v0")
    # The first half has the seed of medium's own logs, so it begins as they do.
    first = whole.episode_lengths()[0]
    np.testing.assert_array_equal(whole.observations[:first], medium.observations[:first])
    assert [policy["at_step"] for policy in card(store, "medium-expert")["policies"]] == [
        card(store, tier)["policies"][0]["at_step"] for tier in ("medium", "expert")
    ]


def test_medium_replay_is_of_the_training_before_medium(store, behaviour):
    logs = ppo_dap.load_logs(store / FOLDER / "medium-replay-v0")
    until = card(store, "medium")["policies"][0]["at_step"]
    paths = sorted((behaviour.folder / "history").glob("rollout-*.npz"))
    stepped = np.cumsum([np.load(path)["valid"].sum() for path in paths])
    early = [np.load(path) for path, steps in zip(paths, stepped, strict=True) if steps <= until]
    seen = {row.tobytes() for file in early for row in file["observations"].reshape(-1, logs.observation_size)}
    assert all(row.tobytes() in seen for row in np.asarray(logs.observations))


def test_mixed_is_of_three_runs(store):
    assert [policy["seed"] for policy in card(store, "mixed")["policies"]] == [SEED, SEED + 1, SEED + 2]
    assert len({policy["return"] for policy in card(store, "mixed")["policies"]}) == 3


def test_minari_opens_it_with_the_true_last_observations(store):
    dataset = minari.MinariDataset(store / FOLDER / "expert-v0" / "data")
    for episode in dataset.iterate_episodes():
        last = episode.observations[-1]
        # The task's own rule for when an episode ends.
        assert bool(episode.terminations[-1]) == (abs(last[1]) > 0.2)
        assert (np.abs(episode.observations[:-1, 1]) <= 0.2).all()
    assert dataset.recover_environment().spec.id == TASK


def test_what_is_there_stays(store, capsys):
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()}
    sizes = ["--steps", str(ROWS), "--train-steps", str(STEPS), "--seed", str(SEED)]
    assert main(["collect", "--task", TASK, "--tier", "mixed", *sizes, "--out", str(store), "--json"]) == 0
    out = capsys.readouterr()
    assert json.loads(out.out)[0]["sha256"] == card(store, "mixed")["sha256"]
    assert "about 0 min" in out.err
    assert before == {path: path.stat().st_mtime_ns for path in store.rglob("*") if path.is_file()}


def test_other_logs_do_not_go_where_some_are(store):
    with pytest.raises(InputError, match=f"was made by .*--steps {ROWS} "):
        tiers.make_tier(TASK, "medium", ROWS + 1, SEED, STEPS, store)


def test_a_dataset_without_its_card_is_made_again(store):
    folder = store / FOLDER / "random-v0"
    before = card(store, "random")
    (folder / "card.json").unlink()
    (folder / "data" / "main_data.hdf5").write_bytes(b"half of it")
    tiers.make_tier(TASK, "random", ROWS, SEED, STEPS, store)
    assert card(store, "random")["sha256"] == before["sha256"] == ppo_dap.load_logs(folder).hash()


def test_the_estimate_counts_what_is_missing(store, tmp_path, monkeypatch):
    monkeypatch.setattr(tiers, "speed_of", lambda task: 1000.0)
    monkeypatch.setattr(tiers, "TRAINING_SHARE", 0.5)

    def seconds(*names):
        return tiers.estimate(TASK, names, 10_000, SEED, 10**6, tmp_path)

    assert seconds("medium") == 10**6 / 500 + 10_000 / 1000
    assert seconds("medium", "medium-replay") == seconds("medium")  # a replay is not stepped again
    assert seconds("mixed") == 3 * 10**6 / 500 + 10_000 / 1000
    assert tiers.estimate(TASK, list(tiers.TIERS), ROWS, SEED, STEPS, store) == 0


def test_tasks_that_gymnasium_does_not_know_get_logs_too(store, tmp_path):
    episodes, _ = tiers.tier_episodes("random", 100, SEED, [tiers.behave(TASK, SEED, STEPS, store / "behaviours")])
    made = {"tier": "random", "meaning": "m", "policies": [], "command": "c", "versions": {}}
    sizes = {"observations": 23, "actions": 7}
    empty = [
        episode._replace(
            **{name: np.zeros((len(episode.rewards), size), np.float32) for name, size in sizes.items()},
            final_observation=np.zeros(23, np.float32),
        )
        for episode in episodes
    ]
    tiers._write("Striker-v2", empty, made, tmp_path, 0.0, 0.0)
    logs = ppo_dap.load_logs(tmp_path / "striker-v2" / "random-v0")
    assert logs.task == "Striker-v2"
    assert logs.hash() == json.loads((tmp_path / "striker-v2" / "random-v0" / "card.json").read_text())["sha256"]


def test_python_is_told_of_unknown_tiers_too(tmp_path):
    with pytest.raises(InputError, match="unknown tier 'good'"):
        tiers.make_tier(TASK, "good", ROWS, SEED, STEPS, tmp_path)


def test_a_run_that_learned_nothing_makes_no_tier(store):
    behaviour = tiers.behave(TASK, SEED, STEPS, store / "behaviours")
    behaviour.__dict__["returns"] = dict.fromkeys(behaviour.returns, 1.0)
    with pytest.raises(InputError, match=f"better than its first: {STEPS} steps are too few"):
        tiers.tier_episodes("medium", ROWS, SEED, [behaviour])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tier", "good", "--task", TASK], "tier 'good'"),
        (["--all", "--task", TASK], "leave --task and --tier out"),
        ([], "nothing to log"),
        (["run", "--all"], "is logged as it is"),
        (["--task", "Hoper-v5"], "Hopper"),
    ],
)
def test_what_collect_cannot_do_is_said(arguments, message, tmp_path, capsys):
    assert main(["collect", *arguments, "--out", str(tmp_path / "logs")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_a_card_is_readable(store):
    logs = ppo_dap.load_logs("hopper-medium")
    policies = [{"seed": 0, "train_steps": 10, "at_step": 5, "return": 1.0}]
    made = {"meaning": "a meaning", "policies": policies, "versions": {"jax": "1"}, "command": "c"}
    lines = card_text("x/y-v0", describe_logs(logs) | made).splitlines()
    bars = [line for line in lines if " to " in line and not line.startswith("-")]
    assert len(bars) == 10
    assert max(line.count("#") for line in bars) == 40
    assert max(map(len, lines)) < 160
