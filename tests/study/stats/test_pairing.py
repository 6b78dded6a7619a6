"""Tests on pairs against brute force, scipy and textbook figures."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from ppo_dap.errors import InputError
from ppo_dap.study.stats.pairing import cohens_d_paired, holm, paired, paired_wilcoxon, smallest_p


def brute_force(x, y):
    """The p by trying every sign of every difference that is not 0; ranks by counting."""
    d = [a - b for a, b in zip(x, y, strict=True) if a != b]
    ranks = [sum(abs(e) < abs(f) for e in d) + (sum(abs(e) == abs(f) for e in d) + 1) / 2 for f in d]
    seen = abs(sum(r * math.copysign(1, f) for r, f in zip(ranks, d, strict=True)))
    patterns = itertools.product((-1, 1), repeat=len(d))
    far = [abs(sum(r * s for r, s in zip(ranks, signs, strict=True))) >= seen for signs in patterns]
    return sum(far) / len(far)


def samples(n, whole, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(1, 2, n), rng.normal(0, 2, n)
    return (np.round(x), np.round(y)) if whole else (x, y)


@pytest.mark.parametrize("n", range(1, 10))
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_wilcoxon_against_every_sign_pattern(n, whole, seed):
    x, y = samples(n, whole, seed)
    assert paired_wilcoxon(x, y) == pytest.approx(brute_force(x, y), abs=1e-12)


@pytest.mark.parametrize("n", [3, 5, 8, 20, 45])
def test_wilcoxon_against_scipys_table(n):
    x, y = samples(n, False, n)
    assert paired_wilcoxon(x, y) == pytest.approx(stats.wilcoxon(x, y, method="exact").pvalue, rel=1e-9)


@pytest.mark.parametrize("n", [5, 8, 11])
def test_wilcoxon_with_ties_and_zeros_against_scipys_permutations(n):
    x, y = samples(n, True, n)
    assert len(set(abs(x - y))) < n
    every = stats.PermutationMethod(n_resamples=2**n)
    assert paired_wilcoxon(x, y) == pytest.approx(stats.wilcoxon(x, y, method=every).pvalue, rel=1e-9)


def test_a_table_that_knows_no_ties_is_found():
    """The planted fault: scipy's exact table for differences with ties is not what all sign patterns say."""
    x, y = np.array([1.0, 1, 1, -2, 3, 3]), np.zeros(6)
    with np.errstate(all="ignore"):
        planted = stats.wilcoxon(x, y, method="exact").pvalue
    assert planted != pytest.approx(brute_force(x, y), abs=1e-3)
    assert paired_wilcoxon(x, y) == pytest.approx(brute_force(x, y), abs=1e-12)


def test_wilcoxon_by_the_printed_table():
    """Wilcoxon's table: at n = 8 a rank sum of 3 has two-sided p 0.0391 (10 of 256), at n = 6 of 0 p 0.03125."""
    assert paired_wilcoxon([-1.0, -2, 3, 4, 5, 6, 7, 8], np.zeros(8)) == 10 / 256
    assert paired_wilcoxon(np.arange(1.0, 7), np.zeros(6)) == 0.03125


def test_wilcoxon_of_many_pairs_is_near_its_normal_limit():
    x, y = samples(300, False, 2)
    assert paired_wilcoxon(x, y / 2 + 0.7) == pytest.approx(
        stats.wilcoxon(x, y / 2 + 0.7, method="asymptotic").pvalue, rel=0.02
    )


def test_zeros_are_dropped():
    x, y = np.array([5.0, 5, 1, 2, 4]), np.array([5.0, 5, 0, 0, 0])
    assert paired_wilcoxon(x, y) == paired_wilcoxon(x[2:], y[2:]) == 0.25
    assert paired_wilcoxon(y, y) == 1


@pytest.mark.parametrize("n", range(1, 12))
def test_no_p_is_below_the_smallest(n):
    assert paired_wilcoxon(np.arange(1.0, n + 1), np.zeros(n)) == smallest_p(n) == 2 / 2**n
    found = [paired_wilcoxon(*samples(n, whole, seed)) for whole in (False, True) for seed in range(20)]
    assert smallest_p(n) <= min(found) <= max(found) <= 1
    if n == 5:
        x = np.array([3.0, 4, 5, 6, 7.5])
        assert stats.ttest_rel(x, np.zeros(5)).pvalue < smallest_p(5)  # what the bound would catch


def test_holm_by_hand():
    """Four tests, 0.01, 0.04, 0.03, 0.005: 4 x 0.005, 3 x 0.01, 2 x 0.03, and 0.04 no smaller than that."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_holm_is_monotone_and_capped():
    assert holm([0.5, 0.6, 0.01]) == pytest.approx([1, 1, 0.03])
    assert holm([0.2]) == pytest.approx([0.2])
    assert holm([]).tolist() == []
    assert holm([0.02, 0.02, 0.02]) == pytest.approx([0.06] * 3)


def test_holm_rejects_what_its_definition_rejects():
    """By the definition: go up from the smallest, reject while p_i <= level / (m - i + 1), stop at the first that is
    not. Never fewer than Bonferroni, never more than no correction."""
    rng = np.random.default_rng(0)
    for m in range(1, 9):
        p, level = rng.uniform(0, 0.1, m), 0.05
        rejected = set()
        for i, which in enumerate(np.argsort(p)):
            if p[which] > level / (m - i):
                break
            rejected.add(int(which))
        assert set(np.flatnonzero(holm(p) <= level).tolist()) == rejected
        assert set(np.flatnonzero(p * m <= level)) <= rejected <= set(np.flatnonzero(p <= level))


def test_cohens_d_against_the_t_statistic():
    """The paired t is d_z times sqrt(n)."""
    x, y = samples(12, False, 0)
    assert cohens_d_paired(x, y) * math.sqrt(12) == pytest.approx(stats.ttest_rel(x, y).statistic)
    assert cohens_d_paired([2.0, 4], [1.0, 1]) == pytest.approx(2 / math.sqrt(2))


def test_cohens_d_of_equal_differences_is_not_told():
    assert math.isnan(cohens_d_paired([2.0, 3], [1.0, 2]))
    assert math.isnan(cohens_d_paired([2.0], [1.0]))


def row(label, seed, alc, task="Hopper-v5", steps=200_000):
    run = f"runs/{task}-{label}-{seed}-{steps}"
    return {"run": run, "label": label, "task": task, "seed": seed, "steps": steps, "alc": alc}


def test_pairs_agree_in_task_seed_and_steps():
    rows = [row("ppo", seed, float(seed)) for seed in (3, 1, 2)]
    rows += [row("dap", seed, 10.0 + seed) for seed in (1, 2, 3)]
    rows += [row("dap", 1, 21.0, "Ant-v5"), row("ppo", 1, 11.0, "Ant-v5"), row("other", 1, 5.0)]
    pairs = paired(rows, "dap", "ppo", "alc")
    assert {task: values.tolist() for task, values in pairs.values.items()} == {
        "Ant-v5": [[21, 11]],
        "Hopper-v5": [[11, 1], [12, 2], [13, 3]],
    }
    assert pairs.unpaired == {}


def test_runs_in_no_pair_are_named():
    rows = [row("ppo", 0, 1.0), row("ppo", 1, 2.0), row("ppo", 2, 3.0), row("ppo", 4, 3.0)]
    rows += [row("dap", 0, 1.0, steps=1000), row("dap", 1, 5.0), row("dap", 2, None), row("dap", 3, 4.0)]
    pairs = paired(rows, "dap", "ppo", "alc")
    assert pairs.values["Hopper-v5"].tolist() == [[5, 2]]
    assert sorted(pairs.unpaired["Hopper-v5"]) == [
        "dap without alc, 200,000 steps: seed 2",
        "dap without ppo, 1,000 steps: seed 0",
        "dap without ppo, 200,000 steps: seed 3",
        "ppo without dap, 200,000 steps: seed 0, 2, 4",
    ]


def test_the_clocks_of_two_processors_are_not_compared():
    rows = [row(label, seed, 1.0) | {"seconds_per_step": 2.0} for label in ("ppo", "dap") for seed in (0, 1)]
    rows = [own | {"processor": "A" if own["label"] == "ppo" or own["seed"] else "B"} for own in rows]
    pairs = paired(rows, "dap", "ppo", "seconds_per_step")
    assert pairs.values["Hopper-v5"].tolist() == [[2, 2]]
    assert sorted(pairs.unpaired["Hopper-v5"]) == [
        "dap without ppo on its processor, 200,000 steps: seed 0",
        "ppo without dap on its processor, 200,000 steps: seed 0",
    ]
    assert len(paired(rows, "dap", "ppo", "alc").values["Hopper-v5"]) == 2


def test_two_runs_for_one_place_are_refused():
    rows = [row("ppo", 0, 1.0), row("dap", 0, 1.0), row("ppo", 0, 2.0) | {"run": "runs/again"}]
    with pytest.raises(InputError, match=r"run runs/again .* of runs/Hopper-v5-ppo-0-200000 .*seed 0"):
        paired(rows, "dap", "ppo", "alc")
    assert paired(rows[:2], "dap", "ppo", "alc").values["Hopper-v5"].tolist() == [[1, 1]]


BAD = {
    "lengths": (lambda: paired_wilcoxon([1.0, 2], [1.0]), "matched run by run, not 2 and 1"),
    "not finite": (lambda: paired_wilcoxon([1.0, math.inf], [1.0, 2]), "x must be finite, not inf"),
    "no pairs": (lambda: smallest_p(0), "n must be a number of pairs from 1 on, not 0"),
    "no probability": (lambda: holm([0.5, 1.2]), "p_values must be probabilities"),
    "nan": (lambda: holm([math.nan]), "p_values must be probabilities"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    call, words = BAD[case]
    with pytest.raises(InputError, match=words):
        call()
