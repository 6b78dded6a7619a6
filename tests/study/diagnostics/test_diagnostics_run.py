"""The diagnostics from end to end, on a run of a few iterations."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import ppo_dap
from ppo_dap.cli import main
from ppo_dap.dap.guidance import energy_weights
from ppo_dap.errors import InputError
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig
from ppo_dap.priors.prior import Prior
from ppo_dap.study.diagnostics.guided_run import load_guided
from ppo_dap.study.diagnostics.reliability_report import (
    FALLBACK,
    Pairs,
    describe_pairs,
    print_reliability,
    reliability,
    reliability_figure,
)
from ppo_dap.study.figures.proposals import high_q_shares, proposals_of
from test_docs import command_fault, commands

SMALL: Any = {
    "num_envs": 4, "rollout_steps": 128, "minibatch_size": 32, "num_epochs": 1, "hidden_size": 8, "q_hidden_size": 8,
    "num_proposals": 5, "sampler_steps": 3, "eval_episodes": 2, "eval_every": 128, "tensorboard": False, "steps": 384,
    "alpha_max": 5.0, "guidance_cap": 1.0, "pin_core": False,
}  # fmt: skip
QUICK: Any = {"states": 4, "rollouts": 2, "horizon": 6}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder with a prior, another one, a run, and what says that it is a run of plain PPO."""
    folder = tmp_path_factory.mktemp("made")
    logs, config = ppo_dap.load_logs("hopper-medium").select(range(6)), DiffusionConfig(width=8)
    moments = [jnp.asarray(x, jnp.float32) for x in (logs.observations.mean(0), logs.observations.std(0), 0.5)]
    denoiser = Denoiser.create(np.random.default_rng(0), config, moments[0], moments[1], moments[2], 3)
    one = np.ones(3, np.float32)
    probe = logs.observations[:8].astype(np.float32), logs.actions[:8].astype(np.float32)
    prior = Prior(denoiser, -one, one, "Hopper-v5", logs.hash(), {}, *probe)
    prior.save(folder / "prior")
    dataclasses.replace(prior, logs_hash="other").save(folder / "other")
    ppo_dap.fit_prior(logs, "retrieval", action_low=-1, action_high=1).save(folder / "retrieval")
    ppo_dap.train("Hopper-v5", "ppo-dap", prior=prior, out=folder / "run", progress=False, **SMALL)
    (folder / "plain").mkdir()
    description = json.loads((folder / "run" / "config.json").read_text()) | {"method": "ppo", "prior_hash": None}
    (folder / "plain" / "config.json").write_text(json.dumps(description))
    return folder


@pytest.fixture(autouse=True)
def without_video(monkeypatch):
    """Gymnasium's MuJoCo tasks import a video writer that need not be there: nothing here renders."""
    monkeypatch.setitem(sys.modules, "imageio", ModuleType("imageio"))


@pytest.fixture(scope="module")
def guided(made):
    return load_guided(made / "run", made / "prior")


@pytest.fixture(scope="module")
def observations():
    return ppo_dap.load_logs("hopper-medium").observations[:4].astype(np.float32)


def test_the_checkpoint_is_the_runs_end(made, guided, observations):
    assert guided.state.env_steps == guided.run.metrics[-1]["env_steps"]
    assert guided.policy(observations) == pytest.approx(guided.run.policy(observations), abs=1e-6)
    assert guided.scoring.reward_std == guided.state.reward_scale.std > 0


def test_q_reads_each_pair_on_its_own(guided, observations):
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 4, 3)).astype(np.float32)
    found = guided.q(observations, actions)
    assert found.shape == (4, 4)
    assert guided.q(observations[1:2], actions[1:2, 2:3])[0, 0] == pytest.approx(found[1, 2], abs=1e-6)
    assert np.ptp(found, axis=1).min() > 0


def test_candidates_belong_to_their_states_and_guidance_raises_their_q(guided, observations):
    steered, free = (guided.candidates(observations, on, seed=0) for on in (True, False))
    assert steered.shape == free.shape == (4, 5, 3)
    assert guided.q(observations, steered).mean() > guided.q(observations, free).mean()
    far = observations.copy()
    far[2] += 5.0
    moved = np.abs(guided.candidates(far, False, seed=0) - free).max((1, 2))
    assert moved.argmax() == 2
    assert np.delete(moved, 2).max() < 1e-4 < moved[2]


def test_proposals_of_a_run_are_taken_at_states_that_it_visits(made):
    rows = proposals_of(made / "run", made / "prior", states=6)
    assert [row["state"] for row in rows] == [i for i in range(6) for _ in range(2 * SMALL["num_proposals"])]
    for state in range(6):
        own = [row for row in rows if row["state"] == state]
        assert [sum(row["drawn"] for row in own if row["guided"] == kind) for kind in (0, 1)] == [5, 5]
        assert sum(row["q"] for row in own) == pytest.approx(0, abs=1e-2)
    shares = high_q_shares(rows)
    assert shares["no guidance"] == pytest.approx(0.2)  # one of five, as all differ
    assert shares["energy + gradient"] > shares["no guidance"]
    with pytest.raises(InputError, match="states 1 must be at least 2"):
        proposals_of(made / "run", made / "prior", states=1)


def test_energy_weights_are_eq_7s_with_the_runs_numbers(guided):
    q = np.random.default_rng(0).standard_normal((6, 5))
    wanted = np.exp(guided.beta * q / max(float(guided.guide.q_spread), 1e-6))
    assert guided.beta == 1.0
    assert guided.energy_weights(q) == pytest.approx(wanted / wanted.sum(1, keepdims=True), rel=1e-3, abs=1e-6)
    assert guided.energy_weights(q) == pytest.approx(
        np.asarray(energy_weights(jnp.asarray(q), jnp.asarray(1.0), guided.guide.q_spread, jnp.ones((6, 5), bool))),
        abs=1e-5,
    )
    chosen, drawn = guided.draw(np.eye(5)[[0, 1, 2, 3, 4, 0]].astype(np.float32), seed=0)
    assert (chosen == np.array([[0], [1], [2], [3], [4], [0]])).all()
    assert (drawn["ess"], drawn["acceptance"]) == pytest.approx((1.0, 0.2))


def test_the_report(made, guided, capsys, tmp_path):
    found = reliability(made / "run", made / "prior", **QUICK)
    report, pairs = found.report, found.pairs
    assert pairs.q.shape == pairs.g.shape == (4, 11)
    assert pairs.returns.shape == (4, 11, 2)
    assert report["monte_carlo"]
    assert report["weighting"]["largest_difference_by_advantage"] < 1e-4
    assert report["q"]["proposals"]["mae"] == pytest.approx(np.abs(pairs.q - pairs.g)[:, :5].mean())
    for name in ("rho", "mae", "bias"):  # Q - V is Q within a state
        assert report["advantage"]["all"][name] == pytest.approx(report["q"]["all"][name])
    weights = guided.energy_weights(pairs.q[:, :5])
    by_hand = np.mean([np.dot(w, g) for w, g in zip(weights, pairs.g[:, :5], strict=True)])
    assert report["returns"]["reweighted"] == pytest.approx(by_hand)
    best = [g[i] for i, g in zip(pairs.q[:, :5].argmax(1), pairs.g, strict=True)]
    assert report["returns"]["highest_q"] == pytest.approx(np.mean(best))
    assert report["returns"]["policy"] == pytest.approx(pairs.g[:, 10].mean())
    assert 1 <= report["weighting"]["ess"] <= 5
    options = ["--prior", str(made / "prior"), "--states", "4", "--rollouts", "2", "--horizon", "6"]
    figure = tmp_path / "q.png"
    assert main(["reliability", str(made / "run"), *options, "--png", str(figure), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["q"]["all"] == report["q"]["all"]  # the same seed, the same bits
    assert printed["returns"] == report["returns"]
    assert printed["q"]["policy"]["rho"] is None
    assert figure.read_bytes().startswith(b"\x89PNG")
    print_reliability(report)
    assert "one action a state" in capsys.readouterr().out


def test_a_task_that_cannot_be_restored_is_read_from_its_trajectory(made, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("ppo_dap.study.diagnostics.reliability_report.make_restorable", lambda *_: None)
    found = reliability(made / "run", made / "prior", **QUICK)
    assert not found.report["monte_carlo"]
    assert found.pairs.q.shape == (128, 1)
    assert found.report["q"]["all"]["rho_states"] == 0
    assert np.isfinite(found.report["q"]["all"]["rho_pooled"])
    print_reliability(found.report)
    assert FALLBACK in capsys.readouterr().out
    assert "returns" not in found.report
    assert 1 <= found.report["weighting"]["ess"] <= 5
    reliability_figure(found, tmp_path / "q.png")
    assert (tmp_path / "q.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("run", "prior", "options", "words"),
    [
        ("plain", "prior", {}, "a run of ppo: it has no Q head"),
        ("run", "other", {}, "fitted to other logs"),
        ("run", "retrieval", {}, "retrieval is of kind 'retrieval', .*run was trained with a diffusion prior"),
        ("run", "prior", {"states": 1}, "states 1 must be at least 2"),
        ("run", "prior", {"horizon": 0}, "horizon 0 must be at least 1"),
    ],
)
def test_what_cannot_work(made, run, prior, options, words):
    with pytest.raises(InputError, match=words):
        reliability(made / run, made / prior, **{**QUICK, **options})


def test_two_states_are_enough():
    q = np.arange(6.0).reshape(2, 3)
    pairs = Pairs(q, q[..., None] + 1, q.mean(1), {"policy": slice(2, 3)})
    found = describe_pairs(pairs)
    assert found["q"]["all"]["bias"] == pytest.approx(-1)
    assert found["q"]["policy"]["rho_states"] == 0
    assert np.isnan(found["rank_ceiling"]["all"])
    assert np.isfinite(found["calibration"]["isotonic"]["mae"])


def test_a_missing_checkpoint(made, tmp_path):
    shutil.copytree(made / "run", tmp_path / "run")
    (tmp_path / "run" / "checkpoints" / "best.safetensors").unlink()
    with pytest.raises(InputError, match="no checkpoint file"):
        load_guided(tmp_path / "run", made / "prior", "best")


def test_bound_of_a_real_run(made, capsys, tmp_path):
    figure = tmp_path / "bound.png"
    assert main(["bound", str(made / "run"), "--json", "--png", str(figure)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["reward_std"] == pytest.approx(load_guided(made / "run", made / "prior").scoring.reward_std)
    assert list(report["readings"]["evaluation"]["constants"]) == ["c1", "c2", "c3"]
    assert report["readings"]["evaluation"]["spans"] == 3
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_commands_in_the_document_parse():
    text = (Path(__file__).parents[3] / "docs" / "diagnostics.md").read_text()
    assert len(commands(text)) == 2
    assert [fault for line in commands(text) if (fault := command_fault(line))] == []


@pytest.mark.parametrize("name", ["q.jpg", "nowhere/q.png"])
def test_a_picture_that_cannot_be_written_is_told_first(made, name, tmp_path, capsys):
    assert main(["bound", str(made / "run"), "--png", str(tmp_path / name)]) == 2
    assert "png" in capsys.readouterr().err
