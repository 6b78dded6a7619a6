"""The parts of the report's page as HTML. Whatever is text goes through `escaped`; labels and paths are strangers'."""

from __future__ import annotations

import base64
import html
import os
import re
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path

from ppo_dap.methods import get_method
from ppo_dap.study.plots.curves import STYLES
from ppo_dap.study.report.runs import (
    Entry,
    Found,
    best_first,
    by,
    cost,
    differences,
    finished,
    interval_text,
    seeds_text,
)
from ppo_dap.study.stats.compare import COLUMNS, Shown
from ppo_dap.study.stats.measures import EPOCH
from ppo_dap.study.stats.summary import AUDIT, cells, columns
from ppo_dap.study.store.show import duration

DASHES = {"-": "", "--": "7 4", "-.": "9 3 2 3", ":": "2 3"}
"""Matplotlib's dashes as SVG has them; a tuple holds its own."""
WORDS = ("task", "method", "seeds", "audit", "run", "declared", "claim", "clause", "instead")
"""Columns that are text and not numbers."""
MIME = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
VOID = ("img",)
"""Elements without an end."""


class Html(str):
    """Text that is HTML already."""


def escaped(text: str) -> Html:
    """Text as HTML; what is HTML stays as it is."""
    return text if isinstance(text, Html) else Html(html.escape(text))


def tag(name: str, content: str, **attributes: str) -> Html:
    """An element around escaped content; `class_` is `class`, and `data_x` is `data-x`."""
    said = "".join(f' {key.strip("_").replace("_", "-")}="{html.escape(v)}"' for key, v in attributes.items())
    return Html(f"<{name}{said}>" if name in VOID else f"<{name}{said}>{escaped(content)}</{name}>")


def joined(parts: Sequence[str], between: str = "\n") -> Html:
    """Escaped parts in a row."""
    return Html(between.join(map(escaped, parts)))


def listed(items: Sequence[str], **attributes: str) -> Html:
    """A list."""
    return tag("ul", joined([tag("li", item) for item in items]), **attributes)


def table(caption: str, heads: Sequence[str], rows: Sequence[Sequence[str]], wide: bool = False) -> Html:
    """A table. On a narrow screen a row is a block, so every cell carries its head; a `wide` table scrolls instead, and
    draws a bar for each percentage.
    """
    # The roles are what a screen reader goes by when the layout is no table's any more.
    kinds = ["words" if head in WORDS else "number" for head in heads]
    head = [
        tag("th", text, scope="col", role="columnheader", class_=kind) for text, kind in zip(heads, kinds, strict=True)
    ]
    body = []
    for row in rows:
        line = [tag("th", row[0], scope="row", role="rowheader")]
        for name, kind, text in zip(heads[1:], kinds[1:], row[1:], strict=True):
            share = {"style": f"--share:{text}"} if wide and re.fullmatch(r"[\d.]+%", text) else {}
            line.append(tag("td", text, role="cell", class_=kind, data_head=name, **share))
        body.append(tag("tr", joined(line, ""), role="row"))
    parts = [
        tag("caption", caption),
        tag("thead", tag("tr", joined(head, ""), role="row"), role="rowgroup"),
        tag("tbody", joined(body), role="rowgroup"),
    ]
    # What scrolls must be reachable by keyboard.
    scrolls = {"class_": "table wide", "tabindex": "0", "role": "region", "aria_label": caption}
    return tag("div", tag("table", joined(parts), role="table"), **(scrolls if wide else {"class_": "table stack"}))


def printed(figure: str) -> str:
    """What a terminal shows as +-."""
    return figure.replace("+-", "±")


def style(place: int) -> dict[str, str]:
    """Colour and dash of the `place`-th method; as many differ as there are pairs of the two."""
    count = len(STYLES)
    dash = STYLES[(place + place // count) % count][1]
    return {
        "colour": STYLES[place % count][0],
        "dash": DASHES[dash] if isinstance(dash, str) else " ".join(str(3 * length) for length in dash[1]),
    }


def counted(number: int, what: str) -> str:
    """A number of things."""
    return f"{number} {what}{'s' * (number != 1)}"


def section_name(task: str, steps: int) -> str:
    """What one task and budget is called."""
    return f"{task}, {steps:,} steps"


def results(entries: Sequence[Entry], epochs: float) -> Html:
    """The table of one task and budget, a row a method, the best first; `entries` may have unfinished ones."""
    groups = by(finished(entries), "label")
    heads = ["method", "seeds", "n", f"ALC@{epochs:g}", "last return", "training a run", "audit"]
    rows = []
    for label in best_first(groups):
        own = groups[label]
        numbers = [printed(interval_text(own, metric)) for metric in ("alc", "last_return")]
        seconds = sum(entry.row["seconds"] for entry in own) / len(own)
        rows.append([label, seeds_text(own), str(len(own)), *numbers, duration(seconds), verdicts(own)])
    caption = "Mean ± 95% interval (Student's t) over n finished runs, a seed each; one run has no interval."
    if not any(entry.row["alc"] is not None for entry in finished(entries)):
        steps = entries[0].row["steps"]
        caption += f" No run reaches {epochs * EPOCH:,.0f} steps: --epochs {steps / EPOCH:g} or less has an ALC."
    return table(caption, heads, rows)


def verdicts(entries: Sequence[Entry]) -> Html:
    """The audit's verdict on some runs, with the number of each where they differ."""
    counts: dict[str, int] = {}
    for entry in entries:
        said = AUDIT[entry.row["audit"], entry.row["declared"]]
        counts[said] = counts.get(said, 0) + 1
    bad = AUDIT[False, False]
    parts = [
        tag("span", said if len(counts) == 1 else f"{said} ({count})", class_="error" if said == bad else "plain")
        for said, count in counts.items()
    ]
    return joined(parts, ", ")


def comparison(tables: Sequence[Shown], notes: Sequence[str]) -> Html:
    """The tables of `compare.shown`; `notes` say what is not in them."""
    told = (
        "change: of the mean over the pairs, with its bootstrap interval. P(better): how likely a run of the method is "
        "above one of the baseline. p: exact Wilcoxon signed-rank test on pairs of task, seed and steps; least p: the "
        "smallest that so many pairs can give; Holm p: adjusted over the tasks, not over the methods."
    )
    found = [tag("p", told, class_="soft")] if tables else []
    for part in tables:
        lines = [[printed(cell) for cell in line] for line in (COLUMNS, *part.cells)]
        heads, *rows = [[line[1], line[0], *line[2:]] for line in lines]  # the method heads the row
        found.append(table(part.title, heads, rows, wide=True))
        found += [listed(part.over_tasks)] if part.over_tasks else []
        if part.unpaired:
            summary = tag("summary", f"Runs in no pair ({len(part.unpaired)})")
            found.append(tag("details", joined([summary, listed(part.unpaired)])))
    return joined([*found, *(tag("p", note, class_="warning") for note in notes)])


def audit(entries: Sequence[Entry], epochs: float) -> Html:
    """The verdicts: what failed, what was checked, and each run."""
    failed = [
        f"{entry.row['run']}: {claim.clause} {claim.statement}: {claim.evidence}"
        for entry in entries
        for claim in entry.claims
        if not claim.holds
    ]
    checked: dict[tuple[str, str], list[bool]] = {}
    for entry in entries:
        for claim in entry.claims:
            checked.setdefault((claim.clause, claim.statement), []).append(claim.holds)
    by_clause = sorted(checked.items(), key=lambda item: item[0][0])
    claims = [[text, clause, f"{sum(held)} of {len(held)}"] for (clause, text), held in by_clause]
    heads = ["run", *columns(epochs), "declared"]
    heads[heads.index("x PPO")], heads[heads.index("training") + 1] = "ALC x PPO", "training x PPO"
    rows = [[entry.row["run"], *cells(entry.row), _declared(entry)] for entry in entries]
    caption = "Each run as `ppo-dap summary` prints it, and what its method's row declares."
    parts = [table("Definition 1, claim by claim.", ["claim", "clause", "holds in"], claims)]
    if failed:
        parts = [tag("p", "Claims that do not hold:"), listed(failed, class_="error"), *parts]
    summary = tag("summary", f"Each of {counted(len(entries), 'run')}")
    return joined([*parts, tag("details", joined([summary, table(caption, heads, rows, wide=True)]))])


def _declared(entry: Entry) -> str:
    strict = get_method(entry.row["method"]).strictly_on_policy
    return "strictly on-policy" if strict else "not strictly on-policy"


def costs(entries: Sequence[Entry]) -> Html:
    """Where an iteration's time went, a table a task and budget."""
    parts = []
    for (task, steps), of_task in by(entries, "task", "steps").items():
        groups = by(of_task, "label")
        found = {label: each for label in best_first(groups) if (each := cost(groups[label]))}
        rows = [
            [label, f"{1e3 * each.seconds:,.0f} ms", *(_share(line.share) for line in each.lines)]
            for label, each in found.items()
        ]
        if rows:
            lines = next(iter(found.values())).lines
            heads = [f"device: {line.name}" if line.beside else line.name for line in lines]
            parts.append(table(section_name(task, steps), ["method", "an iteration", *heads], rows, wide=True))
    if not parts:
        return tag("p", "No run has an iteration after its first, which compiles.")
    told = (
        "Shares of the wall-clock of all iterations but the first, which compiles. The host's add up to 100%; what the "
        "device does goes on beside it while the host collects the next rollout."
    )
    return joined([tag("p", told, class_="soft"), *parts])


def _share(share: float) -> str:
    return "-" if share == 0 else "<1%" if share < 0.005 else f"{share:.0%}"


def settings(entries: Sequence[Entry]) -> Html:
    """What is not the same in all runs: the most frequent values once, and by method what is another one."""
    found = differences(entries)
    if not found:
        return tag("p", "None: the runs differ in their seeds at most.")
    usual = {name: max(values, key=lambda value: sum(values[value].values())) for name, values in found}
    rows = []
    for label, own in by(entries, "label").items():
        told = []
        for name, values in found:
            counts = {value: labels[label] for value, labels in values.items() if label in labels}
            if set(counts) != {usual[name]}:
                some = len(counts) > 1
                told.append(f"{name}=" + ", ".join(f"{v} ({n} runs)" if some else v for v, n in counts.items()))
        rows.append([label, str(len(own)), "; ".join(told) or "-"])
    most = "; ".join(f"{name}={value}" for name, value in usual.items())
    caption = f"Seeds aside. Most frequent: {most}."
    return table(caption, ["method", "runs", "instead"], rows)


def left_out(found: Found) -> Html:
    """Runs that are not finished, and folders that could not be read."""
    unfinished = [
        f"{entry.row['run']}: {entry.label}, {entry.row['task']}, seed {entry.row['seed']}, at "
        f"{entry.metrics[-1]['env_steps'] if entry.metrics else 0:,} of {entry.row['steps']:,} steps"
        for entry in found.entries
        if not entry.row["finished"]
    ]
    unreadable = [f"{folder}: {reason}" for folder, reason in found.unreadable.items()]
    parts = []
    if unfinished:
        told = "Not finished. They are drawn among the single seeds and count for no mean, interval or test:"
        parts += [tag("p", told), listed(unfinished)]
    if unreadable:
        parts += [tag("p", "Could not be read:", class_="error"), listed(unreadable)]
    return joined(parts)


def videos(entries: Sequence[Entry], out: Path, limit: int) -> Html:
    """Films in the run folders: in the page while they are at most `limit` bytes together, else linked by their path
    from the page's folder.
    """
    figures, left = [], limit
    for entry in entries:
        for path in sorted(p for p in entry.run.folder.rglob("*") if p.suffix.lower() in MIME and p.is_file()):
            size, mime = path.stat().st_size, MIME[path.suffix.lower()]
            told = f"{entry.label}, {entry.row['task']}, seed {entry.row['seed']}: {path}"
            if size > left:
                link = urllib.parse.quote(os.path.relpath(path.resolve(), out.resolve().parent).replace(os.sep, "/"))
                film = tag("a", f"open ({size / 1e6:,.1f} MB, not in this page)", href=link)
            else:
                left -= size
                data = f"data:{mime};base64,{base64.b64encode(path.read_bytes()).decode()}"
                film = (
                    tag("img", "", src=data, alt=told)
                    if mime.startswith("image/")
                    else tag("video", "", src=data, controls="", preload="metadata", aria_label=told)
                )
            figures.append(tag("figure", joined([film, tag("figcaption", told)])))
    return joined(figures)


def facts(entries: Sequence[Entry], here: Mapping[str, str]) -> Html:
    """Versions of the runs, and what made the page."""
    lines = []
    for package in dict.fromkeys(name for entry in entries for name in entry.run.config.get("versions", {})):
        used = {str(entry.run.config.get("versions", {}).get(package)) for entry in entries}
        lines.append(f"{package} {', '.join(sorted(used))}")
    told = {"versions of the runs": "; ".join(lines) or "not recorded", **here}
    return tag("dl", joined([tag(*part) for name, text in told.items() for part in (("dt", name), ("dd", text))]))
