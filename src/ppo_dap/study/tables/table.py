"""What a table is, and how numbers stand in it: as Markdown to read, as rows to compute with."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
Columns = Mapping[str, Callable[[Row], str]]
"""Head of a column -> what it shows of a row."""
LEVEL = 0.05
"""Above it a p says nothing; where the pairs cannot give less, that is said in its place."""
READ = (
    "n: runs, a seed each; of changes, ratios and differences pairs of seeds. ±: 95% interval (Student's t). In "
    "brackets: 95% interval (bootstrap over pairs of seeds, too narrow where they are few)."
)
TESTED = (
    "p: exact two-sided Wilcoxon test on pairs of seeds; Holm's over the tasks that have pairs; least p: what so many "
    "pairs can give, and where that is not below 0.05, nothing can be told. P(better): that a run beats one of the "
    "baseline's."
)
OTHER_LOGS = "The paper's tasks are -v2 and -v3 and its logs are not ours: compare changes, not returns."
WALL = (
    "Wall-clock: seconds of all iterations after the two that compile, over their environment steps, without those of "
    "over three times the median; x: median of the ratios of pairs on the same processor. Runs of a study share a "
    "machine, so what else was going on is in it; docs/performance.md has the figures of a quiet one."
)


@dataclass(frozen=True)
class Table:
    """A table of a study."""

    title: str
    columns: Sequence[str]
    lines: Sequence[Sequence[str]]
    """What is printed, a text a column; an empty one is not known."""
    rows: Sequence[Row]
    """The numbers behind it, one dict an arm, task and measure."""
    notes: Sequence[str] = ()
    """How it is to be read."""
    words: int = 1
    """So many columns, from the left, are words."""
    made: Sequence[str] = ()
    """What makes its runs, and how many there are."""
    more: Sequence[Table] = ()
    """Further tables of the same study, printed below."""

    def markdown(self) -> str:
        """The table, its notes, and those below."""
        parts = [f"**{self.title}**"]
        if self.lines:
            marks = ["---"] * self.words + ["---:"] * (len(self.columns) - self.words)
            lines = (self.columns, marks, *self.lines)
            parts.append("\n".join(f"| {' | '.join(_escaped(cell) for cell in line)} |" for line in lines))
        else:
            parts.append("No finished run tells of it yet.")
        if notes := [*self.made, *(self.notes if self.lines else ())]:
            parts.append("\n".join(f"- {note}" for note in notes))
        return "\n\n".join([*parts, *(table.markdown() for table in self.more)])

    def csv(self) -> str:
        """The rows of this table and of those below, `table` says of which; what is not known is empty."""
        rows = [{"table": table.title} | row for table in self._every() for row in table.rows]
        file = io.StringIO()
        columns = list(dict.fromkeys(name for row in rows for name in row)) or ["table"]
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
        return file.getvalue()

    def _every(self) -> Iterable[Table]:
        yield self
        for table in self.more:
            yield from table._every()


def listed(
    title: str,
    records: Sequence[Row],
    columns: Columns,
    notes: Sequence[str] = (),
    words: int = 1,
    made: Sequence[str] = (),
    more: Sequence[Table] = (),
) -> Table:
    """A table with a line a record. A record's values are labels and numbers, or rows of `compare` by their measure."""
    lines = [[show(record) for show in columns.values()] for record in records]
    rows = [row for record in records for row in _flat(record)]
    return Table(title, list(columns), lines, rows, notes, words, made, more)


def _flat(record: Row) -> list[Row]:
    """A row a measure that something is known of, with the record's labels."""
    labels = {name: value for name, value in record.items() if not isinstance(value, dict)}
    measures = {name: value for name, value in record.items() if isinstance(value, dict)}
    if not measures:
        return [labels]
    return [labels | {"measure": name} | row for name, row in measures.items() if row.get("n") or row["pairs"]]


def _escaped(cell: str) -> str:
    return cell.replace("|", r"\|")


def _plain(value: Any) -> Any:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, list | tuple):
        return "; ".join(map(str, value))
    return f"{value:.7g}" if isinstance(value, float) else value


def number(value: float | None, form: str) -> str:
    """The number, or nothing."""
    return "" if value is None or math.isnan(value) else format(value, form)


def printed_text(value: float, spread: float = math.nan, form: str = ",g") -> str:
    """A number of the paper's, with what it prints behind +-."""
    text = number(value, form)
    return text if math.isnan(spread) else f"{text} ± {spread:{form.lstrip('+')}}"


def mean_text(row: Row, form: str | None = None, of: int | None = None) -> str:
    """Mean, half-width and n of a row of `compare`; n is left out where it is `of`, which then stands elsewhere."""
    if not row["n"]:
        return ""
    form = form or (",.0f" if abs(row["mean"]) >= 100 else ",.1f")
    return with_n(printed_text(row["mean"], row["half_width"], form), row["n"], of)


def with_n(text: str, n: int, of: int | None = None) -> str:
    """`text` and on how many runs or pairs it rests."""
    return f"{text} (n={n})" if text and n != of else text


def interval_text(value: float, low: float, high: float, form: str) -> str:
    """A number and its interval, where it has one; a bootstrap whose resamples all agree has none to tell."""
    none = math.isnan(low) or math.isclose(low, high, abs_tol=1e-12)
    return number(value, form) + ("" if none else f" [{low:{form}}, {high:{form}}]")


def change_text(row: Row, of: int | None = None) -> str:
    """Relative change of a row of `compare`, its interval and number of pairs."""
    return with_n(interval_text(row["change"], row["change_low"], row["change_high"], "+z.0%"), row["pairs"], of)


def ratio_text(row: Row, of: int | None = None) -> str:
    """A cost over the baseline's, its interval and number of pairs."""
    return with_n(interval_text(row["ratio"], row["ratio_low"], row["ratio_high"], ".2f"), row["pairs"], of)


def difference_text(row: Row, of: int | None = None) -> str:
    """Mean paired difference, its half-width and number of pairs."""
    value, half_width = row["difference"], row["difference_half_width"]
    form = ",.0f" if abs(value) >= 10 else ",.1f"
    return with_n(printed_text(value, half_width, "+" + form), row["pairs"], of)


def better_text(row: Row) -> str:
    """Probability of improvement with its interval; of one pair it says nothing."""
    if row["pairs"] < 2:
        return ""
    return interval_text(row["improvement"], row["improvement_low"], row["improvement_high"], ".2f")


def over_text(row: Row) -> str:
    """The same over tasks, a row of `overall`, and its number of pairs."""
    return with_n(better_text(row), row["pairs"])


def iqm_text(row: Row, name: str = "iqm") -> str:
    """Interquartile mean of a row of `overall`, or the baseline's (`iqm_baseline`), with its interval."""
    return interval_text(row[name], row[f"{name}_low"], row[f"{name}_high"], ".2f")


def across_text(mean: float, deviation: float, tasks: int, form: str, of: int) -> str:
    """A mean over tasks and its standard deviation, and over how many where these are not `of`, all that there are."""
    text = printed_text(mean, deviation, form)
    return f"{text} ({tasks} of {of} tasks)" if text and tasks != of else text


def told(row: Row) -> bool:
    """Whether so many pairs can give a p below `LEVEL` at all."""
    return row["smallest_p"] < LEVEL


def p_text(row: Row) -> str:
    """p, or that so few pairs cannot tell."""
    return "" if math.isnan(row["p"]) else number(row["p"], ".2g") if told(row) else "cannot be told"


def holm_text(row: Row) -> str:
    """Holm's p, where p itself can tell."""
    return number(row["p_holm"], ".2g") if told(row) else ""


def least_text(row: Row) -> str:
    """The smallest p that so many pairs can give."""
    return number(row["smallest_p"], ".2g")


TESTS: Columns = {
    "pairs": lambda row: str(row["pairs"] or ""),
    "P(better)": better_text,
    "p": p_text,
    "Holm p": holm_text,
    "least p": least_text,
}
"""Columns of a row of `compare` that is held against its baseline."""
