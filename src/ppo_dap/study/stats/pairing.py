"""Two methods on the same seeds: which runs make pairs, and tests and effect sizes on them (5.1.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.study.stats.measures import Values, matched

Row = Mapping[str, Any]
"""A row of `summary.summarise`."""
CLOCKED = ("seconds_per_step", "steps_per_second")
"""What depends on the processor as much as on the method."""


@dataclass(frozen=True)
class Pairs:
    """Matched runs of two methods."""

    values: Mapping[str, Float[np.ndarray, "_ 2"]]
    """Task -> a row a pair, by steps and seed: the first method's figure and the second's. No task is empty."""
    unpaired: Mapping[str, Sequence[str]]
    """Task -> the runs that are in no pair, in words."""


def paired(rows: Sequence[Row], method_a: str, method_b: str, key: str) -> Pairs:
    """`key` of the runs of two methods (their labels) that agree in task, seed and steps, and for what is `CLOCKED` in
    processor.

    A run without a partner, or whose figure is None, is left out and named in `unpaired`. Raises `InputError` for two
    runs of one method with the same task, seed and steps: which of them counts is not ours to say.
    """
    a, b = (_by_seed(rows, method) for method in (method_a, method_b))
    values: dict[str, list[tuple[float, float]]] = {}
    unpaired: dict[tuple[str, str], list[str]] = {}
    for task, steps, seed in sorted(a.keys() | b.keys()):
        one, other = (side.get((task, steps, seed)) for side in (a, b))
        apart = key in CLOCKED and one and other and one.get("processor") != other.get("processor")
        if one is not None and other is not None and None not in (one[key], other[key]) and not apart:
            values.setdefault(task, []).append((one[key], other[key]))
            continue
        for method, row, partner in ((method_a, one, method_b), (method_b, other, method_a)):
            if row is not None:
                lack = key if row[key] is None else f"{partner} on its processor" if apart else partner
                lack = f"{method} without {lack}, {steps:,} steps"
                unpaired.setdefault((task, lack), []).append(str(seed))
    words: dict[str, list[str]] = {}
    for (task, lack), seeds in unpaired.items():
        words.setdefault(task, []).append(f"{lack}: seed {', '.join(seeds)}")
    return Pairs({task: np.array(each, np.float64) for task, each in values.items()}, words)


def _by_seed(rows: Sequence[Row], method: str) -> dict[tuple[str, int, int], Row]:
    found: dict[tuple[str, int, int], Row] = {}
    for row in rows:
        if row["label"] != method:
            continue
        name = row["task"], row["steps"], row["seed"]
        if name in found:
            raise InputError(
                f"run {row['run']} has task, seed, steps and settings of {found[name]['run']} ({row['task']}, "
                f"{method}, seed {row['seed']}): name one of them, or compare those of another prior or logs apart"
            )
        found[name] = row
    return found


def paired_wilcoxon(x: Values, y: Values) -> float:
    """Exact two-sided p of the signed-rank test on matched runs (Wilcoxon 1945; 5.1.3).

    Under the null each difference is as likely of either sign: p is the share of all 2^m sign patterns whose rank sum
    lies as far from its mean as the seen one, counted exactly at any m. Tied differences share their mean rank. Zeros
    are dropped before ranking, as Wilcoxon did and scipy and R do, so m is the number of pairs that differ; with none,
    p is 1. It is never below `smallest_p` of the pairs. Raises `InputError` if `x` and `y` differ in length.
    """
    from scipy.stats import rankdata

    pairs = matched(x, y)
    differences = pairs[:, 0] - pairs[:, 1]
    differences = differences[differences != 0]
    # Twice a mean rank is whole, so the distribution of their sum is a sequence of shares. scipy's exact table knows no
    # ties, and its permutations are too many from some 20 pairs on.
    ranks = np.rint(2 * rankdata(np.abs(differences))).astype(int)
    shares = np.ones(1)
    for rank in ranks:
        shares = (np.pad(shares, (0, rank)) + np.pad(shares, (rank, 0))) / 2
    far = np.abs(2 * np.arange(len(shares)) - ranks.sum())
    return float(shares[far >= abs(2 * ranks[differences > 0].sum() - ranks.sum())].sum())


def smallest_p(n: int) -> float:
    """The smallest p that `paired_wilcoxon` can give for n pairs: 2 / 2^n, when all differ in the same direction."""
    if n < 1:
        raise InputError(f"n must be a number of pairs from 1 on, not {n}")
    return 2.0 ** (1 - n)


def holm(p_values: Values) -> Float[np.ndarray, " _"]:
    """Adjusted p of each hypothesis, in the order given (Holm 1979, step-down): no assumption on their dependence.

    The i-th smallest of m is multiplied by m - i + 1, made no smaller than the ones before, and capped at 1. Raises
    `InputError` for a value that is no probability.
    """
    p = np.asarray(p_values, np.float64)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise InputError(f"p_values must be probabilities from 0 to 1, not {p.tolist()}")
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1) if len(p) else p
    return adjusted


def cohens_d_paired(x: Values, y: Values) -> float:
    """d_z (Cohen 1988): the mean difference of matched runs over the standard deviation of the differences.

    NaN for fewer than two pairs, or where all differences are equal. It is not the d of two groups: it grows with the
    correlation of the pairs.
    """
    pairs = matched(x, y)
    differences = pairs[:, 0] - pairs[:, 1]
    if len(differences) < 2 or np.ptp(differences) == 0:
        return math.nan
    return float(differences.mean() / differences.std(ddof=1))
