import re
from pathlib import Path

import numpy as np
import pytest

from logs.logs_made import level, make_logs, message
from ppo_dap.errors import InputError
from ppo_dap.logs import Finding, Logs, LogsWarning, Report, check_logs, load_logs, require_compatible
from ppo_dap.logs.check_columns import _row_keys, check_duplicated_rows

LOW, HIGH = np.full(2, -1.0, np.float32), np.ones(2, np.float32)


def policy_logs(rows=1000, **changes):
    """Episodes of one noisy linear policy on independent states."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(rows, 3))
    arrays = {
        "observations": states,
        "actions": np.clip(states[:, :2] @ [[0.3, -0.2], [0.1, 0.4]] + 0.1 * rng.normal(size=(rows, 2)), -1, 1),
        "episode_ends": np.arange(rows) % 100 == 99,
    }
    return Logs(**{**arrays, **changes})


def test_good_logs_are_ok_and_readable():
    report = check_logs(policy_logs(rewards=np.ones(1000)), 3, LOW, HIGH)
    assert report.exit_code == 0
    assert {line.level for line in report.lines} == {"ok"}
    assert message(report, "episodes") == "10, length min 100, median 100, max 100"
    assert message(report, "returns") == "min 100, median 100, max 100"
    lines = str(report).split("\n")
    assert len(lines) == len(report.lines)
    assert lines[1].split() == ["ok", "dimensions", "1000", "rows,", "3", "observations", "and", "2", "actions"]


def test_exit_code_is_that_of_the_worst_finding():
    findings = [Finding(level, "a", "b") for level in ("ok", "warning", "error")]
    assert [Report(tuple(findings[:n])).exit_code for n in range(4)] == [0, 0, 1, 2]


def test_wrong_dimensions_are_an_error():
    report = check_logs(policy_logs(), 11, np.full(3, -1, np.float32), np.ones(3, np.float32))
    assert report.exit_code == 2
    expected = "observations has 3 columns but the task has 11: must be equal; actions has 2 columns but the task has 3"
    assert message(report, "dimensions").startswith(expected)


def test_a_bound_can_be_one_number_for_all_actions():
    actions = 5 * policy_logs().actions
    one, each = (
        check_logs(policy_logs(actions=actions), 3, low, high) for low, high in ((-2, 2), ([-2, -2.0], [2.0, 2]))
    )
    assert message(one, "action bounds") == message(each, "action bounds")
    assert level(one, "action bounds") == "warning"
    with pytest.raises(InputError, match=r"action_low .*low.* must be a number, or one for each action"):
        check_logs(policy_logs(), 3, np.array("low"), 2)


def test_actions_outside_the_space():
    actions = policy_logs().actions.copy()
    actions[[3, 4], 1] = [1.5, -2.0]
    actions[5, 0] = np.nextafter(np.float32(1), np.float32(2))  # one rounding step is not outside
    report = check_logs(policy_logs(actions=actions), 3, LOW, HIGH)
    assert level(report, "action bounds") == "warning"
    assert message(report, "action bounds").startswith("2 of 1000 rows outside; worst in column 1, 1 beyond [-1, 1]")


def test_saturation_counts_exact_bounds_per_column():
    actions = policy_logs().actions.copy()
    actions[:400, 0] = 1.0
    assert level(check_logs(policy_logs(actions=actions), 3, LOW, HIGH), "saturation") == "ok"
    actions[400:900, 0] = -1.0
    report = check_logs(policy_logs(actions=actions), 3, LOW, HIGH)
    assert level(report, "saturation") == "warning"
    expected = "most in column 0 with 90.0%; above 80%: 0: were the actions clipped"
    assert expected in message(report, "saturation")


def test_scale_bounds_of_the_logs_and_unbounded_spaces():
    tiny = policy_logs(actions=0.05 * policy_logs().actions, action_low=LOW, action_high=HIGH)
    assert level(check_logs(tiny), "action scale") == "warning"
    infinite = np.full(2, np.inf, np.float32)
    report = check_logs(policy_logs(), 3, -infinite, infinite)
    assert message(report, "action scale") == "the action space has no bounds"
    assert report.exit_code == 0
    assert "give --task" in message(check_logs(policy_logs()), "action bounds")
    large = policy_logs(actions=2 * policy_logs().actions)
    assert level(check_logs(large, 3, LOW, HIGH), "action scale") == "warning"
    unit = policy_logs().actions.copy()
    unit[:2] = 1.0
    assert level(check_logs(policy_logs(actions=unit), 3, 1.5 * LOW, 1.5 * HIGH), "action scale") == "warning"
    assert level(check_logs(policy_logs(actions=unit), 3, LOW, HIGH), "action scale") == "ok"


@pytest.mark.parametrize("name", ["observations", "actions"])
def test_constant_columns(name):
    values = getattr(policy_logs(), name).copy()
    values[:, 1] = 0.5
    report = check_logs(policy_logs(**{name: values}), 3, LOW, HIGH)
    assert level(report, f"constant {name}") == "warning"
    assert message(report, f"constant {name}").startswith("1 columns never change: 1: ")
    assert level(report, "duplicated columns") == "ok"


def test_duplicated_columns():
    states = policy_logs().observations.copy()
    states[:, 2] = states[:, 0]
    report = check_logs(policy_logs(observations=states), 3, LOW, HIGH)
    assert level(report, "duplicated columns") == "warning"
    assert message(report, "duplicated columns").startswith("1 repeat another: observation 2 = 0: ")
    states[999, 2] += 1e-3
    assert level(check_logs(policy_logs(observations=states), 3, LOW, HIGH), "duplicated columns") == "ok"


def test_duplicated_rows():
    logs = policy_logs()
    twice = logs.select(list(range(10)) * 2)
    report = check_logs(twice, 3, LOW, HIGH)
    assert level(report, "duplicated rows") == "warning"
    assert message(report, "duplicated rows").startswith("50.0% of rows")


@pytest.mark.parametrize("seed", range(3))
def test_duplicated_rows_are_counted_as_numpy_counts_them(seed):
    rng = np.random.default_rng(seed)
    # Few values, among them both zeros, so that many rows agree and many more nearly do.
    values = rng.choice(np.array([-1.0, -0.0, 0.0, 1.0], np.float32), (70_000, 6))
    logs = Logs(values[:, :4], values[:, 4:], np.arange(70_000) % 100 == 99)
    share = 1 - len(np.unique(values + np.float32(0), axis=0)) / 70_000
    assert check_duplicated_rows(logs).message.startswith(f"{share:.1%} of rows")
    assert len(np.unique(_row_keys(logs))) == len(np.unique(values + np.float32(0), axis=0))


def test_the_task_that_the_logs_name_is_held_against_the_one_asked_for():
    logs = policy_logs(task="Hopper-v5")
    levels = {task: level(check_logs(logs, task=task), "task") for task in (None, "Hopper-v5", "Hopper-v4", "Ant-v5")}
    assert levels == {None: "ok", "Hopper-v5": "ok", "Hopper-v4": "warning", "Ant-v5": "error"}
    assert check_logs(logs, task="Ant-v5").exit_code == 2


def test_the_shipped_sample_is_clean_and_that_is_true_of_it():
    """Against the task's bounds; what it is said to be is counted here apart from the checks."""
    logs = load_logs("hopper-medium")
    report = check_logs(logs, 11, -np.ones(3, np.float32), np.ones(3, np.float32), "Hopper-v5")
    assert [line for line in report.lines if line.level != "ok"] == []
    at_a_bound = [(abs(column) == 1).mean() for column in logs.actions.T]
    assert 0.5 < max(at_a_bound) < 0.6
    assert f"most in column {np.argmax(at_a_bound)} with {max(at_a_bound):.1%}" in message(report, "saturation")


def test_the_page_lists_the_findings_that_there_are():
    """docs/check-logs.md, one row a finding, in the order in which they are printed."""
    text = (Path(__file__).parents[2] / "docs" / "check-logs.md").read_text()
    listed = re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)
    assert listed == [line.name for line in check_logs(policy_logs()).lines]
    assert listed == [line.name for line in check_logs(make_logs((1,))).lines]


def test_require_compatible():
    logs = policy_logs(task="Hopper-v5")
    require_compatible(logs, task="Hopper-v5", observation_size=3, action_size=2)
    require_compatible(policy_logs(), task="Ant-v5", observation_size=3, action_size=2)
    with pytest.warns(LogsWarning, match="the logs are of Hopper-v5, the task is Hopper-v4"):
        require_compatible(logs, task="Hopper-v4", observation_size=3, action_size=2)
    with pytest.raises(InputError, match="of task 'Hopper-v5', not 'Ant-v5': must be logs of Ant, or --task Hopper-v5"):
        require_compatible(logs, task="Ant-v5", observation_size=3, action_size=2)
    with pytest.raises(InputError, match="do not fit 'Hopper-v5': observations has 3 columns but the task has 11"):
        require_compatible(logs, task="Hopper-v5", observation_size=11, action_size=2)
