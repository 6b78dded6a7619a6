"""`ppo-dap report`: any set of runs as one html file that needs nothing else, neither a server nor a network."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.report import require_html
from ppo_dap.storage import without_nan, write_atomically
from ppo_dap.study.report import parts
from ppo_dap.study.report.parts import Html, escaped, joined, listed, tag
from ppo_dap.study.report.runs import (
    ENOUGH,
    Entry,
    Found,
    Lead,
    best_first,
    by,
    curve,
    doubled,
    finished,
    leader,
    read_runs,
    single,
)
from ppo_dap.study.stats.compare import Shown, compare, overall, shown
from ppo_dap.study.stats.summary import AUDIT
from ppo_dap.study.store.show import duration
from ppo_dap.training.manifest import manifest

ASSETS = Path(__file__).parent / "assets"
PLAIN = "ppo"
"""The baseline where none is named and a finished run has it."""
MEGABYTE = 1_000_000
SAID_OF_RUN = ("run", "task", "method", "label", "preset", "seed", "steps", "finished")
"""What the CSV says of a run, in each of its lines."""


class Written(NamedTuple):
    """What `write_report` put on the page."""

    runs: int
    unfinished: int
    unreadable: int
    fair: bool
    """Whether every run is what its method's row says."""


def write_report(
    folders: Sequence[str | Path],
    path: str | os.PathLike,
    epochs: float = 40.0,
    baseline: str | None = None,
    embed: float = 10.0,
    command: str = "ppo_dap.study.report.page.write_report",
) -> Written:
    """Write the page of the runs in `folders` to `path`, whole or not at all.

    `epochs` is T of ALC@T in 5k steps; `baseline` the method (label) that the others are compared with, by default
    plain PPO where it is there; films of up to `embed` MB together go into the page, others are linked; `command` is
    what the page says it was made by. Folders that hold no run, or a damaged one, are named on the page, and runs that
    are not finished are drawn and named but count for nothing.

    Raises `InputError` for a path that is no .html or cannot be written, a folder that does not exist, folders without
    any run, and a `baseline` that no finished run has or that cannot be compared with.
    """
    path = require_html(path)
    found = read_runs(folders, epochs)
    content = _page(found, path, epochs, _comparison(found, epochs, baseline), int(embed * MEGABYTE), command)
    try:
        write_atomically(path, content.encode())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): must be in a writable folder") from None
    complete = finished(found.entries)
    fair = all(entry.row["declared"] for entry in found.entries)
    return Written(len(found.entries), len(found.entries) - len(complete), len(found.unreadable), fair)


def _comparison(found: Found, epochs: float, baseline: str | None) -> tuple[str, list[Shown], list[str]]:
    """Title, tables, a set of them for each budget, and what is not in them."""
    complete = finished(found.entries)
    labels, against = {entry.label for entry in complete}, baseline or PLAIN
    if against not in labels:
        if baseline is not None:
            raise unknown("method to compare with, of a finished run,", baseline, labels)
        return "Comparison", [], ["No finished run is plain PPO: --compare METHOD names another baseline."]
    tables, notes = [], []
    for own in doubled(complete):
        runs = ", ".join(entry.row["run"] for entry in own)
        notes.append(f"Left out, since they share method, task, seed and steps and cannot be paired: {runs}.")
    budgets = by(single(complete), "steps")
    for steps, own in budgets.items():
        rows = [entry.row for entry in own]
        if against not in {entry.label for entry in own}:
            notes.append(f"No run of {steps:,} steps is {against}: those that are have no comparison.")
            continue
        of_budget = f", {steps:,} steps" if len(budgets) > 1 else ""
        told = shown(compare(rows, against), overall(rows, against), epochs)
        tables += [part._replace(title=part.title + of_budget) for part in told]
    return f"Comparison with {against}", tables, notes


def _page(
    found: Found, path: Path, epochs: float, comparison: tuple[str, list[Shown], list[str]], limit: int, command: str
) -> Html:
    entries, of_task = found.entries, by(found.entries, "task", "steps")
    script = (ASSETS / "report.js").read_text()
    sections = [(parts.section_name(*key), _results(own, n, epochs)) for n, (key, own) in enumerate(of_task.items())]
    sections.append((comparison[0], parts.comparison(*comparison[1:])))
    sections.append(("Audit", parts.audit(entries, epochs)))
    sections.append(("Where the time goes", parts.costs(entries)))
    sections.append(("Settings that differ", parts.settings(entries)))
    sections.append(("Not counted", parts.left_out(found)))
    sections.append(("Films", parts.videos(entries, path, limit)))
    sections.append(("Raw data", _raw()))
    sections.append(("How this page was made", parts.facts(entries, _here(command))))
    sections = [(title, content) for title, content in sections if content]
    links = [tag("a", title, href=f"#part-{n}") for n, (title, _) in enumerate(sections)]
    tasks = ", ".join(dict.fromkeys(entry.row["task"] for entry in entries))
    title = escaped(f"{parts.counted(len(entries), 'run')}: {tasks}")
    return Html(f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_policy(script)}">
<title>{title}</title>
<style>{(ASSETS / "report.css").read_text()}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{_summary(found, epochs)}
{tag("nav", listed(links), aria_label="Parts of this page")}
{joined([_section(n, *section) for n, section in enumerate(sections)])}
</main>
<script type="application/json" id="data">{_embedded(_data(entries))}</script>
<script>{script}</script>
</body>
</html>
""")


def _section(number: int, title: str, content: Html) -> Html:
    heading = f"part-{number}"
    return tag("section", joined([tag("h2", title, id=heading), content]), aria_labelledby=heading)


def _policy(script: str) -> str:
    """Nothing is loaded, and no script runs but ours: not even one that a label smuggled in."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    )


def _summary(found: Found, epochs: float) -> Html:
    """Who leads, whether that can be said, and whether it was fair."""
    entries, complete = found.entries, finished(found.entries)
    metrics = {"alc": f"ALC@{epochs:g}", "last_return": "Last return"}
    lines = []
    for (task, steps), own in by(entries, "task", "steps").items():
        told = [_lead(name, lead) for metric, name in metrics.items() if (lead := leader(own, metric))]
        content = listed(told) if told else escaped("No run is finished: no claim can be made.")
        lines.append(joined([tag("strong", f"{parts.section_name(task, steps)}. "), content], ""))
    hours = duration(sum(entry.row["seconds"] for entry in entries))
    labels = len({entry.label for entry in complete})
    count = (
        f"{parts.counted(len(complete), 'finished run')} of {parts.counted(labels, 'method')}, {hours} of training. "
    )
    head = count + (
        "Whether the method with the highest mean leads is tested against the next one, on the seeds that both have "
        "(exact Wilcoxon signed-rank test); p is not corrected for having picked those two."
    )
    return joined([tag("p", head), listed(lines, class_="claims"), _fair(entries), *_warnings(found)])


def _lead(name: str, lead: Lead) -> Html:
    """A metric's first two methods as a sentence."""
    if lead.second is None:
        told = [f"{name}: ", tag("code", lead.first), f", {parts.printed(lead.figure)}. "]
    else:
        among = (
            f"among the {lead.ranked} methods with at least {ENOUGH} runs" if lead.few else f"of {lead.ranked} methods"
        )
        told = [f"{name}: highest mean {among} ", tag("code", lead.first), f", {parts.printed(lead.figure)}; next "]
        told += [tag("code", lead.second), f", {parts.printed(lead.figure_of_second)}. "]
    return joined([*told, tag("strong", lead.verdict)], "")


def _fair(entries: Sequence[Entry]) -> Html:
    broken = [entry.row["run"] for entry in entries if not entry.row["declared"]]
    if broken:
        told = (
            f"Audit: {len(broken)} of {parts.counted(len(entries), 'run')} {AUDIT[False, False]}: {', '.join(broken)}."
        )
        return tag("p", told, class_="error")
    strictly = sum(entry.row["audit"] for entry in entries)
    rest = f"; {len(entries) - strictly} are not, as their method declares" if strictly < len(entries) else ""
    told = f"Audit: {strictly} of {parts.counted(len(entries), 'run')} are strictly on-policy (Definition 1){rest}."
    return tag("p", told, class_="ok")


def _warnings(found: Found) -> list[Html]:
    missing = [entry for entry in found.entries if not entry.row["finished"]]
    told = []
    if missing or found.unreadable:
        counts = {"hold an unfinished run": len(missing), "could not be read": len(found.unreadable)}
        said = " and ".join(f"{count} {what}" for what, count in counts.items() if count)
        told.append(f"Of the folders, {said}: see “Not counted”.")
    twice = doubled(finished(found.entries))
    if twice:
        told.append(
            f"In {parts.counted(len(twice), 'case')} runs share method, task, steps and seed (x2 beside the seeds). "
            "Means and intervals take them for runs of different seeds; pairs leave them out."
        )
    return [tag("p", text, class_="warning") for text in told]


def _results(entries: Sequence[Entry], number: int, epochs: float) -> Html:
    """The table and the curves of one task and budget."""
    name = parts.section_name(entries[0].row["task"], entries[0].row["steps"])
    told = "Learning curves: mean return of the deterministic policy against environment steps, a line a method"
    plot = tag("svg", "", role="img", tabindex="0", aria_label=f"{told}, {name}. The table above has the figures.")
    hint = (
        "Drag to zoom, double-click to go back; by keyboard the arrows read values, + and - zoom, 0 goes back. Bands "
        "are 95% intervals of the mean of three runs or more (Student's t); that of two would fill the picture."
    )
    caption = tag("figcaption", joined([f"{told}.", tag("span", f" {hint}", class_="soft")], ""))
    missing = tag("noscript", tag("p", "The curves need JavaScript; all tables are complete without."))
    figure = tag("figure", joined([plot, missing, caption]), class_="curves", data_chart=str(number))
    return joined([parts.results(entries, epochs), figure])


def _raw() -> Html:
    told = "Every evaluation of every run that could be read, a line each, unfinished runs among them."
    button = tag("button", "Download the CSV", type="button", id="csv")
    return joined([tag("p", told), button])


def _here(command: str) -> dict[str, str]:
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return {"made by": f"ppo-dap {manifest()['versions']['ppo-dap']}, {made}", "command": command}


def _data(entries: Sequence[Entry]) -> dict[str, Any]:
    """What the script draws and what it writes to the CSV. Evaluations are columns."""
    names = list(dict.fromkeys(name for entry in entries for row in entry.evaluations for name in row))
    runs = []
    for entry in entries:
        columns = {name: [row.get(name) for row in entry.evaluations] for name in names}
        runs.append({name: entry.row[name] for name in SAID_OF_RUN} | {"evaluations": columns})
    places = {label: n for n, label in enumerate(by(entries, "label"))}
    charts = [_chart(own, entries, places) for own in by(entries, "task", "steps").values()]
    return {"said": SAID_OF_RUN, "columns": names, "runs": runs, "charts": charts}


def _chart(own: Sequence[Entry], entries: Sequence[Entry], places: dict[str, int]) -> list[dict[str, Any]]:
    """The curves of one task and budget, the best method first; `runs` are places in the list of all runs."""
    number = {id(entry): n for n, entry in enumerate(entries)}
    groups = by(own, "label")
    return [
        {
            "label": label,
            **parts.style(places[label]),
            "n": len(finished(groups[label])),
            **curve(finished(groups[label])),
            "runs": [number[id(entry)] for entry in groups[label]],
        }
        for label in best_first(groups)
    ]


def _embedded(data: Any) -> Html:
    """JSON that cannot end the element it stands in; NaN is null."""
    text = json.dumps(without_nan(data), separators=(",", ":"))
    return Html(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
