"""The rules of the house, each with a planted fault that makes its checker fire."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from ppo_dap.ppo.gae import gae

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "ppo_dap"

# Top-level part of ppo_dap -> the other parts that it may import. A part that is not listed fails the test.
_LEARNING = {"nets", "priors", "ppo", "dap"}
_DATA = {"tasks", "logs"}
_BASE = {"errors", "fields", "storage", "config", "prior_config", "methods"}
ALLOWED = {
    "errors": set(),
    "storage": {"errors"},
    "fields": {"errors"},
    "config": {"errors", "fields"},
    "prior_config": {"errors", "fields"},
    "methods": {"errors", "config"},
    "tasks": {"errors"},
    "logs": {"errors", "storage", "tasks"},
    "nets": {"errors", "storage"},
    "priors": {"nets", *_DATA, *_BASE},
    "ppo": {"nets", "priors", *_DATA, *_BASE},
    "dap": {"nets", "priors", "ppo", *_DATA, *_BASE},
    "training": {*_LEARNING, *_DATA, *_BASE},
    "study": {"training", *_LEARNING, *_DATA, *_BASE},
}
EVERYTHING = {"__init__", "cli", "commands"}  # the public face and the commands: they import all, nothing imports them
# The same within ppo_dap.study.
STUDY = {
    "stats": set(),
    "plots": set(),
    "diagnostics": {"plots"},
    "store": {"stats", "diagnostics"},
    "results": {"stats", "store"},
    "tables": {"stats", "store", "results"},
    "figures": {"stats", "plots", "diagnostics", "store", "results"},
    "draw": {"store", "results", "tables", "figures"},
    "report": {"stats", "plots", "store"},
    "bench": {"plots"},
    "quickstart": {"stats", "plots"},
}

MAX_FILE_LINES = 350
MAX_FUNCTION_LINES = 60
MACHINE_PATH = re.compile(r"(?<![\w./-])/(?:root|work|tmp)/[A-Za-z]")
TEXT_SUFFIXES = {".py", ".md", ".toml", ".txt", ".cff", ".json", ".yml", ".yaml", ".sh"}
HEAVY = {
    "jax",
    "jaxlib",
    "equinox",
    "optax",
    "envpool",
    "gymnasium",
    "mujoco",
    "matplotlib",
    "minari",
    "h5py",
    "pyarrow",
    "imageio",
    "ray",
    "scipy",
    "sklearn",
}


def _imported_modules(node: ast.AST, module: tuple[str, ...], root: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Dotted names under `root`, less it, that an import statement of `module` (its folder's dotted name) reaches."""
    if isinstance(node, ast.Import):
        names = [tuple(alias.name.split(".")) for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        start = module[: len(module) - node.level + 1] if node.level else ()
        base = start + tuple(node.module.split(".") if node.module else ())
        names = [(*base, alias.name) for alias in node.names] if base == root else [base]
    else:
        names = []
    return [name[len(root) :] for name in names if name[: len(root)] == root]


def _part(name: tuple[str, ...], package: Path) -> str:
    """The part of a package that a dotted name under it belongs to; a public function belongs to `__init__`."""
    if name and ((package / name[0]).is_dir() or (package / f"{name[0]}.py").is_file()):
        return name[0]
    return "__init__"


def wrong_imports(
    package: Path, allowed: dict[str, set[str]] = ALLOWED, root: tuple[str, ...] = ("ppo_dap",)
) -> list[str]:
    """`file:line: part imports part` for every import of the package `root` against the allowed direction."""
    found = []
    for file in sorted(package.rglob("*.py")):
        relative = file.relative_to(package)
        part = relative.parts[0] if len(relative.parts) > 1 else relative.stem
        if part in EVERYTHING:
            continue
        if part not in allowed:
            found.append(f"{relative}:1: {part} has no place among the parts that are allowed")
            continue
        folder = (*root, *relative.parts[:-1])
        for node in ast.walk(ast.parse(file.read_text())):
            for name in _imported_modules(node, folder, root):
                target = _part(name, package)
                if target != part and target not in allowed[part]:
                    found.append(f"{relative}:{node.lineno}: {part} imports {target}")
    return found


def too_long(package: Path) -> list[str]:
    """`file:line` for every file and every function above its limit."""
    found = []
    for file in sorted(package.rglob("*.py")):
        text, relative = file.read_text(), file.relative_to(package)
        if (lines := len(text.splitlines())) > MAX_FILE_LINES:
            found.append(f"{relative}:1: {lines} lines")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = node.end_lineno - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    found.append(f"{relative}:{node.lineno}: {node.name} has {lines} lines")
    return found


def machine_paths(root: Path) -> list[str]:
    """`file:line` for every path of somebody's machine in the files that a user gets."""
    folders = [root / name for name in ("src", "docs", "tests", "examples", ".ci")]
    files = [f for folder in folders for f in folder.rglob("*") if f.suffix in TEXT_SUFFIXES or f.parent.name == ".ci"]
    files += [f for f in root.glob("*") if f.suffix in TEXT_SUFFIXES or f.name in ("Makefile", "LICENSE")]
    return [
        f"{file.relative_to(root)}:{number}"
        for file in sorted(files)
        if file.is_file() and not any(part.endswith(".egg-info") for part in file.parts)
        for number, line in enumerate(file.read_text().splitlines(), 1)
        if MACHINE_PATH.search(line)
    ]


def _write(root: Path, **files: str) -> Path:
    for name, text in files.items():
        file = root / (name.replace("__", "/") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return root


def test_imports_point_one_way():
    assert wrong_imports(PACKAGE) == []
    assert wrong_imports(PACKAGE / "study", STUDY, ("ppo_dap", "study")) == []


@pytest.mark.parametrize(
    "statement",
    [
        "from ppo_dap.study.store.cells import run",
        "from ppo_dap.study.results import gather",
        "from ppo_dap.study import store",
        "from .. import store",
        "import ppo_dap.study.tables.studies",
    ],
)
def test_an_import_against_the_direction_within_studies_is_found(tmp_path, statement):
    _write(tmp_path, **{f"{part}__fine": "from ppo_dap.training.run import Run\n" for part in STUDY})
    _write(tmp_path, tables__good="from ppo_dap.study.stats import fine\nfrom ..store import fine as again\n")
    assert wrong_imports(tmp_path, STUDY, ("ppo_dap", "study")) == []
    _write(tmp_path, stats__planted=statement)
    (found,) = wrong_imports(tmp_path, STUDY, ("ppo_dap", "study"))
    assert found.startswith("stats/planted.py:1: stats imports ")


@pytest.mark.parametrize(
    ("where", "statement"),
    [
        ("nets", "from ppo_dap.priors.fit import fit"),
        ("nets", "from ppo_dap import priors"),
        ("nets", "import ppo_dap.config"),
        ("nets", "import ppo_dap"),
        ("nets", "from .. import priors"),
        ("nets", "from ..priors import fit"),
        ("nets", "def late():\n    from ppo_dap.priors import fit"),
        ("priors", "from ppo_dap.ppo.gae import gae"),
        ("ppo", "from ppo_dap.dap import guidance"),
        ("dap", "from ppo_dap.training import train"),
        ("training", "from ppo_dap.study import runs"),
        ("training", "from ppo_dap import load_logs"),
        ("tasks", "from ppo_dap.nets.policy import Policy"),
        ("logs", "from ppo_dap.training import train"),
        ("novelty", "import os"),
    ],
)
def test_an_import_against_the_direction_is_found(tmp_path, where, statement):
    _write(
        tmp_path, **dict.fromkeys((f"{p}__fine" for p in ALLOWED), "import os\nfrom ppo_dap.errors import InputError\n")
    )
    (tmp_path / "errors" / "fine.py").unlink()
    _write(
        tmp_path, config="", errors="", study__good="from ppo_dap.training import fine\nfrom . import fine as again\n"
    )
    assert wrong_imports(tmp_path) == []
    _write(tmp_path, **{f"{where}__planted": statement})
    (found,) = wrong_imports(tmp_path)
    assert found.startswith((f"{where}/planted.py:1: ", f"{where}/planted.py:2: "))


def test_files_and_functions_are_short():
    assert too_long(PACKAGE) == []


def test_a_long_file_and_a_long_function_are_found(tmp_path):
    at_the_limit = "def f():\n" + "    pass\n" * (MAX_FUNCTION_LINES - 1)
    _write(tmp_path, fine=at_the_limit + "\n" * (MAX_FILE_LINES - MAX_FUNCTION_LINES))
    assert too_long(tmp_path) == []
    _write(tmp_path, function="import os\n" + at_the_limit + "    pass\n", file="\n" * (MAX_FILE_LINES + 1))
    assert too_long(tmp_path) == ["file.py:1: 351 lines", "function.py:2: f has 61 lines"]


def test_no_machine_paths():
    assert machine_paths(ROOT) == []


@pytest.mark.parametrize("folder", ["root", "work", "tmp"])
@pytest.mark.parametrize("name", ["src/a.py", "docs/a.md", "README.md", "Makefile", ".ci/run"])
def test_a_machine_path_is_found(tmp_path, folder, name):
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(f"fine: a/{folder}/b, https://host/{folder}/x, /{folder}\n")
    assert machine_paths(tmp_path) == []
    file.write_text(f"one\nopen('/{folder}/somebody/file')\n")
    assert machine_paths(tmp_path) == [f"{name}:2"]


def test_constraints_hold_names_versions_and_hashes_only():
    entry = re.compile(r"[a-z0-9.-]+==[\w.]+( ; [^\\/]+)? \\\n(    --hash=sha256:[0-9a-f]{64}( \\)?\n)+")
    text = (ROOT / "constraints.txt").read_text()
    assert entry.sub("", text) == ""
    for planted in ("--index-url https://host/simple\n", "name==1.0\n", "name @ https://host/name-1.0.whl\n"):
        assert entry.sub("", text + planted) == planted


def _loaded_by(statement: str) -> set[str]:
    code = (
        "import sys\n"
        f"try:\n    {statement}\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
        "print('\\n' + ' '.join(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stdout.splitlines()[-1].split()}


@pytest.mark.skipif(not (PACKAGE / "cli.py").exists(), reason="no commands yet")
def test_help_imports_nothing_heavy():
    assert _loaded_by("from ppo_dap.cli import main; main(['--help'])") & HEAVY == set()


def test_a_heavy_import_is_found():
    assert "scipy" in _loaded_by("import scipy")


def unknown_options(text: str) -> set[str]:
    """Options in `text` that no command has."""
    from ppo_dap.cli import build_parser

    commands = build_parser().subcommands.choices.values()
    known = {option for command in commands for option in command._option_string_actions}
    return {name for name in re.findall(r"(?<![\w-])--([a-z][a-z-]*)", text) if f"--{name}" not in known}


def test_deviations_name_options_that_exist():
    text = (ROOT / "docs" / "deviations.md").read_text()
    assert unknown_options(text) == set()
    assert unknown_options(text + "`--q-scales none`") == {"q-scales"}


def test_shapes_are_checked_in_every_test():
    step, no = jnp.ones((2, 3)), jnp.zeros((2, 3), bool)
    assert gae(step, step, step, no, no, ~no, 0.9, 0.9).shape == (2, 3)
    with pytest.raises(TypeCheckError, match="gae"):
        gae(step, step[:, :1], step, no, no, ~no, 0.9, 0.9)
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.zeros((2, 3)) + jnp.zeros(3)
