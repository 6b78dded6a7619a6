"""Numbers that the paper (arXiv 2409.01427v6) prints, by the place where they stand.

Arms have the names of the studies' arms, tasks those of the catalogue; what goes over several tasks has none. The
paper measured on -v2 and -v3 tasks with logs that are not ours, and its tables disagree on one method's returns
(Walker2d with PPO: 766.5 in Table 4, 2,850 in Tables 5 and 6), so what can be compared is changes and costs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_TASKS = (
    "Ant-v5", "HalfCheetah-v5", "Hopper-v5", "HumanoidStandup-v5", "Pusher-v5", "Striker-v2", "Swimmer-v5",
    "Walker2d-v5",
)  # fmt: skip


class Printed(NamedTuple):
    """A number as it is printed; NaN where the paper has none."""

    value: float = math.nan
    spread: float = math.nan
    """Half-width of the 95% interval; in Table 7 the dispersion across tasks."""


class Claim(NamedTuple):
    """What the text says of a number: where, and from which value to which."""

    place: str
    low: float
    high: float
    words: str


CLAIMS = {
    "best": Claim("5.3.1", 6, 6, "best or tied with the best on 6 of 8 tasks"),
    "shift": Claim("5.5 (2), Fig. 10", 200, 300, "with f 10 or 20 final returns are 200 to 300 higher than with less"),
    "high_q": Claim("5.5 (3), Fig. 11", 0.3, 0.4, "guidance raises the share of high-Q candidates by 30 to 40%"),
    "kl_ratio": Claim("5.5 (4)", 0.0, 0.1, "prior-KL is far below policy-KL, often by an order of magnitude"),
    "oglr": Claim("5.8", 0.0, 0.0, "numerical noise"),
    "spr": Claim("5.8", 1.0, 1.0, "close to 1.0"),
    "pgshare": Claim("5.8", 0.9, 1.0, "typically 0.9 to 1.0"),
}
"""5.6 and 5.7 print no result in numbers."""

_METHODS = ("PPO", "PPO-DAP", "PPO-GC", "PPO-ARC", "ABPPO")
_TABLE_4 = (
    (183.5, 102.0, 211.4, 114.4, 196.0, 94.9, 211.1, 122.9, 182.1, 108.7),
    (882.6, 149.5, 1027.1, 112.0, 792.7, 109.1, 1027.2, 124.5, 871.8, 113.0),
    (1429.5, 101.0, 1542.9, 113.4, 1453.3, 90.4, 1532.9, 121.7, 1423.8, 109.9),
    (80524.7, 91.7, 83174.0, 101.1, 79885.4, 97.8, 82174.7, 118.0, 82096.3, 107.9),
    (-52.7, 93.3, -51.1, 115.1, -51.4, 101.2, -51.1, 117.5, -54.2, 110.9),
    (-253.6, 103.0, -227.3, 117.0, -253.9, 106.4, -219.3, 100.9, -249.0, 105.5),
    (84.2, 91.0, 95.4, 114.8, 89.6, 103.7, 94.0, 106.4, 95.1, 113.2),
    (766.5, 98.6, 906.3, 102.3, 664.1, 95.9, 776.3, 100.4, 905.3, 103.0),
)  # fmt: skip
"""A row a task: mean and half-width of each method."""

_FOUR = ("Walker2d-v5", "HalfCheetah-v5", "Hopper-v5", "HumanoidStandup-v5")
_TABLE_5 = {
    ("Table 5(a)", "alc"): (
        (1900, 90, 2050, 85, 0.079, 0.038),
        (1800, 80, 1925, 85, 0.069, 0.071),
        (1050, 70, 1100, 75, 0.048, 0.114),
        (74_000, 1800, 75_500, 1700, 0.020, 0.089),
    ),
    ("Table 5(b)", "last_return"): (
        (2850, 110, 3030, 100, 0.063, 0.049),
        (2350, 120, 2470, 130, 0.051, 0.092),
        (1500, 90, 1560, 100, 0.040, 0.122),
        (80_600, 1000, 82_300, 1100, 0.021, 0.065),
    ),
}
"""A row a setting: PPO, PPO-DAP, the change and its p."""

_TABLE_6 = {
    "PPO": (math.nan, math.nan, 2850, 110, 0.0, math.nan, 1900, 90, 0.0, math.nan),
    "No-PET": (1.0, 1.0, 3000, 100, 0.053, math.nan, 2100, 85, 0.105, math.nan),
    "PET f=5": (1.10, 1.03, 3040, 98, 0.067, 0.013, 2120, 82, 0.116, 0.010),
    "PET f=10": (1.17, 1.05, 3070, 95, 0.077, 0.023, 2150, 80, 0.132, 0.024),
    "PET f=20": (1.22, 1.08, 3090, 92, 0.084, 0.030, 2170, 78, 0.142, 0.033),
}
"""Walker2d. Wall-clock and memory x No-PET; final return, its change over PPO and over No-PET; the same of ALC@40."""

_TABLE_7 = {
    "PPO": (1.00, 0.00, 1.00, 0.00, 1.00, 0.00),
    "PPO + BC": (0.99, 0.01, 1.01, 0.01, 1.00, 0.00),
    "PPO-DAP": (0.86, 0.04, 1.18, 0.04, 1.05, 0.02),
    "No-VG": (0.90, 0.03, 1.12, 0.03, 1.03, 0.01),
    "No-PET": (0.91, 0.03, 1.10, 0.03, 1.03, 0.02),
    "Diffusion-NoVG": (0.89, 0.03, 1.14, 0.03, 1.04, 0.01),
    "VAE + PPO": (0.95, 0.02, 1.08, 0.02, 1.02, 0.01),
}
"""Throughput, wall-clock and peak memory, x PPO: mean and dispersion across eight tasks."""


def _all() -> dict[tuple[str, str, str, str], Printed]:
    found: dict[tuple[str, str, str, str], tuple[float, ...]] = {}
    for task, row in zip(_TASKS, _TABLE_4, strict=True):
        for i, method in enumerate(_METHODS):
            found["Table 4", "last_return", task, method] = row[2 * i : 2 * i + 2]
    for (place, metric), rows in _TABLE_5.items():
        for task, row in zip(_FOUR, rows, strict=True):
            found[place, metric, task, "PPO"] = row[:2]
            found[place, metric, task, "PPO-DAP"] = row[2:4]
            found[place, "change", task, "PPO-DAP"] = row[4:5]
            found[place, "p", task, "PPO-DAP"] = row[5:6]
    for arm, row in _TABLE_6.items():
        where = "Table 6", "Walker2d-v5", arm
        for measure, *numbers in (
            ("seconds_per_step", row[0]), ("peak_mib", row[1]),
            ("last_return", *row[2:4]), ("last_return over PPO", row[4]), ("last_return over No-PET", row[5]),
            ("alc", *row[6:8]), ("alc over PPO", row[8]), ("alc over No-PET", row[9]),
        ):  # fmt: skip
            found[where[0], measure, *where[1:]] = tuple(numbers)
    for arm, row in _TABLE_7.items():
        for i, measure in enumerate(("steps_per_second", "seconds_per_step", "peak_mib")):
            found["Table 7", measure, "", arm] = row[2 * i : 2 * i + 2]
    return {name: Printed(*map(float, numbers)) for name, numbers in found.items()}


_PRINTED = _all()


def printed(place: str, measure: str, task: str, arm: str) -> Printed:
    """The number at that place; NaN where there is none."""
    return _PRINTED.get((place, measure, task, arm), Printed())


def printed_change(task: str, arm: str) -> float:
    """Relative change over PPO, from the means of Table 4, which prints none; over |PPO| (5.3.4)."""
    (of, _), (ppo, _) = (printed("Table 4", "last_return", task, name) for name in (arm, "PPO"))
    return (of - ppo) / abs(ppo)
