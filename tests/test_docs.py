"""What the documents say is held against the code: equations, README, and planted faults for each check."""

import ast
import functools
import importlib
import re
import shlex
import textwrap
from pathlib import Path

import pytest

from ppo_dap.cli import build_parser
from ppo_dap.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
EQUATIONS = ROOT / "docs" / "equations.md"
README = ROOT / "README.md"
DEFINITION = "definition, no code"
NUMBERED = range(1, 15)
WITHOUT_CODE = {1, 2, 3}


def resolve(name: str) -> object:
    """The object of a dotted name: its longest importable part, then attributes. Raises if there is none."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        module = ".".join(parts[:count])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module}.".startswith(f"{error.name}."):
                raise  # the module is there, and something that it needs is not
            continue
        return functools.reduce(getattr, parts[count:], found)
    raise ModuleNotFoundError(name)


def mentions(text: str, number: int) -> bool:
    """Whether `text` names equation `number`: "Eq. 7", "Eqs 7 and 8", "Equation 7"."""
    groups = re.findall(r"\b(?:Eqs?\.?|Equations?)\s+\(?(\d+(?:\)?(?:,| and|,? to|-)\s*\(?\d+)*)", text)
    return any(str(number) in re.findall(r"\d+", group) for group in groups)


def table_rows(text: str) -> list[list[str]]:
    """Cells of the rows of the document's tables, less their heads."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    heads = {i for i, row in enumerate(rows) if set("".join(row)) <= set("-: ")}
    return [row for i, row in enumerate(rows) if i not in heads and i + 1 not in heads]


def faults_of_row(row: list[str]) -> list[str]:
    """What is wrong with one row of docs/equations.md."""
    if len(row) != 4:
        return [f"{row[0]}: {len(row)} cells"]
    label, _, functions, tests = row
    match = re.fullmatch(r"Eq\. (\d+)", label)
    number = int(match[1]) if match else None
    if functions.startswith(DEFINITION):
        return [] if number in WITHOUT_CODE else [f"{label}: no function"]
    names, places = re.findall(r"`([^`]+)`", functions), re.findall(r"`([^`]+)`", tests)
    faults = [] if names else [f"{label}: no function"]
    faults += [] if places else [f"{label}: no test"]
    for name in names:
        try:
            function = resolve(name)
        except (ModuleNotFoundError, AttributeError):
            faults.append(f"{label}: {name} does not exist")
            continue
        if number is not None and not mentions(getattr(function, "__doc__", None) or "", number):
            faults.append(f"{label}: the docstring of {name} does not name the equation")
    return faults + [f"{label}: {place} does not exist" for place in places if not is_test(place)]


def is_test(place: str) -> bool:
    """Whether `file::function` is a test function of that file."""
    file, _, function = place.partition("::")
    path = ROOT / file
    if not (file.startswith("tests/") and path.is_file() and function.startswith("test_")):
        return False
    body = ast.parse(path.read_text()).body
    return any(isinstance(node, ast.FunctionDef) and node.name == function for node in body)


def equation_faults(text: str) -> list[str]:
    """Everything that is wrong with docs/equations.md."""
    rows = table_rows(text)
    labels = [row[0] for row in rows]
    counts = {n: labels.count(f"Eq. {n}") for n in NUMBERED}
    faults = [f"Eq. {n}: {count} rows" for n, count in counts.items() if count != 1]
    return faults + [fault for row in rows for fault in faults_of_row(row)]


def test_equations_name_functions_and_tests_that_exist():
    assert equation_faults(EQUATIONS.read_text()) == []


GOOD_FUNCTION, GOOD_TEST = "`ppo_dap.ppo.gae.gae`", "`tests/ppo/test_gae.py::test_columns_in_another_shape_are_refused`"


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        (f"| made-up | x | `ppo_dap.ppo.gae.gaae` | {GOOD_TEST} |", "ppo_dap.ppo.gae.gaae does not exist"),
        (f"| made-up | x | `ppo_dap.ppo.gaee.gae` | {GOOD_TEST} |", "ppo_dap.ppo.gaee.gae does not exist"),
        (f"| made-up | x | {GOOD_FUNCTION} | `tests/ppo/test_gae.py::test_x` |", "::test_x does not exist"),
        (f"| made-up | x | {GOOD_FUNCTION} | `tests/ppo/test_no.py::test_x` |", "::test_x does not exist"),
        (f"| made-up | x | {GOOD_FUNCTION} | none |", "no test"),
        (f"| made-up | x | none | {GOOD_TEST} |", "no function"),
        (f"| made-up | x | {DEFINITION} | none |", "no function"),
        (f"| Eq. 7 | x | {GOOD_FUNCTION} | {GOOD_TEST} |", "Eq. 7: 2 rows"),
        (f"| Eq. 15 | x | {GOOD_FUNCTION} | {GOOD_TEST} |", "does not name the equation"),
        ("| made-up | x |", "2 cells"),
    ],
)
def test_a_made_up_row_is_found(row, fault):
    text = EQUATIONS.read_text()
    added = set(equation_faults(f"{text}{row}\n")) - set(equation_faults(text))
    assert any(fault in a for a in added), added


def test_a_missing_equation_is_found():
    lines = [line for line in EQUATIONS.read_text().splitlines() if not line.startswith("| Eq. 7 ")]
    assert "Eq. 7: 0 rows" in equation_faults("\n".join(lines))


def test_mentions_of_equations():
    assert mentions("Eq. 7: weights", 7)
    assert mentions("Eqs 7 and 8", 8)
    assert mentions("Equation 11.", 11)
    assert not mentions("Eq. 17 and step 7", 7)
    assert not mentions("Eq. 1", 11)


def blocks(text: str) -> list[tuple[str, str]]:
    """(language, text) of every fenced block."""
    found = re.findall(r"^([ ]*)```([\w-]*)[^\n]*\n(.*?)^\1```[ ]*$", text, re.MULTILINE | re.DOTALL)
    return [(language, textwrap.dedent(body)) for _, language, body in found]


def python_faults(block: str) -> list[str]:
    """What is wrong with a block of Python: it does not compile, or names what ppo_dap does not have."""
    try:
        tree = ast.parse(block)
    except SyntaxError as error:
        return [f"does not compile: {error}"]
    names = {".".join(re.findall(r"\w+", ast.unparse(node))) for node in ast.walk(tree) if _is_our_attribute(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.partition(".")[0] == "ppo_dap"}
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "ppo_dap":
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    faults = []
    for name in sorted(names):
        try:
            resolve(name)
        except (ModuleNotFoundError, AttributeError):
            faults.append(f"{name} does not exist")
    return faults


def _is_our_attribute(node: ast.AST) -> bool:
    """Whether it is a chain of names that starts at `ppo_dap`."""
    if not isinstance(node, ast.Attribute):
        return False
    while isinstance(node, ast.Attribute):
        node = node.value
    return isinstance(node, ast.Name) and node.id == "ppo_dap"


COMMAND = re.compile(r"^\s*(?:\$ )?(?:\w+=\S+ )*(?:\S*/)?ppo-dap (?!:)(.+)$")


def commands(text: str) -> list[str]:
    """The arguments of every `ppo-dap ...` line of the blocks that are not Python."""
    found = []
    for language, body in blocks(text):
        if language not in ("python", "toml", "bibtex"):
            lines = body.replace("\\\n", " ").splitlines()
            found += [match[1] for line in lines if (match := COMMAND.match(line))]
    return found


def command_fault(arguments: str) -> str | None:
    """What the parser says to a command line (up to a pipe or the like), or None."""
    words = shlex.split(arguments, comments=True)
    end = next((i for i, word in enumerate(words) if word in {"|", "||", "&&", "&", ";", ">", ">>", "2>&1"}), None)
    try:
        build_parser().parse([word.rstrip(";") for word in words[:end]])
    except InputError as error:
        return f"ppo-dap {arguments}: {error}"
    except SystemExit as end:
        return None if not end.code else f"ppo-dap {arguments}: exit {end.code}"
    return None


def unknown_commands(text: str) -> set[str]:
    """Commands that running text names (`ppo-dap train`) and that there are none of."""
    named = set(re.findall(r"`ppo-dap ([a-z][a-z-]*)", text))
    return named - set(build_parser().subcommands.choices)


def test_python_in_the_readme_compiles_and_names_what_exists():
    found = [body for language, body in blocks(README.read_text()) if language == "python"]
    assert found
    assert [fault for body in found for fault in python_faults(body)] == []


def test_commands_in_the_readme_parse():
    text = README.read_text()
    assert commands(text)
    assert [fault for line in commands(text) if (fault := command_fault(line))] == []
    assert unknown_commands(text) == set()


@pytest.mark.parametrize(
    ("block", "fault"),
    [
        ("import ppo_dap\nppo_dap.Guyde(1).x", "ppo_dap.Guyde does not exist"),
        ("from ppo_dap import trayn", "ppo_dap.trayn does not exist"),
        ("import ppo_dap.prior", "ppo_dap.prior does not exist"),
        ("guide(1", "does not compile"),
    ],
)
def test_python_faults_are_found(block, fault):
    assert any(fault in found for found in python_faults(block))
    assert python_faults("import ppo_dap\nguide = ppo_dap.Guide(ppo_dap.load_prior('prior'), total_iterations=3)") == []


def test_commands_are_found_and_faults_in_them():
    text = "1. x\n\n   ```sh\n   $ .venv/bin/ppo-dap train --task A \\\n     --out b  # c\n   ppo-dap: error\n   ```\n"
    (line,) = commands(text)
    assert command_fault(line) is None
    assert command_fault("audit runs/a | tail") is None
    assert command_fault("train --help") is None
    assert "--lambda-kl" in command_fault("train --task A --out b --lambda-kll 1")
    assert "folder" in command_fault("audit").lower() or "RUN" in command_fault("audit")
    assert command_fault("trian --task A") is not None
    assert unknown_commands("use `ppo-dap trian --x` or `ppo-dap train`") == {"trian"}
