"""What is read off a table."""

import csv
import io

WARM = "PPO-DAP (tuned-warm)"


def body(table):
    """The lines of each table by what stands in their words, and the heads."""
    found = {}
    for part in (table, *table.more):
        for line in part.lines:
            found[(part.title, *line[: part.words])] = dict(zip(part.columns, line, strict=True))
    return found


def read(table):
    return list(csv.DictReader(io.StringIO(table.csv())))


def hopper(label, seed=None):
    return label["task"] == "Hopper-v5" and seed in (None, label["seed"])


HOPPER = {"PPO": (100, 110, 120), "PPO-DAP": (150, 120, 180), "PPO-ARC": (140, 150, 160)}
