"""The paper's numbers against each other: it prints many of them twice."""

import math

import pytest

from ppo_dap.study.tables.paper import _PRINTED, CLAIMS, printed, printed_change


def test_changes_that_the_paper_prints_are_those_of_its_means():
    """Tables 5 and 6 print both: a number that was copied wrongly would show."""
    checked = 0
    for (place, measure, task, arm), change in _PRINTED.items():
        metric, _, other = measure.partition(" over ")
        if measure == "change":
            metric, other = {"Table 5(a)": "alc", "Table 5(b)": "last_return"}[place], "PPO"
        if other and not math.isnan(change.value):
            of, base = (printed(place, metric, task, name).value for name in (arm, other))
            assert change.value == pytest.approx(of / base - 1, abs=6e-4), (place, measure, task, arm)
            checked += 1
    assert checked == 8 + 2 * 4 + 1 * 2 + 2 * 3


def test_table_4_of_the_paper_is_best_on_as_many_tasks_as_its_text_says():
    tasks = {task for place, _, task, _ in _PRINTED if place == "Table 4"}
    rivals = ("PPO", "PPO-DAP", "PPO-GC", "PPO-ARC", "ABPPO")
    best = sum(
        printed("Table 4", "last_return", task, "PPO-DAP").value
        >= max(printed("Table 4", "last_return", task, name).value for name in rivals)
        for task in tasks
    )
    assert (best, len(tasks)) == (CLAIMS["best"].low, 8)
    assert printed_change("Pusher-v5", "PPO-DAP") == pytest.approx(1.6 / 52.7)  # better, though the returns are below 0
    assert math.isnan(printed("Table 4", "last_return", "Ant-v5", "No-PET").value)
