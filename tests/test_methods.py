"""The methods against the paper's Table 3, and what a user may change of them."""

import pytest

from ppo_dap.config import Config, flatten, make, replace
from ppo_dap.errors import InputError
from ppo_dap.methods import ALIASES, METHODS, Method, capability_rows, get_method, limits, resolve

# The rows of Table 3, its cells typed by hand: method, strictly on-policy, advantages on logged data, prior type, VG,
# PET, extra losses.
TABLE_3 = """
PPO (Vanilla) | ✓ | ✗ | None | ✗ | ✗ | None
PPO + BC Warmup | ✓ | ✗ | Warm-start (not a prior) | ✗ | ✗ | Offline BC only; none online
PPO-DAP (Ours) | ✓ | ✗ | Diffusion action prior | ✓ (Energy + Grad) | ✓ | Soft prior-KL + auxiliary BC (low weight)
PPO-DAP (No-VG) | ✓ | ✗ | Diffusion action prior | ✗ | ✓ | Soft prior-KL + auxiliary BC
PPO-DAP (No-PET) | ✓ | ✗ | Diffusion prior (frozen) | ✓ (Energy + Grad) | ✗ | Soft prior-KL + auxiliary BC
PPO-DAP (Prior-KL-only) | ✓ | ✗ | Diffusion action prior | ✗ | ✓ | Soft prior-KL only
PPO-DAP (Aux-only) | ✓ | ✗ | Diffusion action prior | ✓ (Energy / optional Grad) | ✓ | Auxiliary BC only
PPO + Behavior-prior KL | ✓ | ✗ | BC policy | ✗ | ✗ | KL to the BC policy
PPO + Flow-prior | ✓ | ✗ | Flow-based prior | Energy-only | ✗ | Prior-KL (+ optional aux)
PPO + AWR/AWAC-aux | ✓ | ✗ | None | ✗ | ✗ | Advantage-weighted BC (temperature grid)
"""
# Table 7's knobs: method, K, N_steps, grad-guided, f, r.
TABLE_7 = """
PPO (Vanilla) | - | - | - | - | -
PPO + BC Warmup | - | - | - | - | -
PPO-DAP (Ours) | 10 | 20 | yes | 10 | 8
PPO-DAP (No-VG) | 10 | 20 | no | 10 | 8
PPO-DAP (No-PET) | 10 | 20 | yes | 0 | -
VAE + PPO (ctrl) | 10 | - | - | - | -
"""
ELSEWHERE = {"ABPPO", "PPO-ARC", "PPO-GC", "VAE + PPO (ctrl)", "Retrieval prior (2.3)"}
"""Rows of Tables 4 and 7 and of section 2.3, which Table 3 leaves out."""
KNOBS = ("K", "N_steps", "grad-guided", "f", "r")
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
        "BC policy": "behaviour",
        "Flow-based prior": "flow",
    },
    "value guidance": {
        "✗": "no",
        "✓ (Energy + Grad)": "energy+gradient",
        "✓ (Energy / optional Grad)": "energy+gradient",
        "Energy-only": "energy",
    },
    "PET": {"✓": "yes", "✗": "no"},
    "extra losses": {
        "None": "none",
        "Offline BC only; none online": "offline BC only",
        "Soft prior-KL + auxiliary BC (low weight)": "soft prior-KL + auxiliary BC",
        "Soft prior-KL + auxiliary BC": "soft prior-KL + auxiliary BC",
        "Soft prior-KL only": "soft prior-KL",
        "Auxiliary BC only": "auxiliary BC",
        "KL to the BC policy": "soft prior-KL",
        "Prior-KL (+ optional aux)": "soft prior-KL + auxiliary BC",
        "Advantage-weighted BC (temperature grid)": "advantage-weighted BC",
    },
}
PAPER = {
    cells[0]: dict(zip(COLUMNS, cells, strict=True))
    for cells in ([cell.strip() for cell in line.split("|")] for line in TABLE_3.strip().splitlines())
}


def test_every_row_here_is_a_row_of_the_table():
    rows = capability_rows()
    assert [row["method"] for row in rows] == list(METHODS)
    assert {row["paper"] for row in rows} == set(PAPER) | ELSEWHERE


@pytest.mark.parametrize("column", COLUMNS[1:])
@pytest.mark.parametrize("paper", PAPER)
def test_capability_cells_are_the_papers(paper, column):
    (row,) = (row for row in capability_rows() if row["paper"] == paper)
    assert row[column] == OURS[column][PAPER[paper][column]]


@pytest.mark.parametrize("line", TABLE_7.strip().splitlines())
def test_knobs_are_table_7s(line):
    paper, *knobs = (cell.strip() for cell in line.split("|"))
    (row,) = (row for row in capability_rows() if row["paper"] == paper)
    assert [row[name] for name in KNOBS] == knobs


def test_only_arc_is_not_strictly_on_policy_and_reconstructions_say_so():
    rows = {row["method"]: row for row in capability_rows()}
    assert [name for name, row in rows.items() if row["strictly on-policy"] == "no"] == ["ppo-arc"]
    reconstructed = [name for name, row in rows.items() if row["source"] == "reconstruction"]
    assert reconstructed == ["ppo-abppo", "ppo-arc", "ppo-gc"]
    assert {rows[name]["surrogate"] for name in rows if name not in reconstructed} == {"clip"}


def test_a_method_of_parts_that_are_there_is_one_line(monkeypatch):
    line = Method("ppo-flow-gc", "none", "flow", {"surrogate": "generalised_clip"}, {"lambda_awr": 0.02}, source="ours")
    monkeypatch.setitem(METHODS, line.name, line)
    row = capability_rows()[-1]
    assert (row["method"], row["prior"], row["surrogate"]) == ("ppo-flow-gc", "flow", "generalised_clip")
    assert row["extra losses"] == "soft prior-KL + auxiliary BC + advantage-weighted BC"
    config = flatten(resolve(get_method("ppo-flow-gc"), make(), {}))
    assert (config["guidance"], config["pet_frequency"], config["lambda_awr"]) == ("energy", 0, 0.02)


def test_diffusion_novg_is_no_vg():
    assert ALIASES == {"diffusion-novg": "ppo-dap-no-vg"}
    assert get_method("diffusion-novg") is get_method("ppo-dap-no-vg") is METHODS["ppo-dap-no-vg"]


@pytest.mark.parametrize("name", ["PPO-DAP", "ppo-flaw", ""])
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
        (
            "ppo-flow",
            "guidance",
            "gradient",
            "'energy' or 'none': only a diffusion prior has denoising steps to guide "
            "(Table 3, notes: flow and VAE have energy alone)",
        ),
        ("ppo-vae", "pet_frequency", 20, "0: adapters are the diffusion prior's (Table 3: PET is off for the others)"),
        ("ppo-behavior-kl", "guidance", "energy", "'none'"),
        (
            "ppo-dap",
            "reuse_batches",
            1,
            "0: only ppo-arc reuses rows of an earlier policy, and is not strictly on-policy",
        ),
        ("ppo-gc", "surrogate", "clip", "'generalised_clip'"),
        ("ppo-arc", "reuse_batches", 0, "1"),
        ("ppo", "lambda_awr", 0.1, "0.0"),
    ],
)
def test_options_that_contradict_the_method_are_refused(method, option, value, right):
    chosen = get_method(method)
    with pytest.raises(InputError) as caught:
        resolve(chosen, make(**{option: value}), {option: value})
    expected = f"{option} {value!r} contradicts method {chosen.name}, which has {option} {right}"
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("method", "option", "value", "why"),
    [
        ("ppo", "guidance", "energy", "which has no prior"),
        ("ppo-bc", "pet_frequency", 20, "which has no prior"),
        ("ppo-awr", "lambda_kl", 0.1, "which has no prior"),
        ("ppo-dap", "clip_slope", 0.3, "it needs surrogate 'generalised_clip'"),
        ("ppo-gc", "boundary_kl", 0.01, "it needs surrogate 'authentic_boundary'"),
        ("ppo", "contest_kl_weight", 2.0, "it needs reuse_batches 1"),
        ("ppo-dap", "awr_temperature", 0.3, "it needs lambda_awr above 0"),
        ("ppo-dap", "std_after", 0.5, "it needs lambda_decay_steps"),
    ],
)
def test_options_without_effect_are_refused(method, option, value, why):
    with pytest.raises(InputError) as caught:
        resolve(get_method(method), make(**{option: value}), {option: value})
    assert str(caught.value).startswith(f"{option} {value!r} has no effect in method {method}")
    assert why in str(caught.value)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("ppo-flow", {"guidance": "none", "lambda_aux": 0.0}),
        ("ppo-gc", {"clip_slope": 0.3, "warm_start": "actor"}),
        ("ppo-awr", {"lambda_awr": 0.1, "awr_temperature": 0.3}),
        ("ppo-dap", {"lambda_awr": 0.1, "surrogate": "generalised_clip", "clip_slope": 0.05}),
        ("ppo-dap", {"lambda_decay_steps": 1000, "std_after": 0.5}),
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


@pytest.mark.parametrize("preset", ["paper", "tuned", "tuned-warm"])
@pytest.mark.parametrize("name", METHODS)
def test_a_method_changes_what_it_fixes_and_nothing_else(name, preset):
    method, config = get_method(name), make(preset)
    before, after = flatten(config), flatten(resolve(method, config, {}))
    changes = limits(method)
    of_a_prior = {"initial_std"} if method.prior == "none" and before["initial_std"] is None else set()
    assert {n for n in before if before[n] != after[n]} <= {*changes, *method.defaults, *of_a_prior}
    for field, value in changes.items():
        assert after[field] in (value if isinstance(value, tuple) else (value,))


def test_a_policy_starts_at_the_priors_spread_where_there_is_a_prior():
    for method, std in (("ppo", 1.0), ("ppo-awr", 1.0), ("ppo-dap", None), ("ppo-vae", None)):
        assert resolve(get_method(method), replace(Config(), initial_std=None), {}).ppo.initial_std == std
    with pytest.raises(InputError, match="initial_std None is the prior's, and method ppo-gc has none: give a number"):
        resolve(get_method("ppo-gc"), make(initial_std=None), {"initial_std": None})


def test_a_preset_gives_way_to_the_method():
    config = replace(Config(), guidance="energy", lambda_aux=0.1)
    resolved = flatten(resolve(get_method("ppo-dap-prior-kl-only"), config, {}))
    assert (resolved["guidance"], resolved["lambda_aux"]) == ("none", 0)


def test_another_kind_of_prior_takes_what_it_can():
    """The control `--prior random` runs any method, without what only a diffusion prior can do."""
    config = flatten(resolve(get_method("ppo-dap"), make(), {}, kind="random"))
    assert (config["guidance"], config["pet_frequency"]) == ("energy", 0)
    with pytest.raises(InputError, match="only a diffusion prior has denoising steps"):
        resolve(get_method("ppo-dap"), make(), {"guidance": "gradient"}, kind="random")
