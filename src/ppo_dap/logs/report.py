"""The verdict of `check_logs` as one html file that needs nothing else: no script, no address, pictures inside."""

from __future__ import annotations

import base64
import html
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ppo_dap.errors import InputError
from ppo_dap.logs.dataset import Logs
from ppo_dap.logs.finding import EXIT_CODES, Finding, Report
from ppo_dap.storage import write_atomically

MARKS = {"error": "✕ error", "warning": "! warning", "ok": "✓ ok"}
STYLE = """
:root { color-scheme: light dark; --text: #1a1a1a; --soft: #555; --paper: #fff; --line: #d0d0d0;
  --error: #a30000; --warning: #8a4b00; --ok: #00603a; }
@media (prefers-color-scheme: dark) { :root { --text: #ececec; --soft: #b5b5b5; --paper: #17191c; --line: #43474d;
  --error: #ff9d94; --warning: #ffc266; --ok: #7fdcab; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--paper); max-width: 60rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; line-height: 1.25; overflow-wrap: anywhere; } h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; }
p.soft, figcaption { color: var(--soft); } .error { color: var(--error); } .warning { color: var(--warning); }
.ok { color: var(--ok); } .level { font-weight: 600; } .skipped { color: var(--soft); font-weight: 400; }
.table { overflow-x: auto; } table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: 0.4rem 0.8rem 0.4rem 0; border-bottom: 1px solid var(--line); }
td { overflow-wrap: anywhere; } td:nth-child(-n+2) { overflow-wrap: normal; white-space: nowrap; }
@media (max-width: 40rem) { tr:first-child { display: none; } tr { display: block; padding: 0.5rem 0;
  border-bottom: 1px solid var(--line); }
  td { display: inline; border: 0; } td:last-child { display: block; } }
figure { margin: 0; } img { max-width: 100%; height: auto; background: #fff; border-radius: 6px; display: block; }
"""
VERDICTS = ("usable, nothing odd found", "usable, but look at the warnings", "unusable as they are")


def require_html(path: str | os.PathLike) -> Path:
    """`path` as a Path; raises `InputError` unless it ends in .html or .htm."""
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: must end in .html")
    return path


def write_report(
    logs: Logs,
    report: Report,
    path: str | os.PathLike,
    action_low: Float32[np.ndarray, " task_act"] | None = None,
    action_high: Float32[np.ndarray, " task_act"] | None = None,
) -> None:
    """Write the verdict table, worst first, and the pictures to `path`, whole or not at all.

    The bounds (those of the logs if not given) are drawn beside the actions. Raises `InputError` when `path` does not
    end in .html or cannot be written.
    """
    path = require_html(path)
    if action_low is None or action_high is None:
        action_low, action_high = logs.action_low, logs.action_high
    content = _page(logs, report, action_low, action_high)
    try:
        write_atomically(path, content.encode())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}): must be in a writable folder") from None


def _page(logs: Logs, report: Report, low: np.ndarray | None, high: np.ndarray | None) -> str:
    from ppo_dap.logs.pictures import draw_all

    title = html.escape(f"check-logs: {Path(logs.source).name}")
    size = html.escape(f"{logs.num_rows:,} rows, {logs.num_episodes:,} episodes, task {logs.task or 'unknown'}")
    size += f"<br>{html.escape(logs.source)}" if Path(logs.source).name != logs.source else ""
    levels = [line.level for line in report.lines]
    counts = ", ".join(f"{levels.count(level)} {word}" for level, word in _words(levels) if levels.count(level))
    worst = max(EXIT_CODES, key=lambda level: EXIT_CODES[level] * (level in levels))
    figures = "\n".join(
        f'<h2>{html.escape(title)}</h2>\n<figure><img alt="{html.escape(f"{title}. {caption}")}" '
        f'src="data:image/png;base64,{base64.b64encode(png).decode()}"><figcaption>{html.escape(caption)}</figcaption>'
        "</figure>"
        for title, caption, png in draw_all(logs, report, low, high)
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{title}</h1>
<p class="soft">{size}</p>
<p class="level {worst}">{VERDICTS[report.exit_code].capitalize()} ({counts}).</p>
<div class="table"><table>
<tr><th>level</th><th>check</th><th>finding</th></tr>
{_rows(report)}
</table></div>
{figures}
</body>
</html>
"""


def _words(levels: list[str]) -> list[tuple[str, str]]:
    return [(level, level + "s" * (level != "ok" and levels.count(level) != 1)) for level in reversed(EXIT_CODES)]


def _skipped(line: Finding) -> bool:
    # A check without what it needs is no warning, but no tick either.
    return line.message.startswith("not checked")


def _look(line: Finding) -> str:
    return "level skipped" if _skipped(line) else f"level {line.level}"


def _mark(line: Finding) -> str:
    return "- not checked" if _skipped(line) else MARKS[line.level]


def _rows(report: Report) -> str:
    worst_first = sorted(report.lines, key=lambda line: -EXIT_CODES[line.level])
    return "\n".join(
        f'<tr><td class="{_look(line)}">{_mark(line)}</td><td>{html.escape(line.name)}</td>'
        f"<td>{html.escape(line.message)}</td></tr>"
        for line in worst_first
    )
