"""The declared studies, against what the paper's tables and figures show; and the command that runs them."""

import functools
import itertools
import json
import re

import pytest

from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.methods import METHODS
from ppo_dap.study.store import supervise
from ppo_dap.study.store.grids import Scale
from ppo_dap.study.store.studies import SMOKE, STUDIES, make_study, only
from ppo_dap.tasks import CATALOGUE
from study.store.store_made import COMMAND, base, study

D4RL = {("Walker2d-v5", "medium-expert"), ("HalfCheetah-v5", "medium-replay"), ("Hopper-v5", "medium-expert")}
FOUR = D4RL | {("HumanoidStandup-v5", "medium-expert")}


@pytest.fixture(scope="module")
def every():
    return {name: make_study(name) for name in STUDIES}


def _settings(grid, part):
    return {(e.labels["task"], e.labels["logs"]) for e in grid.entries if e.labels["part"] == part}


def _runs(grid, **labels):
    return [e for e in grid.entries if all(e.labels.get(k) == v for k, v in labels.items())]


def test_table_4_is_eight_tasks_by_the_methods_of_the_paper(every):
    table = every["table4"]
    assert {e.labels["task"] for e in table.entries} == set(CATALOGUE)
    methods = {e.labels["method"] for e in table.entries}
    assert methods == {"ppo", "ppo-dap", "ppo-gc", "ppo-arc", "ppo-abppo"}
    for task, method in itertools.product(CATALOGUE, methods):
        found = _runs(table, task=task, method=method, preset="paper")
        assert {e.labels["seed"] for e in found} >= {0, 1, 2}
        assert {e.cell.settings["steps"] for e in found} == {1_000_000}
    for preset in ("tuned", "tuned-warm"):
        assert len(_runs(table, method="ppo-dap", preset=preset, task="Ant-v5")) == 3


def test_table_5_is_four_settings_with_seeds_for_a_claim(every):
    table = every["table5"]
    assert _settings(table, "early") == _settings(table, "full") == FOUR
    arms = {"PPO", "PPO + BC", "PPO-DAP", "PPO-DAP (tuned)", "PPO-DAP (tuned-warm)"}
    for (task, _), arm in itertools.product(FOUR, arms):
        found = _runs(table, task=task, arm=arm, part="early")
        assert [e.labels["seed"] for e in found] == list(range(8))
        assert {e.cell.settings["steps"] for e in found} == {200_000}
    assert table.epochs == 40


def test_the_axes_are_those_of_the_paper(every):
    def axis(name, label):
        return {e.labels[label] for e in every[name].entries if label in e.labels}

    assert axis("table6", "f") == axis("fig10", "f") == {0, 5, 10, 20}
    assert axis("fig9", "K") >= {5, 10, 20}
    assert axis("fig12", "coverage") == {"wide", "medium", "narrow"}
    assert axis("ablation", "prior") == {"none", "flow", "diffusion"}
    assert axis("ablation", "guidance") == {"none", "energy", "energy+gradient"}
    assert {e.labels["f"] for e in every["ablation"].entries if e.labels.get("prior") == "diffusion"} == {0, 10, 20}
    assert _settings(every["ablation"], "early") == _settings(every["fig9"], "early") == D4RL
    methods = {e.labels["method"] for e in every["table7"].entries}
    assert methods == {"ppo", "ppo-bc", "ppo-dap", "ppo-dap-no-vg", "ppo-dap-no-pet", "ppo-vae"}
    assert {e.labels["logs"] for e in every["mixed"].entries} == {"mixed"}
    assert {e.labels["method"] for e in every["mixed"].entries} == set(METHODS)
    assert {"report"} < {e.labels["part"] for e in every["reliability"].entries}


def test_each_part_of_the_warm_start_is_one_setting_away(every):
    whole, *_ = _runs(every["mixed"], arm="PPO-DAP (tuned-warm)", task="Hopper-v5", seed=0)
    parts = [e for e in _runs(every["mixed"], task="Hopper-v5", seed=0) if "(tuned-warm): " in e.labels["arm"]]
    away = {}
    for entry in parts:
        differ = {k for k, v in entry.cell.settings.items() if whole.cell.settings[k] != v}
        before = whole.cell.needs["prior"].settings
        fitted = {k for k, v in entry.cell.needs["prior"].settings.items() if before[k] != v}
        away[entry.labels["arm"].split(": ")[1]] = differ | fitted
    assert away["no guidance"] == {"guidance"}
    assert away["no PET"] == {"pet_frequency"}
    assert away["V not started"] == away["nothing started"] == {"warm_start"}
    assert away["all logs"] == {"logs_filter"}
    assert away["mode-seeking imitation"] == away["imitation beside the KL"] | {"mode_seeking"}
    assert all(away.values())


def test_names_can_be_chosen_by_from_a_list_with_commas(every):
    assert not [v for grid in every.values() for e in grid.entries for v in map(str, e.labels.values()) if "," in v]


def test_labels_say_what_the_cell_is(every):
    for grid in every.values():
        for entry in grid.entries:
            cell, labels = entry.cell, entry.labels
            run = cell.needs["run"] if cell.kind == "reliability" else cell
            for name in ("task", "method", "preset", "seed", "steps"):
                assert run.settings[name] == labels[name]
            if "f" in labels and labels.get("prior") != "none":
                assert run.settings["pet_frequency"] == labels["f"]
            if "K" in labels:
                assert run.settings["num_proposals"] == labels["K"]
            if "share" in labels:
                assert run.settings["proposal_fraction"] == labels["share"]
            if labels.get("prior") in ("flow", "diffusion"):
                assert run.needs["prior"].settings["kind"] == labels["prior"]
                assert run.settings["guidance"] == labels["guidance"]
            if "coverage" in labels:
                assert run.needs["prior"].settings["coverage"] == labels["coverage"]
            if "prior" in run.needs:
                assert run.needs["prior"].needs["logs"].settings["tier"] == labels["logs"]


def test_studies_share_cells(every):
    def runs(name):
        return {e.cell for e in every[name].entries}

    assert runs("fig6") <= runs("table5") & runs("table4")
    assert runs("fig8") == runs("table7")
    assert runs("fig12") < runs("coverage")
    assert runs("fig7") <= runs("table4") | runs("table5")
    assert {e.cell for e in _runs(every["fig9"], K=10)} & {e.cell for e in _runs(every["table5"], arm="PPO-DAP")}
    assert runs("fig11") < runs("table7")
    assert len(set().union(*map(runs, every))) < sum(len(grid.entries) for grid in every.values()) * 0.7


def test_no_run_has_the_seed_of_a_behaviour(every):
    for grid in every.values():
        seeds = {cell.kind: set() for cell in grid.cells()}
        for cell in grid.cells():
            seeds[cell.kind].add(cell.settings["seed"])
        assert not seeds["run"] & seeds["behaviour"]


def test_the_first_seed_of_all_comes_before_the_second(every):
    seeds = [cell.settings["seed"] for cell in every["table5"].cells() if cell.kind == "run"]
    assert seeds == sorted(seeds)


def test_smoke_is_a_tiny_version_of_all(every):
    tiny = make_study("smoke")
    assert {e.labels["study"] for e in tiny.entries} == set(STUDIES)
    runs = [cell for cell in tiny.cells() if cell.kind == "run"]
    assert len(tiny.cells()) < 48
    assert max(cell.settings["steps"] for cell in runs) < 1000
    assert {cell.kind for cell in tiny.cells()} == {"behaviour", "logs", "prior", "run", "reliability"}
    large = {e.labels["method"] for grid in every.values() for e in grid.entries}
    assert {e.labels["method"] for e in tiny.entries} >= large - {
        "ppo-dap-aux-only",
        "ppo-behavior-kl",
        "ppo-retrieval",
    }


@pytest.mark.parametrize("name", [*STUDIES, "smoke"])
def test_a_dry_run_lists_every_cell_and_does_nothing(name, tmp_path, monkeypatch, capsys, every):
    monkeypatch.setattr("ppo_dap.commands.studies._speed", lambda task: 10_000.0)
    assert main(["study", name, "--store", str(tmp_path / "store"), "--dry-run"]) == 0
    told = capsys.readouterr().out
    expected = make_study(name) if name == "smoke" else every[name]
    assert re.findall(r"^([0-9a-f]{16})  -  ", told, re.MULTILINE) == [cell.name for cell in expected.cells()]
    assert re.search(r"to come: \d+ cells, [\d.]+ h on one core.* GB of disk, \d+ GB are free", told)
    assert not (tmp_path / "store").exists()


def test_a_dry_run_as_json_and_with_choices(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ppo_dap.commands.studies._speed", lambda task: 10_000.0)
    options = ["--store", str(tmp_path), "--seeds", "3,5-6", "--steps", "50000", "--only", "task=Hopper-v5"]
    assert main(["study", "fig7", *options, "--only", "arm=PPO", "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["cells"] == 3
    assert told["done"] == 0
    assert [cell["settings"]["seed"] for cell in told["list"]] == [3, 5, 6]
    assert {cell["settings"]["steps"] for cell in told["list"]} == {50_000}
    # 50,000 steps at 0.7 of 10,000 a second
    assert told["seconds"] == pytest.approx(3 * (50_000 / 7_000 + 8))
    assert make_study("fig7", steps=50_000).epochs == 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tabel5"], "unknown study 'tabel5': did you mean 'table5'?"),
        (["table5", "--seeds", "7-0"], "argument --seeds: must be seeds such as 0-7 or 0,2,5, not '7-0'"),
        (["table5", "--seeds", "a"], "must be seeds such as 0-7 or 0,2,5, not 'a'"),
        (["table5", "--seeds", "1,0-2"], "must name each seed once, not '1,0-2'"),
        (["table5", "--steps", "0"], "must be a whole number above 0, not '0'"),
        (["table5", "--workers", "none"], "must be a whole number above 0, not 'none'"),
        (["table5", "--only", "arm"], "must be LABEL=VALUE,VALUE,..., not 'arm'"),
        (["fig6", "--only", "arms=PPO"], "unknown label 'arms': did you mean 'arm'?"),
        (["fig6", "--only", "arm=PPO-DPA"], "unknown arm in study fig6 'PPO-DPA': did you mean 'PPO-DAP'?"),
        (["fig6", "--json"], "--json prints the plan: use it with --dry-run"),
        (["fig6", "--store", "file"], "store file is a file: name a folder"),
        (["fig6", "--store", "other"], "store other is a folder with other files in it"),
    ],
)
def test_bad_input_is_told_in_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    assert main(["study", *arguments]) == 2
    told = capsys.readouterr().err
    assert message.removeprefix("argument ") in told
    assert len(told.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "other"]


def test_choices_that_leave_nothing_are_told():
    with pytest.raises(InputError, match="no run of study table5 has all of"):
        only(make_study("table5"), {"part": ["full"], "seed": ["7"]})


@pytest.fixture
def one_cell(monkeypatch):
    """Adds a study `one` whose only cell is a stub with the given settings."""

    def declare(**how):
        def one(scale):
            """A stub."""
            return study(base(**how)).entries

        monkeypatch.setitem(STUDIES, "one", one)

    monkeypatch.setattr(supervise, "Supervisor", functools.partial(supervise.Supervisor, command=COMMAND, poll=0.05))
    return declare


def test_the_exit_code_tells_whether_all_is_there(one_cell, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ppo_dap.commands.studies._speed", lambda task: 10_000.0)
    one_cell(fails=True)
    assert main(["study", "one", "--store", str(tmp_path)]) == 1
    assert "failed: behaviour of Hopper-v5, seed 0, 5 steps: ValueError: by anyone" in capsys.readouterr().out
    one_cell()
    assert main(["study", "one", "--store", str(tmp_path)]) == 0
    assert "one: 1 of 1 cells are there" in capsys.readouterr().out


def test_a_store_that_cannot_be_written_is_told_in_one_line(one_cell, tmp_path, monkeypatch, capsys):
    def refuse(self, cell):
        raise PermissionError(13, "Permission denied", str(self.folder(cell)))

    monkeypatch.setattr("ppo_dap.commands.studies._speed", lambda task: 10_000.0)
    monkeypatch.setattr("ppo_dap.study.store.store.Store.prepare", refuse)
    one_cell()
    assert main(["study", "one", "--store", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert "Permission denied" in told
    assert len(told.splitlines()) == 1


def test_scales_are_what_they_say():
    assert SMOKE.epochs < 1
    assert Scale().epochs == 40
    assert Scale(early_steps=100_000).epochs == 20
