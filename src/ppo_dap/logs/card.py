"""A dataset card: what logs are, in numbers, for whoever finds the folder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ppo_dap.logs.dataset import Logs

BINS = 10
BAR = 40
"""Width of the longest bar of the histogram, in characters."""


def describe_logs(logs: Logs) -> dict[str, Any]:
    """Rows, episodes, their returns with a histogram, how the actions cover their space, and the hash."""
    lengths, returns = logs.episode_lengths(), logs.episode_returns()
    about: dict[str, Any] = {
        "task": logs.task,
        "rows": logs.num_rows,
        "episodes": logs.num_episodes,
        "lengths": _spread(lengths),
        "sha256": logs.hash(),
        "actions": _coverage(logs),
    }
    if returns is not None:
        counts, edges = np.histogram(returns.astype(np.float64), BINS)
        about["returns"] = _spread(returns) | {
            "histogram": {"edges": [float(edge) for edge in edges], "episodes": counts.tolist()}
        }
    return about


def _spread(values: np.ndarray) -> dict[str, float]:
    named = {"mean": values.mean(), "std": values.std(), "min": values.min(), "max": values.max()}
    named |= {f"{share}%": np.percentile(values, share) for share in (25, 50, 75)}
    return {name: round(float(value), 3) for name, value in named.items()}


def _coverage(logs: Logs) -> dict[str, list[float]]:
    """Per dimension, in the environment's units; `at_bound` is the share of rows exactly at a bound."""
    actions = logs.actions.astype(np.float64)
    columns = {
        "mean": actions.mean(0),
        "std": actions.std(0),
        "5%": np.percentile(actions, 5, axis=0),
        "95%": np.percentile(actions, 95, axis=0),
    }
    if logs.action_low is not None and logs.action_high is not None:
        columns["at_bound"] = ((logs.actions == logs.action_low) | (logs.actions == logs.action_high)).mean(0)
    return {name: [round(float(value), 4) for value in column] for name, column in columns.items()}


def card_text(name: str, card: Mapping[str, Any]) -> str:
    """A card as Markdown. `card` is `describe_logs` with `tier`, `meaning`, `policies`, `versions` and `command`."""
    lines = [f"# {name}", "", f"{card['meaning'][0].upper()}{card['meaning'][1:]}.", ""]
    lines += [
        f"- task: {card['task']}",
        f"- rows: {card['rows']:,} in {card['episodes']:,} episodes, length {_words(card['lengths'])}",
        f"- return: {_words(card['returns'])}",
        f"- sha256 of the logs as `load_logs` reads them: {card['sha256']}",
        "- versions: " + ", ".join(f"{package} {version}" for package, version in card["versions"].items() if version),
        "",
        "```",
        card["command"],
        "```",
        "",
        "## Policies",
        "",
        "PPO's, with the noise that it explores with; the return is the deterministic policy's.",
        "",
        "| seed | steps of training | taken after | return |",
        "| --- | --- | --- | --- |",
    ]
    for policy in card["policies"]:
        lines.append(
            f"| {policy['seed']} | {policy['train_steps']:,} | {policy['at_step']:,} | {policy['return']:,.1f} |"
        )
    histogram, width = card["returns"]["histogram"], max(card["returns"]["histogram"]["episodes"])
    lines += ["", "## Returns", "", "```"]
    for low, high, count in zip(histogram["edges"], histogram["edges"][1:], histogram["episodes"], strict=False):
        bar = "#" * -(-BAR * count // width)
        lines.append(f"{low:>10,.1f} to {high:>10,.1f}  {count:>6,}  {bar}".rstrip())
    lines += ["```", "", "## Actions", "", "| dimension | " + " | ".join(card["actions"]) + " |"]
    lines.append("| --- " * (1 + len(card["actions"])) + "|")
    for i, row in enumerate(zip(*card["actions"].values(), strict=True)):
        lines.append(f"| {i} | " + " | ".join(f"{value:.3f}" for value in row) + " |")
    return "\n".join(lines) + "\n"


def _words(spread: Mapping[str, float]) -> str:
    return f"mean {spread['mean']:,.1f} +- {spread['std']:,.1f}, from {spread['min']:,.1f} to {spread['max']:,.1f}"
