"""docs/tasks.md against the code."""

from pathlib import Path

import pytest

from ppo_dap.tasks.catalogue import CATALOGUE

TEXT = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text()
COLUMNS = ["task", "observation", "action", "bound", "steps", "terminates", "random", "expert", "gamma", "stepped by"]


def table(text):
    """Rows below the head that names COLUMNS, as dicts."""
    lines = iter(text.splitlines())
    for line in lines:
        if cells(line) == COLUMNS:
            break
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append(dict(zip(COLUMNS, cells(line), strict=True)))
    return rows


def cells(line):
    return [cell.strip() for cell in line.removeprefix("|").removesuffix("|").split("|")]


def faults(text):
    """Tasks whose row does not say what the catalogue says, and tasks without a row."""
    rows = {row["task"]: row for row in table(text)}
    wrong = sorted(set(CATALOGUE) ^ set(rows))
    for task in set(rows) & set(CATALOGUE):
        spec, row = CATALOGUE[task], rows[task]
        numbers = {
            "observation": spec.observation_size,
            "action": spec.action_size,
            "steps": spec.episode_length,
            "random": spec.random_return,
            "expert": spec.expert_return,
            "gamma": spec.gamma,
        }
        agree = all((float(row[name]) if row[name] else None) == value for name, value in numbers.items())
        bounds = {*spec.action_high.tolist(), *(-spec.action_low).tolist()}
        agree &= [float(row["bound"])] == pytest.approx(list(bounds))
        agree &= row["terminates"] == ("yes" if spec.terminates else "no") and row["stepped by"] == spec.backend
        wrong += [] if agree else [task]
    return wrong


def test_the_table_is_the_catalogue():
    assert faults(TEXT) == []


@pytest.mark.parametrize("column", COLUMNS[1:])
def test_a_changed_cell_is_found(column):
    row = next(line for line in TEXT.splitlines() if line.startswith("| Swimmer-v5"))
    values = cells(row)
    at = COLUMNS.index(column)
    values[at] = {"no": "yes", "envpool": "mujoco"}.get(values[at], "" if values[at] else "1")
    values[at] = values[at] or "7"
    assert faults(TEXT.replace(row, "| " + " | ".join(values) + " |")) == ["Swimmer-v5"]


def test_a_missing_row_is_found():
    row = next(line for line in TEXT.splitlines() if line.startswith("| Striker-v2"))
    assert faults(TEXT.replace(row + "\n", "")) == ["Striker-v2"]


def test_the_versions_of_mujoco_are_those_installed():
    """EnvPool's is a string in its library; of the two versions the text names, each is the one that is there."""
    import importlib.metadata

    import envpool

    library = Path(envpool.__file__).parent / "mujoco" / "mujoco_gym_envpool.so"
    version = importlib.metadata.version
    sentence = f"EnvPool {version('envpool')} has MuJoCo 3.6.0 built in; the Python package"
    assert sentence in TEXT
    assert f"is {version('mujoco')}." in TEXT
    assert b"\x003.6.0\x00" in library.read_bytes()
