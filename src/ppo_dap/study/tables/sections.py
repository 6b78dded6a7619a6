"""Tables of Sections 5.5 to 5.8: ablations, coverage, reliability of Q, the audit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from ppo_dap.study.results import Results
from ppo_dap.study.store.grids import Study
from ppo_dap.study.store.studies import PPO
from ppo_dap.study.tables.effects import NOTHING, Effects, View, across, finite_or_none, made_by, verdict, view
from ppo_dap.study.tables.paper import CLAIMS
from ppo_dap.study.tables.table import (
    READ,
    WALL,
    Columns,
    Row,
    Table,
    across_text,
    change_text,
    listed,
    mean_text,
    number,
    over_text,
)

WHOLE = {"prior": "diffusion", "guidance": "energy+gradient", "f": 10}
"""The arm of 5.5 that has every part."""
NARROW = "narrow logs"
KLS = (
    "KLs: means over a run's iterations, of means over its states. Means over the settings, ± their standard deviation."
)
BETTER = (
    "P(better): that a run beats one of the baseline's, averaged over the settings, with its 95% bootstrap interval."
)


def ablation(results: Results, study: Study) -> Table:
    """5.5: changes over PPO by arm, against PPO and against the whole; and what they cost."""
    runs = view(results, study, "ablation")
    area, final = f"ALC@{study.epochs:g}", f"return after {runs.steps:,} steps"
    metrics = ["alc", "last_return", "seconds_per_step", "peak_mib", "acceptance", "policy_kl", "prior_kl", "kl_ratio"]
    found = runs.effects(PPO.name, metrics)
    first = _factors(runs, found, "alc", f"5.5: prior, guidance and PET by {area}")
    notes = [READ, BETTER, "The whole: diffusion / energy+gradient / f=10 in the same preset."]
    last = _factors(runs, found, "last_return", f"5.5: prior, guidance and PET by {final}")
    more = [last, _factor_costs(runs, found)] if runs.rows else []
    return dataclasses.replace(first, notes=notes, made=made_by(study, runs), more=more)


def _wholes(runs: View) -> dict[str, str]:
    """Preset -> its arm with every part."""
    return {
        labels["preset"]: arm
        for arm, labels in runs.arms.items()
        if all(labels.get(name) == value for name, value in WHOLE.items())
    }


def _factors(runs: View, found: Effects, metric: str, title: str) -> Table:
    """Change over PPO on each setting, and over them; a line an arm."""
    over, wholes, records = runs.over(PPO.name, [metric]), _wholes(runs), []
    presets = {preset: [arm for arm in runs.arms if runs.arms[arm]["preset"] == preset] for preset in wholes}
    against = {preset: runs.over(whole, [metric], presets[preset]) for preset, whole in wholes.items()}
    for arm, labels in runs.arms.items():
        own = {task: found[metric, task, arm] for task in runs.tasks}
        if arm != PPO.name and any(row["n"] for row in own.values()):
            record: Row = {"method": arm, "arm": runs.base(arm), "preset": labels["preset"], **own}
            to_whole = against.get(labels["preset"], Effects())[metric, arm]
            records.append(record | {"against PPO": over[metric, arm], "against the whole": to_whole})

    def change(task: str) -> Callable[[Row], str]:
        return lambda row: change_text(row[task])

    columns: Columns = {
        "method": lambda row: row["arm"],
        "preset": lambda row: row["preset"],
        **{f"{task}: change over PPO": change(task) for task in runs.tasks},
        "P(better than PPO)": lambda row: over_text(row["against PPO"]),
        "P(better than the whole)": lambda row: over_text(row["against the whole"]),
    }
    return listed(title, records, columns, words=2)


def _factor_costs(runs: View, found: Effects) -> Table:
    """Costs x PPO, and how stable the updates are; a line an arm."""
    shown = {
        "wall-clock x PPO": ("seconds_per_step", "ratio", ".2f"),
        "peak memory x PPO": ("peak_mib", "ratio", ".2f"),
        "acceptance": ("acceptance", "mean", ".2f"),
        "policy-KL": ("policy_kl", "mean", ".2g"),
        "prior-KL": ("prior_kl", "mean", ".2g"),
        "prior-KL / policy-KL": ("kl_ratio", "mean", ".2g"),
    }
    lines, rows = [], []
    for arm, labels in runs.arms.items():
        if runs.runs(arm):
            means = [across(found[metric, task, arm][of] for task in runs.tasks) for metric, of, _ in shown.values()]
            forms, of = [form for *_, form in shown.values()], len(runs.tasks)
            texts = [across_text(*mean, form, of) for mean, form in zip(means, forms, strict=True)]
            lines.append([runs.base(arm), labels["preset"], *texts])
            row = {"method": arm, "preset": labels["preset"]}
            for (metric, _, _), (mean, deviation, tasks) in zip(shown.values(), means, strict=True):
                row |= {metric: mean, f"{metric}_deviation": deviation, f"{metric}_tasks": tasks}
            rows.append(row)
    claim = CLAIMS["kl_ratio"]
    notes = [KLS, WALL, f"The paper ({claim.place}): {claim.words}."]
    notes.append("A small prior-KL alone does not tell a proximal update from none.")
    return Table("5.5: cost and stability", ["method", "preset", *shown], lines, rows, notes, words=2)


def coverage(results: Results, study: Study) -> Table:
    """5.6: gains and proposals at three levels of coverage, and with what the paper recommends for the narrow one."""
    return _coverage(results, study, "coverage", "5.6: coverage of the logs, and what is recommended for narrow ones")


def fig12(results: Results, study: Study) -> Table:
    """Gains and proposals at three levels of coverage."""
    return _coverage(results, study, "fig12", "Fig. 12: coverage of the logs")


def _coverage(results: Results, study: Study, name: str, title: str) -> Table:
    runs = view(results, study, name)
    metrics = ["alc", "last_return", "high_q_rate", "ess"]
    found, over, records = runs.effects(PPO.name, metrics), runs.over(PPO.name, metrics[:2]), []
    for arm, labels in runs.arms.items():
        if arm == PPO.name or not runs.runs(arm):
            continue
        record: Row = {"method": arm, "logs": runs.base(arm), "preset": labels["preset"]}
        if "mitigation" in labels:
            narrow = runs.named(NARROW, labels["preset"])
            record["against narrow"] = runs.over(narrow, ["alc"], [arm, narrow])["alc", arm]
        record |= {metric: over[metric, arm] for metric in metrics[:2]}
        for metric in metrics[2:]:
            values = across(found[metric, task, arm]["mean"] for task in runs.tasks)
            record |= dict(zip((metric, f"{metric}_deviation", f"{metric}_tasks"), values, strict=True))
        records.append(record)

    def mean(metric: str, form: str) -> Callable[[Row], str]:
        of = len(runs.tasks)
        return lambda row: across_text(row[metric], row[f"{metric}_deviation"], row[f"{metric}_tasks"], form, of)

    columns: Columns = {
        "logs": lambda row: row["logs"],
        "preset": lambda row: row["preset"],
        f"ALC@{study.epochs:g}: P(better than PPO)": lambda row: over_text(row["alc"]),
        "P(better than narrow logs alone)": lambda row: over_text(row.get("against narrow", NOTHING)),
        f"return after {runs.steps:,} steps: P(better than PPO)": lambda row: over_text(row["last_return"]),
        "high-Q rate": mean("high_q_rate", ".2f"),
        "ESS": mean("ess", ".1f"),
    }
    notes = [
        READ,
        BETTER,
        "High-Q rate: share of the proposals at or above the 90th percentile of Q over their state's candidates, a "
        "tenth before they are drawn by weight. ESS: of 10 candidates. ±: standard deviation over the settings.",
        "The paper prints no numbers; in its Fig. 12 all four fall from wide to narrow (final returns, 1M steps).",
    ]
    more = [_coverage_by_setting(runs, found, study.epochs)] if records else []
    return listed(title, records, columns, notes, 2, made_by(study, runs), more)


def _coverage_by_setting(runs: View, found: Effects, epochs: float) -> Table:
    metrics, records = ("alc", "last_return", "high_q_rate", "ess"), []
    for task, logs in runs.settings:
        for arm, labels in runs.arms.items():
            if arm != PPO.name and (own := runs.runs(arm, task)):
                record = {"task": task, "tier": logs, "method": arm, "logs": runs.base(arm), "preset": labels["preset"]}
                record |= {metric: found[metric, task, arm] for metric in metrics}
                records.append(record | {"n": len(own)})
    columns: Columns = {
        "setting": lambda row: f"{row['task']}, {row['tier']}",
        "logs": lambda row: row["logs"],
        "preset": lambda row: row["preset"],
        "n": lambda row: str(row["n"]),
        f"ALC@{epochs:g}: change over PPO": lambda row: change_text(row["alc"], row["n"]),
        f"return after {runs.steps:,} steps: change over PPO": lambda row: change_text(row["last_return"], row["n"]),
        "high-Q rate": lambda row: mean_text(row["high_q_rate"], ".2f", row["n"]),
        "ESS": lambda row: mean_text(row["ess"], ".1f", row["n"]),
    }
    return listed("By setting", records, columns, words=3)


REPORTED = {
    "rho": ("q.proposals.rho", ".2f"),
    "a true Q": ("rank_ceiling.proposals", ".2f"),
    "pooled rho": ("q.all.rho_pooled", ".2f"),
    "MAE": ("q.all.mae", ".3f"),
    "bias": ("q.all.bias", "+.3f"),
    "ECE": ("q.all.ece", ".3f"),
    "ECE, affine": ("calibration.affine.ece", ".3f"),
    "guided among unguided": ("weighting.high_q_hit_rate_over_unguided", ".2f"),
    "reweighted - unguided": ("reweighted", "+.3f"),
}
"""Column -> the number of a reliability report, and how it is printed."""


def reliability(results: Results, study: Study) -> Table:
    """5.7: how well Q ranks and predicts, and whether guidance raises the real return."""
    runs = view(results, study, "reliability")
    entries = [e for e in study.entries if e.cell.kind == "reliability" and e.labels["study"] == "reliability"]
    reports = [
        e.labels | _reported(results.reports[e.cell.name]) | {"run": e.cell.name, "label": e.labels["arm"]}
        for e in entries
        if e.cell.name in results.reports
    ]
    reported = View(runs.study, [row | {"finished": True} for row in reports])
    found, records = reported.effects("", [name for name, _ in REPORTED.values()]), []
    for task, logs in runs.settings:
        for arm, labels in runs.arms.items():
            if own := reported.runs(arm, task):
                record = {"task": task, "logs": logs, "method": arm, "preset": labels["preset"], "n": len(own)}
                record["monte_carlo"] = all(row["monte_carlo"] for row in own)
                records.append(record | {name: found[name, task, arm] for name, _ in REPORTED.values()})

    def shown(name: str, form: str) -> Callable[[Row], str]:
        return lambda row: mean_text(row[name], form, row["n"])

    columns: Columns = {
        "setting": lambda row: f"{row['task']}, {row['logs']}" + ("" if row["monte_carlo"] else " (no rollouts)"),
        "method": lambda row: row["method"],
        "n": lambda row: str(row["n"]),
        **{head: shown(name, form) for head, (name, form) in REPORTED.items()},
    }
    claim = CLAIMS["high_q"]
    notes = [
        READ,
        "rho: Spearman's of Q and G among the guided candidates of a state, 0 where Q knows nothing; a true Q: about "
        "what the true one would reach against so noisy a G. MAE, bias, ECE: in units of scaled reward; ECE also after "
        "a line was fitted on other states.",
        "Guided among unguided: share of guided candidates at or above the 90th percentile of Q over unguided ones, a "
        f"tenth if guidance did nothing. The paper ({claim.place}): {claim.words}. It prints no other number.",
        "Reweighted - unguided: return that energy weights on guided candidates earn, over unguided samples'.",
    ]
    made = [f"{made_by(study, runs)[0][:-1]}, and {len(reports)} of {len(entries)} reports."]
    return listed("5.7: reliability of value guidance", records, columns, notes, 2, made)


def _reported(report: Row) -> Row:
    """The numbers of a report; what it does not have is None."""
    own = {name: finite_or_none(report.get(name)) for name, _ in REPORTED.values()}
    pair = [finite_or_none(report.get(f"returns.{name}")) for name in ("reweighted", "unguided")]
    own["reweighted"] = None if None in pair else pair[0] - pair[1]
    return own | {"monte_carlo": bool(report.get("monte_carlo"))}


MEASURES = {
    "OGLR, largest": ("oglr", max, ".2g"),
    "SPR, smallest": ("spr", min, ".3g"),
    "PGShare, smallest": ("pgshare", min, ".2f"),
    "PGShare, mean": ("pgshare_mean", lambda values: across(values)[0], ".2f"),
    "fresh rows, smallest": ("batch_fresh", min, ".3g"),
}
"""Column -> a measure of the audit, what is taken of it over the runs, and how it is printed."""


def audit(results: Results, study: Study) -> Table:
    """5.8: the audit's measures at their worst, the KLs, and the verdict; by method, and by task."""
    runs = view(results, study, "audit")
    columns = [*MEASURES, "policy-KL", "prior-KL", "prior-KL / policy-KL", "verdict"]
    claims = [CLAIMS[name] for name in ("oglr", "spr", "pgshare", "kl_ratio")]
    oglr, spr, share, ratio = (f"{c.low:g} to {c.high:g}" if c.low < c.high else f"{c.low:g}" for c in claims)
    paper = ["the paper", "8", "", oglr, spr, "", share, "", "", "", ratio, ""]
    lines, rows, by_task = [], [], []
    for arm in runs.arms:
        if own := runs.runs(arm):
            tasks = len({row["task"] for row in own})
            line, row = _audited(own)
            lines.append([arm, str(tasks), *line])
            rows.append({"method": arm, "tasks": tasks} | row)
            for task in dict.fromkeys(row["task"] for row in own):
                by_task.append((task, arm, *_audited(runs.runs(arm, task))))
    by_task.sort(key=lambda each: runs.tasks.index(each[0]))
    names = ("OGLR", "SPR", "PGShare", "KLs:")
    notes = [
        "Smallest, largest: of all iterations of all runs. PGShare's mean, the KLs: over iterations, then over runs.",
        "The paper: " + "; ".join(f"{n} {c.words} ({c.place})" for n, c in zip(names, claims, strict=True)) + ".",
        "Verdict: whether every claim of Definition 1 holds, in each run. PPO-ARC reuses rows, and has to be caught.",
    ]
    more = [
        Table(
            "5.8 by task",
            ["task", "method", "n", *columns],
            [[task, arm, *line] for task, arm, line, _ in by_task],
            [{"task": task, "method": arm} | row for task, arm, _, row in by_task],
            words=2,
        )
    ]
    head = ["method", "tasks", "n", *columns]
    made, title = made_by(study, runs), "5.8: strict on-policy audit"
    if not lines:
        return Table(title, head, [], [], made=made)
    return Table(title, head, [paper, *lines], rows, notes, 1, made, more)


def _audited(runs: Sequence[Row]) -> tuple[list[str], Row]:
    """What is printed of these runs behind their names, and the numbers."""
    row: Row = {"n": len(runs), "verdict": verdict(runs)}
    texts = [str(len(runs))]
    for name, worst, form in MEASURES.values():
        values = [run[name] for run in runs if run.get(name) is not None]
        row[name] = worst(values) if values else None
        texts.append(number(row[name], form))
    for name in ("policy_kl", "prior_kl", "kl_ratio"):
        row[name] = across(run[name] for run in runs if run.get(name) is not None)[0]
        texts.append(number(row[name], ".2g"))
    return [*texts, row["verdict"]], row
