"""What a run takes from its task: the discount, unless the user sets one, and the short id."""

import pytest

import ppo_dap
from ppo_dap.training import run


@pytest.fixture
def resolved(monkeypatch, tmp_path):
    """`train` up to the trainer; returns the discount that the trainer gets, and discount and task as written down."""

    def configs(task, **options):
        seen = []

        class Trainer:
            def run(self):
                pass

        def make(config, spec, prior, condition, logs, folder, description, *rest):
            seen.append((config.ppo.gamma, description["config"]["gamma"], description["task"]))
            return Trainer()

        monkeypatch.setattr(run, "_make_trainer", make)
        ppo_dap.train(task, "ppo", out=tmp_path / "run", **options)
        return seen[0]

    return configs


@pytest.mark.parametrize("preset", ["paper", "tuned"])
@pytest.mark.parametrize(
    ("task", "options", "gamma"),
    [
        ("Swimmer-v5", {}, 0.9999),
        ("Swimmer-v5", {"gamma": 0.99}, 0.99),
        ("Swimmer-v5", {"gamma": 0.5}, 0.5),
        ("HalfCheetah-v5", {}, 0.99),
        ("HalfCheetah-v5", {"gamma": 0.5}, 0.5),
        ("Striker-v2", {}, 0.99),
        ("Pendulum-v1", {}, 0.99),
    ],
)
def test_the_discount_is_the_users_or_the_tasks_or_the_recipes(resolved, preset, task, options, gamma):
    assert resolved(task, preset=preset, **options)[:2] == (gamma, gamma)


@pytest.mark.parametrize("task", ["Striker-v2", "ppo_dap/Striker-v2"])
def test_a_run_of_striker_has_one_name_whatever_it_was_called(resolved, task):
    """Logs collected from it, and priors fitted to those, carry the name, and are compared by it."""
    assert resolved(task)[2] == "Striker-v2"
