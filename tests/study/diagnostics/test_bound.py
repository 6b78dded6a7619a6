"""Equation 14 on planted runs: constants known beforehand, spans added up by hand, and runs for which none can hold."""

import json

import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.storage import write_tensors
from ppo_dap.study.diagnostics.bound import (
    Anchor,
    Terms,
    bound,
    bound_figure,
    evaluation_anchors,
    fit_constants,
    fitted_scale,
    print_bound,
    return_noise,
    terms,
    training_anchors,
)

TRUE = {"c1": 2.0, "c2": 300.0, "c3": 0.5}
NAMES = ("policy_kl", "prior_kl", "eta")
SIZES = np.array([0.02, 1e-5, 0.3])


def planted(rng, n=60, names=NAMES, true=TRUE, slack=1.0):
    """Terms that are bound by the true constants: equal in three spans, one for each term, with slack elsewhere."""
    matrix = SIZES[: len(names)] * rng.uniform(0.5, 1.5, (n, len(names)))
    tight = rng.choice(n, len(names), replace=False)
    matrix[tight] *= 0.2 + 5 * np.eye(len(names))
    surrogate, room = rng.standard_normal(n), slack * rng.exponential(size=n)
    room[tight] = 0.0
    delta = surrogate - matrix @ np.array(list(true.values())[: len(names)]) + room
    steps = np.arange(n, dtype=float)
    found = dict(zip(names, matrix.T, strict=True))
    return Terms(steps, steps + 1, delta, np.full(n, 0.1), surrogate, found), tight


def holds(found, values):
    right = found.surrogate - sum(c * x for c, x in zip(values, found.penalties.values(), strict=True))
    return found.delta - right


@pytest.mark.parametrize("seed", range(3))
def test_planted_constants_are_recovered(seed):
    found, tight = planted(np.random.default_rng(seed))
    constants = fit_constants(found)
    assert constants.values == pytest.approx(TRUE, rel=1e-6)
    assert sorted(np.flatnonzero(constants.binding)) == sorted(tight)
    assert not constants.infeasible.any()


def test_the_inequality_holds_everywhere_and_a_smaller_constant_breaks_it(rng):
    matrix = SIZES * rng.exponential(size=(80, 3))
    steps = np.arange(80.0)
    delta, surrogate = rng.standard_normal((2, 80))
    found = Terms(steps, steps + 1, delta, np.zeros(80), surrogate, dict(zip(NAMES, matrix.T, strict=True)))
    constants = fit_constants(found)
    values = np.array(list(constants.values.values()))
    assert holds(found, values).min() >= -1e-9
    assert constants.slack == pytest.approx(holds(found, values))
    assert values.max() > 0
    for i in np.flatnonzero(values):
        smaller = values.copy()
        smaller[i] *= 0.999
        assert holds(found, smaller).min() < -1e-6
    # No grid of other constants that hold has a smaller mean slack.
    others = values + SIZES.max() / SIZES * rng.uniform(-2, 2, (4000, 3))
    kept = [c for c in np.maximum(others, 0) if holds(found, c).min() >= 0]
    assert kept
    assert min(holds(found, c).mean() for c in kept) >= holds(found, values).mean() - 1e-9


def test_a_run_without_prior_has_the_policys_term_alone(rng):
    found, _ = planted(rng, names=NAMES[:1])
    assert fit_constants(found).values == pytest.approx({"c1": 2.0}, rel=1e-6)


def test_a_run_that_only_improves_needs_no_constants(rng):
    found, _ = planted(rng)
    assert fit_constants(found._replace(delta=found.surrogate + 1)).values == {"c1": 0, "c2": 0, "c3": 0}


def test_a_drop_that_no_constant_explains_is_told_and_left_out(rng):
    found, tight = planted(rng)
    free = next(i for i in range(60) if i not in tight)
    for column in found.penalties.values():
        column[free] = 0.0
    found.delta[free] = found.surrogate[free] - 1
    constants = fit_constants(found)
    assert np.flatnonzero(constants.infeasible).tolist() == [free]
    assert constants.values == pytest.approx(TRUE, rel=1e-6)
    found.delta[free] = found.surrogate[free] + 1  # a rise with all penalties 0 is no fault
    assert not fit_constants(found).infeasible.any()


def test_constants_beyond_noise_are_smaller(rng):
    found, _ = planted(rng)
    beyond = fit_constants(found, 0.05)
    assert holds(found, beyond.values.values()).min() == pytest.approx(-0.05)
    assert sum(beyond.values.values()) < sum(TRUE.values())


def test_terms_add_up_between_measured_returns():
    rows = [
        {"surrogate": s, "policy_kl": k, "prior_kl": p, "q_loss": q, "return_train": j, "env_steps": 10 * (i + 1)}
        for i, (s, k, p, q, j) in enumerate(
            zip([1, 2, 3, 4], [0.1, 0.2, 0.3, 0.4], [0, -1e-9, 1, 1], [4, 9, 16, 25], [None, 5, None, 15], strict=True)
        )
    ]
    found = terms(rows, training_anchors(rows), gamma=0.75, reward_std=2.0)
    assert (found.first.tolist(), found.last.tolist()) == ([1], [3])
    assert found.delta == pytest.approx([(15 - 5) / 2])
    assert found.surrogate == pytest.approx([(2 + 3) * 4])
    assert found.penalties["policy_kl"] == pytest.approx([0.5])
    assert found.penalties["prior_kl"] == pytest.approx([1 - 1e-9])
    assert found.penalties["eta"] == pytest.approx([3 + 4])
    # An evaluation after 20 steps is of the policy that the third update begins with.
    evaluations = [
        {"env_steps": s, "return_mean": r, "return_std": 3.0, "episodes": 10} for s, r in ((0, 1.0), (20, 2.0), (40, 7))
    ]
    anchors = evaluation_anchors(rows, evaluations)
    assert anchors == [Anchor(0, 1.0, 1.0), Anchor(2, 2.0, 1.0), Anchor(4, 7.0, 1.0)]
    by_evaluation = terms(rows, anchors, 0.75, 2.0)
    assert by_evaluation.surrogate == pytest.approx([12, 28])
    assert by_evaluation.noise == pytest.approx([2**0.5 / 2] * 2)
    plain = [{k: v for k, v in row.items() if k not in ("prior_kl", "q_loss")} for row in rows]
    assert list(terms(plain, anchors, 0.75, 2.0).penalties) == ["policy_kl"]
    # A run that went on without its guide after the third update, and one that lost a row while it had it.
    alone = terms([*rows[:3], plain[3]], anchors, 0.75, 2.0)
    assert alone.penalties["policy_kl"] == pytest.approx([0.3, 0.7])
    assert alone.penalties["prior_kl"] == pytest.approx([0, 1])
    assert alone.penalties["eta"] == pytest.approx([2 + 3, 4])
    with pytest.raises(InputError, match="lacks a finite prior_kl"):
        terms([rows[0], plain[1], *rows[2:]], anchors, 0.75, 2.0)


def test_noise_of_returns_on_a_slope(rng):
    line = np.linspace(0, 50, 4000)
    assert return_noise(line + 3 * rng.standard_normal(4000)) == pytest.approx(3, rel=0.05)
    assert return_noise(line) == pytest.approx(0, abs=1e-9)
    assert np.isnan(return_noise(line[:2]))


def test_the_fitted_scale_is_the_planted_one(rng):
    found, _ = planted(rng)
    assert fitted_scale(found._replace(delta=0.3 * found.surrogate)) == pytest.approx(0.3)
    assert np.isnan(fitted_scale(found._replace(surrogate=np.zeros(60))))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def write_run(folder, rows, evaluations, method="ppo-dap", reward_std=2.0):
    folder.mkdir()
    config = {"task": "Toy-v0", "method": method, "preset": "paper", "prior_hash": None}
    config["config"] = {"gamma": 0.9, "seed": 0, "steps": 1}
    (folder / "config.json").write_text(json.dumps(config))
    for name, table in (("metrics", rows), ("evaluations", evaluations)):
        (folder / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in table))
    moments = {
        "rewards.count": np.array(10.0),
        "rewards.mean": np.zeros(1),
        "rewards.m2": np.array([reward_std**2 * 10]),
    }
    write_tensors(folder / "checkpoints" / "last.safetensors", moments, {"kind": "checkpoint", "format": 1})
    return folder


def rows_of(found, reward_std=2.0, gamma=0.9):
    """Metrics that `terms` reads as `found`."""
    returns = np.append(0, np.cumsum(found.delta)) * reward_std
    names = {"policy_kl": "policy_kl", "prior_kl": "prior_kl", "eta": "q_loss"}
    rows = []
    for k in range(len(found.delta) + 1):
        at = min(k, len(found.delta) - 1)  # of the last update nothing is known: its return comes after the end
        row = {"env_steps": 10 * (k + 1), "iteration": k + 1, "return_train": returns[k]}
        row["surrogate"] = float(found.surrogate[at] * (1 - gamma))
        for name, column in found.penalties.items():
            row[names[name]] = float(column[at] ** 2 if name == "eta" else column[at])
        rows.append(row)
    return rows


def test_a_planted_run_from_its_folder(rng, tmp_path, capsys):
    planted_terms, tight = planted(rng)
    evaluations = [{"env_steps": s, "return_mean": s / 10, "return_std": 1.0, "episodes": 5} for s in (0, 100, 300)]
    found = bound(write_run(tmp_path / "run", rows_of(planted_terms), evaluations))
    training = found.report["readings"]["training"]
    assert training["constants"] == pytest.approx(TRUE, rel=1e-5)
    assert training["binding"] == sorted((tight + 1).tolist())
    assert training["spans"] == 60
    assert found.report["reward_std"] == pytest.approx(2.0)
    assert found.report["readings"]["evaluation"]["spans"] == 2
    assert found.report["readings"]["evaluation"]["delta_mean"] == pytest.approx(15 / 2)
    print_bound(found.report)
    assert "c2 (prior_kl) 300" in capsys.readouterr().out
    bound_figure(found, tmp_path / "bound.png")
    assert (tmp_path / "bound.png").read_bytes().startswith(b"\x89PNG")


def test_a_planted_run_of_ppo_from_its_folder(rng, tmp_path):
    planted_terms, _ = planted(rng, names=NAMES[:1])
    found = bound(write_run(tmp_path / "run", rows_of(planted_terms), [], method="ppo"))
    assert found.report["readings"]["training"]["constants"] == pytest.approx({"c1": 2.0}, rel=1e-5)
    assert list(found.report["readings"]) == ["training"]


def test_a_hopeless_run_says_so(rng, tmp_path, capsys):
    found, _ = planted(rng, n=5, names=NAMES[:1])
    found.penalties["policy_kl"][:] = 0.0
    found.delta[:] = found.surrogate - 1
    report = bound(write_run(tmp_path / "run", rows_of(found), [], method="ppo")).report
    assert report["readings"]["training"]["infeasible"] == [1, 2, 3, 4, 5]
    assert report["readings"]["training"]["constants"] == {"c1": 0.0}
    print_bound(report)
    assert "NO constants can hold in iterations 1, 2, 3, 4, 5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda rows: rows[:1], "no two measured returns"),
        (lambda rows: [], "0 iterations"),
        (lambda rows: [{**row, "return_train": None} for row in rows], "no two measured returns"),
        (lambda rows: [*rows[:-1], {**rows[-1], "policy_kl": None}], "finite policy_kl"),
        (lambda rows: [{**rows[0], "surrogate": float("nan")}, *rows[1:]], "finite surrogate"),
        (lambda rows: [{k: v for k, v in row.items() if k != "prior_kl"} for row in rows], "finite prior_kl"),
    ],
)
def test_runs_that_cannot_be_read(rng, tmp_path, edit, words):
    folder = write_run(tmp_path / "run", edit(rows_of(planted(rng)[0])), [])
    with pytest.raises(InputError, match=words):
        bound(folder)


def test_a_run_without_checkpoint(rng, tmp_path):
    folder = write_run(tmp_path / "run", rows_of(planted(rng)[0]), [])
    (folder / "checkpoints" / "last.safetensors").unlink()
    with pytest.raises(InputError, match="no checkpoint file"):
        bound(folder)
