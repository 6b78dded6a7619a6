"""The benchmark's arithmetic on hand-made rows; how fast anything is is no test's business."""

import pytest

from ppo_dap.cli import main
from ppo_dap.study.bench import sweep
from ppo_dap.study.bench.bench import audit_share, print_bench, speed

ROWS = [
    {"env_steps": 100, "seconds_iteration": 50.0, "seconds_audit": 40.0, "seconds_recording": 5.0},
    {"env_steps": 200, "seconds_iteration": 2.0, "seconds_audit": 0.1, "seconds_recording": 0.02},
    {"env_steps": 290, "seconds_iteration": 1.0, "seconds_audit": 0.05, "seconds_recording": 0.01},
]


def test_the_iteration_that_compiles_counts_neither_as_steps_nor_as_time():
    assert speed(ROWS) == pytest.approx(190 / 3)
    assert audit_share(ROWS) == pytest.approx(0.18 / 3)


def test_the_table_has_every_figure_of_every_task(capsys):
    figures = {"dap_wall_x_ppo": 1.0625, "steps_per_second": {"ppo": 12_345.0}}
    machine = {"processor": "a processor", "cores": 2, "python": "3.11", "versions": {"jax": "0"}, "seconds": 10.0}
    made = {"tasks": {"A-v5": figures, "B-v5": {**figures}}, "command": "ppo-dap bench"}
    print_bench(made | {"machine": machine | {"device": "cpu"}})
    printed = capsys.readouterr().out
    for part in ("A-v5", "B-v5", "1.062", "12,345", "a processor, 2 cores; Python", "jax 0", "ppo-dap bench"):
        assert part in printed
    print_bench(made | {"machine": machine | {"device": "a GPU"}})
    assert "a processor, 2 cores, a GPU; Python" in capsys.readouterr().out


def test_the_figure_of_a_sweep_is_drawn(tmp_path):
    costs = {"proposals": 1.0, "pet": 2.0, "audit": 0.5}
    knobs = [*sweep.KNOBS, "action dimensions"]
    rows = [{"knob": knob, "value": value} | costs for knob in knobs for value in (1, 2)]
    sweep.draw(rows, tmp_path / "cost.png")
    assert (tmp_path / "cost.png").read_bytes().startswith(b"\x89PNG")


def test_peers_that_are_not_there_are_told_at_once(capsys):
    assert main(["bench", "--peers", "nowhere/python"]) == 2
    assert "`make bench-peers` makes one" in capsys.readouterr().err
    assert main(["bench", "--task", "Wlaker2d-v5"]) == 2
    assert "Walker2d-v5" in capsys.readouterr().err
