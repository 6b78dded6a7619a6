"""Names of cells: stable, and different for everything that can make a difference."""

import dataclasses
import json
import os
import subprocess
import sys
from typing import Any

import pytest

from ppo_dap import config as configs
from ppo_dap.config import Config
from ppo_dap.errors import InputError
from ppo_dap.prior_config import FITTED, PRIOR_CONFIGS
from ppo_dap.study.store import cells
from ppo_dap.study.store.cells import Cell
from ppo_dap.training import tiers

LOGS = cells.logs("Hopper-v5", "medium-expert", 1000, 100, 5000)
PRIOR = cells.prior(LOGS)


def test_names_are_what_they_were():
    """Written down: a store that was made before is found again."""
    assert cells.behaviour("Hopper-v5", 0, 1000).name == "08443e4e16d69b46"
    assert LOGS.name == "185bf19310656537"
    assert PRIOR.name == "6893b57a90a9b0f7"
    assert cells.run("Hopper-v5", "ppo", seed=3).name == "1eea179fd99aec69"
    assert cells.run("Hopper-v5", "ppo-dap", "tuned", prior=PRIOR).name == "8fc0ee6573be0fb4"


def test_names_do_not_depend_on_the_process():
    code = "from ppo_dap.study.store import cells; print(cells.run('Hopper-v5', 'ppo', seed=3, gamma=0.5).name)"
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": s}, capture_output=True, text=True
        ).stdout
        for s in ("1", "2")
    }
    assert found == {cells.run("Hopper-v5", "ppo", gamma=0.5, seed=3).name + "\n"}


def _changed(cell):
    """The same cell with each of its settings changed in turn, by the setting's name."""
    return {
        name: dataclasses.replace(cell, settings={**cell.settings, name: "something else"}).name
        for name in cell.settings
    }


@pytest.mark.parametrize(
    ("cell", "config"),
    [
        (cells.run("Hopper-v5", "ppo-dap", prior=PRIOR), configs.flatten(Config())),
        (cells.run("Swimmer-v5", "ppo", "tuned"), configs.flatten(Config())),
        *((cells.prior(LOGS, kind), dataclasses.asdict(PRIOR_CONFIGS[kind]())) for kind in FITTED),
        (LOGS, ("task", "tier", "rows", "seed", "steps")),
        (cells.behaviour("Hopper-v5", 0, 10), ("task", "seed", "steps")),
    ],
)
def test_every_setting_is_in_the_name(cell, config):
    names = _changed(cell)
    assert set(config) <= set(names)
    assert len({cell.name, *names.values()}) == 1 + len(names)


def test_a_limit_that_a_run_does_not_reach_is_not_in_its_name():
    def name(**options):
        return cells.run("Hopper-v5", "ppo-dap", prior=PRIOR, **options).name

    half = {"lambda_decay": 0.5}
    assert name(steps=2000, lambda_decay_steps=1000, **half) == name(steps=2000, **half)
    assert name(steps=2001, lambda_decay_steps=1000, **half) != name(steps=2001, **half)
    assert name(steps=2000, lambda_decay_steps=1000) != name(steps=2000)  # nothing else ends the decay
    limit = {"lambda_decay_steps": 1000, **half}
    assert name(steps=2000, std_after=1.0, **limit) == name(steps=2000, **limit)
    assert name(steps=2001, std_after=1.0, **limit) != name(steps=2001, **limit)


def test_a_setting_that_is_not_in_the_name_is_found():
    """The planted fault of the test above: two defaults for one setting."""
    cell = cells.run("Hopper-v5", "ppo")
    blind = dataclasses.replace(cell, settings={**cell.settings, "gamma": 0.5}, defaults={"gamma": 0.5})
    other = dataclasses.replace(cell, settings={**cell.settings, "gamma": 0.9}, defaults={"gamma": 0.9})
    assert blind.name == other.name


def test_everything_else_is_in_the_name_of_a_run():
    warm: dict[str, Any] = {"prior": PRIOR, "logs": LOGS, "warm_start": "actor"}
    other_logs: Any = cells.logs("Hopper-v5", "medium", 1000, 100, 5000)
    found = [
        cells.run("Hopper-v5", "ppo-dap", prior=PRIOR),
        cells.run("Hopper-v5", "ppo-dap", prior=PRIOR, seed=1),
        cells.run("Hopper-v5", "ppo-dap", prior=PRIOR, steps=5),
        cells.run("Hopper-v5", "ppo-dap-no-pet", prior=PRIOR),
        cells.run("Hopper-v5", "ppo-dap", "tuned", prior=PRIOR),
        cells.run("Walker2d-v5", "ppo-dap", prior=PRIOR),
        cells.run("Hopper-v5", "ppo-dap", prior="random"),
        cells.run("Hopper-v5", "ppo-dap", prior=cells.prior(LOGS, seed=1)),
        cells.run("Hopper-v5", "ppo-dap", prior=cells.prior(LOGS, coverage="narrow")),
        cells.run("Hopper-v5", "ppo-dap", prior=cells.prior(LOGS, coverage="narrow", coverage_fraction=0.2)),
        cells.run("Hopper-v5", "ppo-dap", prior=cells.prior(LOGS, logs_filter=0.5)),
        cells.run("Hopper-v5", "ppo-dap", prior=cells.prior(other_logs)),
        cells.run("Hopper-v5", "ppo-dap", **warm),
        cells.run("Hopper-v5", "ppo-dap", **warm | {"logs": other_logs}),
    ]
    assert len({cell.name for cell in found}) == len(found)
    assert cells.run("Hopper-v5", "ppo", gamma=0.99) == cells.run("Hopper-v5", "ppo")  # given or not, it is the same


@pytest.mark.parametrize("changed", ["task", "tier", "rows", "seed", "steps"])
def test_every_setting_of_logs_is_in_their_name(changed):
    given = {"task": "Hopper-v5", "tier": "medium", "rows": 1000, "seed": 100, "steps": 5000}
    other = {"task": "Walker2d-v5", "tier": "expert", "rows": 2000, "seed": 101, "steps": 6000}
    assert cells.logs(**given | {changed: other[changed]}).name != cells.logs(**given).name


def test_a_setting_that_a_later_version_adds_leaves_names_as_they_are():
    old = Cell("run", {"task": "a", "steps": 5}, {}, {"steps": 1})
    new = Cell("run", {"task": "a", "steps": 5, "novelty": 0}, {}, {"steps": 1, "novelty": 0})
    assert old.name == new.name
    assert new.name != Cell("run", {"task": "a", "steps": 5, "novelty": 1}, {}, {"steps": 1, "novelty": 0}).name


def test_settings_are_those_that_training_resolves(tmp_path):
    import ppo_dap

    small: dict[str, Any] = {
        "num_envs": 4,
        "rollout_steps": 128,
        "minibatch_size": 32,
        "steps": 128,
        "eval_episodes": 1,
    }
    planned = cells.run("Pendulum-v1", "ppo", "tuned", **small)
    made = ppo_dap.train("Pendulum-v1", "ppo", preset="tuned", out=tmp_path / "run", progress=False, **small)
    stored = made.config["config"]
    assert {name: planned.settings[name] for name in stored} == stored
    assert planned.settings["task"] == made.config["task"]


def test_tiers_are_those_of_the_logs():
    for tier in tiers.TIERS:
        assert len(cells.logs("Hopper-v5", tier, 10, 0, 10).needs) == tiers.runs_needed(tier)
    with pytest.raises(InputError, match=r"unknown tier 'medium-ex'.*medium-expert"):
        cells.logs("Hopper-v5", "medium-ex", 10, 0, 10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "ppo", "prior": PRIOR}, "takes a prior of kind 'none'"),
        ({"method": "ppo-dap"}, "takes a prior of kind 'diffusion', not None"),
        ({"method": "ppo-flow", "prior": PRIOR}, "takes a prior of kind 'flow', not 'diffusion'"),
        ({"method": "ppo-bc"}, "warm_start 'actor' .* no logs"),
        ({"method": "ppo", "logs": LOGS}, "warm_start 'none' .* logs"),
        ({"method": "ppo", "seed": -1}, "seed must be"),
        ({"method": "ppo", "steps": 0}, "steps must be"),
        ({"method": "ppo", "stepps": 5}, "unknown option 'stepps'"),
    ],
)
def test_a_run_that_cannot_be_is_told(arguments, message):
    with pytest.raises(InputError, match=message):
        cells.run("Hopper-v5", **arguments)


def test_a_cell_comes_after_what_it_needs():
    run = cells.run("Hopper-v5", "ppo-dap", prior=PRIOR, logs=LOGS, warm_start="actor")
    found = cells.in_order([cells.reliability(run, 4, 2), run, cells.run("Hopper-v5", "ppo")])
    assert [cell.kind for cell in found] == ["behaviour", "logs", "prior", "run", "reliability", "run"]


def test_a_description_is_json_and_whole():
    run = cells.run("Hopper-v5", "ppo-dap", prior=PRIOR, seed=1)
    told = json.loads(json.dumps(run.description()))
    assert told["needs"] == {"prior": PRIOR.name}
    assert told["settings"]["seed"] == 1
    assert told["settings"]["gamma"] == 0.99
    assert told["call"] == {"seed": 1}
