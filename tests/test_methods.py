"""The methods against the paper's Table 3, and what a user may change of them."""

import pytest

from ppo_dap.config import Config, flatten, make, replace
from ppo_dap.errors import InputError
from ppo_dap.methods import ALIASES, METHODS, capability_rows, get_method, resolve

# The rows of Table 3 that are here, its cells typed by hand: method, strictly on-policy, advantages on logged data,
# prior type, VG, PET, extra losses.
TABLE_3 = """
PPO (Vanilla) | ✓ | ✗ | None | ✗ | ✗ | None
PPO + BC Warmup | ✓ | ✗ | Warm-start (not a prior) | ✗ | ✗ | Offline BC only; none online
PPO-DAP (Ours) | ✓ | ✗ | Diffusion action prior | ✓ (Energy + Grad) | ✓ | Soft prior-KL + auxiliary BC (low weight)
PPO-DAP (No-VG) | ✓ | ✗ | Diffusion action prior | ✗ | ✓ | Soft prior-KL + auxiliary BC
PPO-DAP (No-PET) | ✓ | ✗ | Diffusion prior (frozen) | ✓ (Energy + Grad) | ✗ | Soft prior-KL + auxiliary BC
PPO-DAP (Prior-KL-only) | ✓ | ✗ | Diffusion action prior | ✗ | ✓ | Soft prior-KL only
PPO-DAP (Aux-only) | ✓ | ✗ | Diffusion action prior | ✓ (Energy / optional Grad) | ✓ | Auxiliary BC only
"""
COLUMNS = ("paper", "strictly on-policy", "advantages on logs", "prior", "value guidance", "PET", "extra losses")
# The paper's words for a cell -> ours, where they are not the same.
OURS = {
    "strictly on-policy": {"✓": "yes"},
    "advantages on logs": {"✗": "no"},
    "prior": {
        "None": "none",
        "Warm-start (not a prior)": "warm start",
        "Diffusion action prior": "diffusion",
        "Diffusion prior (frozen)": "diffusion",
    },
    "value guidance": {
        "✗": "no",
        "✓ (Energy + Grad)": "energy+gradient",
        "✓ (Energy / optional Grad)": "energy+gradient",
    },
    "PET": {"✓": "yes", "✗": "no"},
    "extra losses": {
        "None": "none",
        "Offline BC only; none online": "offline BC only",
        "Soft prior-KL + auxiliary BC (low weight)": "soft prior-KL + auxiliary BC",
        "Soft prior-KL + auxiliary BC": "soft prior-KL + auxiliary BC",
        "Soft prior-KL only": "soft prior-KL",
        "Auxiliary BC only": "auxiliary BC",
    },
}
PAPER = {
    cells[0]: dict(zip(COLUMNS, cells, strict=True))
    for cells in ([cell.strip() for cell in line.split("|")] for line in TABLE_3.strip().splitlines())
}


def test_every_row_here_is_a_row_of_the_table():
    rows = capability_rows()
    assert [row["method"] for row in rows] == list(METHODS)
    assert {row["paper"] for row in rows} == set(PAPER)


@pytest.mark.parametrize("column", COLUMNS[1:])
@pytest.mark.parametrize("paper", PAPER)
def test_capability_cells_are_the_papers(paper, column):
    (row,) = (row for row in capability_rows() if row["paper"] == paper)
    assert row[column] == OURS[column][PAPER[paper][column]]


def test_diffusion_novg_is_no_vg():
    assert ALIASES == {"diffusion-novg": "ppo-dap-no-vg"}
    assert get_method("diffusion-novg") is get_method("ppo-dap-no-vg") is METHODS["ppo-dap-no-vg"]


@pytest.mark.parametrize("name", ["PPO-DAP", "ppo-flow", ""])
def test_unknown_methods_are_answered_with_the_names(name):
    with pytest.raises(InputError, match="unknown method") as caught:
        get_method(name)
    assert all(known in str(caught.value) for known in [*METHODS, *ALIASES])
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize(
    ("method", "option", "value", "right"),
    [
        ("ppo", "warm_start", "actor", "'none'"),
        ("ppo-bc", "warm_start", "none", "'actor' or 'actor_critic'"),
        ("ppo-dap-no-vg", "guidance", "energy", "'none'"),
        ("diffusion-novg", "guidance", "energy+gradient", "'none'"),
        ("ppo-dap-no-pet", "pet_frequency", 5, "0"),
        ("ppo-dap-prior-kl-only", "lambda_aux", 0.01, "0.0"),
        ("ppo-dap-prior-kl-only", "guidance", "gradient", "'none'"),
        ("ppo-dap-aux-only", "lambda_kl", 0.1, "0.0"),
    ],
)
def test_options_that_contradict_the_method_are_refused(method, option, value, right):
    chosen = get_method(method)
    with pytest.raises(InputError) as caught:
        resolve(chosen, make(**{option: value}), {option: value})
    expected = f"{option} {value!r} contradicts method {chosen.name}, which has {option} {right}"
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("ppo", {"warm_start": "none", "gamma": 0.9}),
        ("ppo-bc", {"warm_start": "actor"}),
        ("ppo-bc", {"warm_start": "actor_critic"}),
        ("ppo-dap", {"guidance": "energy", "pet_frequency": 20, "lambda_kl": 0.1, "warm_start": "actor"}),
        ("ppo-dap-no-vg", {"guidance": "none", "lambda_kl": 0.1}),
        ("ppo-dap-no-pet", {"pet_frequency": 0, "guidance": "energy"}),
        ("ppo-dap-prior-kl-only", {"lambda_aux": 0.0, "lambda_kl": 0.1}),
        ("ppo-dap-aux-only", {"lambda_kl": 0.0, "lambda_aux": 0.1, "guidance": "gradient"}),
    ],
)
def test_compatible_options_are_kept(method, options):
    resolved = flatten(resolve(get_method(method), make(**options), options))
    assert {name: resolved[name] for name in options} == options


@pytest.mark.parametrize("preset", ["paper", "tuned"])
@pytest.mark.parametrize("name", METHODS)
def test_a_method_changes_what_it_fixes_and_nothing_else(name, preset):
    method, config = get_method(name), make(preset)
    before, after = flatten(config), flatten(resolve(method, config, {}))
    assert {n for n in before if before[n] != after[n]} <= set(method.fixed)
    for field, value in method.fixed.items():
        assert after[field] in (value if isinstance(value, tuple) else (value,))


def test_a_preset_gives_way_to_the_method():
    config = replace(Config(), guidance="energy", lambda_aux=0.1)
    resolved = flatten(resolve(get_method("ppo-dap-prior-kl-only"), config, {}))
    assert (resolved["guidance"], resolved["lambda_aux"]) == ("none", 0)
