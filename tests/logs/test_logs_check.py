import numpy as np
import pytest

from logs.logs_made import make_logs
from ppo_dap.errors import InputError
from ppo_dap.logs import Finding, Logs, LogsWarning, Report, check_logs, load_logs, require_compatible
from ppo_dap.logs.jumps import find_jumps

LOW, HIGH = np.full(2, -1.0, np.float32), np.ones(2, np.float32)


def pendulums(num_episodes=30, length=60, seed=0):
    """Three driven pendulums, semi-implicit Euler, reset near rest: D4RL arrays with every timeout marked."""
    rng = np.random.default_rng(seed)
    arrays = {"observations": [], "actions": [], "timeouts": []}
    for _ in range(num_episodes):
        angle, speed = rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3)
        for t in range(length):
            action = np.clip(np.sin(0.2 * t + np.arange(3)) + 0.3 * rng.normal(size=3), -1, 1)
            arrays["observations"].append(np.concatenate([angle, speed]))
            arrays["actions"].append(action)
            arrays["timeouts"].append(t == length - 1)
            for _ in range(5):
                speed = speed + 0.01 * (20 * action - 9.8 * np.sin(angle) - 0.1 * speed)
                angle = angle + 0.01 * speed
    return {name: np.array(values) for name, values in arrays.items()}


def write(path, arrays):
    import h5py

    with h5py.File(path, "w") as file:
        for name, value in arrays.items():
            file[name] = value
    return load_logs(path)


def level(report, name):
    return next(line for line in report.lines if line.name == name).level


def message(report, name):
    return next(line for line in report.lines if line.name == name).message


@pytest.mark.parametrize("seed", range(4))
def test_jump_fires_on_an_unmarked_timeout_and_not_on_a_clean_file(tmp_path, seed):
    arrays = pendulums(seed=seed)
    clean = check_logs(write(tmp_path / "clean.hdf5", arrays))
    assert level(clean, "unmarked ends") == "ok"
    assert "3 position-velocity pairs" in message(clean, "unmarked ends")
    assert clean.exit_code == 0
    ends = np.flatnonzero(arrays["timeouts"])
    arrays["timeouts"][ends[10]] = arrays["timeouts"][ends[20]] = False
    logs = write(tmp_path / "unmarked.hdf5", arrays)
    assert find_jumps(logs).rows.tolist() == [ends[10], ends[20]]
    report = check_logs(logs)
    assert report.exit_code == 1
    assert f"after 2 rows, first after row {ends[10]}" in message(report, "unmarked ends")


def test_jump_finds_every_end_of_a_file_without_marks(tmp_path):
    arrays = pendulums()
    ends = np.flatnonzero(arrays.pop("timeouts"))[:-1]
    with pytest.warns(LogsWarning, match="nothing marks"):
        logs = write(tmp_path / "a.hdf5", arrays)
    found = find_jumps(logs).rows
    assert set(found) <= set(ends)
    assert len(found) > 0.9 * len(ends)


def test_jump_of_the_whole_state_is_found_without_velocities():
    walk = np.cumsum(np.random.default_rng(0).normal(size=(500, 4)), axis=0)
    walk[250:] += 1000.0
    logs = Logs(walk, np.zeros((500, 1)), np.arange(500) == 499)
    assert find_jumps(logs).num_pairs == 0
    assert find_jumps(logs).rows.tolist() == [249]


def test_short_or_constant_logs_have_no_jumps():
    assert find_jumps(make_logs()).rows.size == 0
    still = Logs(np.ones((100, 4)), np.zeros((100, 1)), np.arange(100) == 99)
    assert find_jumps(still).rows.size == 0


def random_logs(rows=1000, **changes):
    rng = np.random.default_rng(0)
    arrays = {
        "observations": rng.normal(size=(rows, 3)),
        "actions": rng.uniform(-1, 1, (rows, 2)),
        "episode_ends": np.arange(rows) % 100 == 99,
    }
    return Logs(**{**arrays, **changes})


def test_good_logs_are_ok_and_readable():
    report = check_logs(random_logs(rewards=np.ones(1000)), 3, LOW, HIGH)
    assert report.exit_code == 0
    assert {line.level for line in report.lines} == {"ok"}
    assert message(report, "episodes") == "10, length min 100, median 100, max 100"
    assert message(report, "returns") == "min 100, median 100, max 100"
    lines = str(report).split("\n")
    assert len(lines) == len(report.lines)
    assert lines[0].split() == ["ok", "dimensions", "1000", "rows,", "3", "observations", "and", "2", "actions"]


def test_exit_code_is_that_of_the_worst_finding():
    findings = [Finding(level, "a", "b") for level in ("ok", "warning", "error")]
    assert [Report(tuple(findings[:n])).exit_code for n in range(4)] == [0, 0, 1, 2]


def test_wrong_dimensions_are_an_error():
    report = check_logs(random_logs(), 11, np.full(3, -1, np.float32), np.ones(3, np.float32))
    assert report.exit_code == 2
    expected = "observations has 3 columns but the task has 11: must be equal; actions has 2 columns but the task has 3"
    assert message(report, "dimensions").startswith(expected)


def test_actions_outside_the_space():
    actions = random_logs().actions.copy()
    actions[[3, 4], 1] = [1.5, -2.0]
    actions[5, 0] = np.nextafter(np.float32(1), np.float32(2))  # one rounding step is not outside
    report = check_logs(random_logs(actions=actions), 3, LOW, HIGH)
    assert level(report, "action bounds") == "warning"
    assert message(report, "action bounds") == "2 of 1000 rows outside; worst in column 1, 1 beyond [-1, 1]"


def test_saturation_counts_exact_bounds_per_column():
    actions = random_logs().actions.copy()
    actions[:400, 0] = 1.0
    assert level(check_logs(random_logs(actions=actions), 3, LOW, HIGH), "saturation") == "ok"
    actions[400:600, 0] = -1.0
    report = check_logs(random_logs(actions=actions), 3, LOW, HIGH)
    assert level(report, "saturation") == "warning"
    expected = "exactly at a bound: mean 30.0%, most in column 0 with 60.0%; above 50%: 0"
    assert message(report, "saturation") == expected


def test_scale_bounds_of_the_logs_and_unbounded_spaces():
    tiny = random_logs(actions=0.05 * random_logs().actions, action_low=LOW, action_high=HIGH)
    assert level(check_logs(tiny), "action scale") == "warning"
    infinite = np.full(2, np.inf, np.float32)
    report = check_logs(random_logs(), 3, -infinite, infinite)
    assert message(report, "action scale") == "the action space has no bounds"
    assert report.exit_code == 0
    assert "unknown" in message(check_logs(random_logs()), "action bounds")


@pytest.mark.parametrize("name", ["observations", "actions"])
def test_constant_columns(name):
    values = getattr(random_logs(), name).copy()
    values[:, 1] = 0.5
    report = check_logs(random_logs(**{name: values}), 3, LOW, HIGH)
    assert level(report, f"constant {name}") == "warning"
    assert message(report, f"constant {name}") == "1 columns never change: 1"


def test_duplicated_rows():
    logs = random_logs()
    twice = logs.select(list(range(10)) * 2)
    report = check_logs(twice, 3, LOW, HIGH)
    assert level(report, "duplicates") == "warning"
    assert message(report, "duplicates").startswith("50.0% of rows")


def test_require_compatible():
    logs = random_logs(task="Hopper-v5")
    require_compatible(logs, task="Hopper-v5", observation_size=3, action_size=2)
    require_compatible(random_logs(), task="Ant-v5", observation_size=3, action_size=2)
    with pytest.warns(LogsWarning, match="the logs are of Hopper-v5, the task is Hopper-v4"):
        require_compatible(logs, task="Hopper-v4", observation_size=3, action_size=2)
    with pytest.raises(InputError, match="of task 'Hopper-v5', not 'Ant-v5': must be logs of Ant, or --task Hopper-v5"):
        require_compatible(logs, task="Ant-v5", observation_size=3, action_size=2)
    with pytest.raises(InputError, match="do not fit 'Hopper-v5': observations has 3 columns but the task has 11"):
        require_compatible(logs, task="Hopper-v5", observation_size=11, action_size=2)
