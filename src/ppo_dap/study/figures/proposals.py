"""Figure 11: proposals on one batch of on-policy states, without guidance, with energy weights, and with both parts.

The points are taken while a run's folder and its prior are there, and kept (`Results.proposals`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.study.plots.drawing import Drawn, head, new_figure
from ppo_dap.study.results import Results, Row
from ppo_dap.study.store.grids import Study

if TYPE_CHECKING:
    from ppo_dap.priors import Prior
    from ppo_dap.study.diagnostics.guided_run import GuidedRun
    from ppo_dap.study.store.store import Store

STATES = 40
PERPLEXITY = 30.0
PANELS = ("no guidance", "energy", "energy + gradient")


def proposals_of(folder: str | Path, prior: Prior | str | Path, *, states: int = STATES, seed: int = 0) -> list[Row]:
    """Candidates at `states` states that the run's policy visits at its end, as `proposals_on` gives them.

    Raises `InputError` for a run without Q, another prior than its own, and fewer than two states.
    """
    from ppo_dap.study.diagnostics.guided_run import load_guided
    from ppo_dap.study.diagnostics.monte_carlo import walk
    from ppo_dap.tasks.catalogue import make_gymnasium

    if states < 2:
        raise InputError(f"states {states} must be at least 2")
    guided = load_guided(folder, prior)
    env = make_gymnasium(guided.spec.task)
    try:
        trajectory = walk(env, guided.policy, max(guided.config.ppo.rollout_steps, states), states, seed, None)
    finally:
        env.close()
    return proposals_on(guided, trajectory.observations[trajectory.kept], seed)


def proposals_on(guided: GuidedRun, observations: Float[np.ndarray, "n obs"], seed: int = 0) -> list[Row]:
    """A row a candidate, unguided and guided (Eq. 8) from the same noise: `state`, `guided` 0 or 1, `drawn` (how often
    D_syn would hold it under Eq. 7's weights), `q` (less the mean of the state's candidates of both kinds, over their
    standard deviation), `x` and `y` (t-SNE of all actions together).
    """
    sets = [guided.candidates(observations, steered, seed) for steered in (False, True)]
    q = [guided.q(observations, actions) for actions in sets]
    chosen = [guided.draw(guided.energy_weights(values), seed)[0] for values in q]
    actions, values = np.concatenate(sets, 1), np.concatenate(q, 1)
    spread = np.maximum(values.std(1, keepdims=True), 1e-12)
    normalised = (values - values.mean(1, keepdims=True)) / spread
    n, k = q[0].shape
    counts = [np.stack([np.bincount(own, minlength=k) for own in drawn]) for drawn in chosen]
    drawn = np.concatenate(counts, 1)
    places = tsne(actions.reshape(n * 2 * k, -1), seed).reshape(n, 2 * k, 2)
    return [
        {
            "state": i,
            "guided": int(j >= k),
            "drawn": int(drawn[i, j]),
            "q": round(float(normalised[i, j]), 4),
            "x": round(float(places[i, j, 0]), 2),
            "y": round(float(places[i, j, 1]), 2),
        }
        for i in range(n)
        for j in range(2 * k)
    ]


def tsne(actions: Float[np.ndarray, "n act"], seed: int = 0) -> Float[np.ndarray, "n 2"]:
    """Actions in the plane, neighbours beside each other; raises `InputError` without the extra `figures`."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        raise InputError("Fig. 11 needs scikit-learn: pip install ppo-dap[figures]") from None
    perplexity = min(PERPLEXITY, (len(actions) - 1) / 3)
    return TSNE(perplexity=perplexity, init="pca", random_state=seed).fit_transform(actions)


def take_proposals(store: Store, study: Study, results: Results) -> Results:
    """`results` with the candidates of one finished run of each arm, that of the lowest seed, unless it has them."""
    for arm in dict.fromkeys(entry.labels["arm"] for entry in study.entries):
        own = [e.cell for e in study.entries if e.labels["arm"] == arm and "prior" in e.cell.needs]
        done = [cell for cell in own if cell.kind == "run" and store.done(cell)]
        if done and not any(cell.name in results.proposals for cell in own):
            first = min(done, key=lambda cell: cell.settings["seed"])
            prior = store.artefact(first.needs["prior"])
            results.proposals[first.name] = proposals_of(store.out(first), prior)
    return results


def high_q_shares(rows: Sequence[Row]) -> dict[str, float]:
    """Panel -> share of its proposals at or above the 90th percentile of Q over the state's unguided candidates.

    Without guidance it is about 0.1 by construction.
    """
    high, found = _high(rows), {}
    for panel in PANELS:
        held = _held(rows, panel)
        hits = sum(count for row, count in held if row["q"] >= high[row["state"]])
        found[panel] = hits / sum(count for _, count in held)
    return found


def _high(rows: Sequence[Row]) -> dict[int, float]:
    """State -> the 90th percentile of Q over its unguided candidates."""
    free: dict[int, list[float]] = {}
    for row in rows:
        if not row["guided"]:
            free.setdefault(row["state"], []).append(row["q"])
    return {state: float(np.quantile(values, 0.9)) for state, values in free.items()}


def _held(rows: Iterable[Row], panel: str) -> list[tuple[Row, int]]:
    """The candidates that a panel's D_syn holds, and how often."""
    if panel == "no guidance":
        return [(row, 1) for row in rows if not row["guided"]]
    wanted = int(panel != "energy")
    return [(row, row["drawn"]) for row in rows if row["guided"] == wanted and row["drawn"]]


def fig11(results: Results, study: Study) -> Drawn:
    """t-SNE of proposals coloured by the state-normalised Q, a row of panels a run."""
    found = [e.labels | {"run": e.cell.name} for e in study.entries if e.cell.name in results.proposals]
    if not found:
        return {}
    figure = new_figure(1.0 + 2.5 * len(found))
    grid = figure.subplots(len(found), len(PANELS), squeeze=False, sharex="row", sharey="row")
    marks: Any = None
    for line, labels in zip(grid, found, strict=True):
        rows = results.proposals[labels["run"]]
        shares, high = high_q_shares(rows), _high(rows)
        for axes, panel in zip(line, PANELS, strict=True):
            axes.plot([row["x"] for row in rows], [row["y"] for row in rows], ".", color="0.88", ms=3, zorder=1)
            # The highest on top: they are few, and what the panel is about.
            held = sorted(_held(rows, panel), key=lambda pair: pair[0]["q"])
            x, y, q = ([row[name] for row, _ in held] for name in ("x", "y", "q"))
            sizes = [7.0 * count for _, count in held]
            rings = [0.6 if row["q"] >= high[row["state"]] else 0.0 for row, _ in held]
            colours: dict[str, Any] = {"c": q, "cmap": "cividis", "vmin": -2, "vmax": 2, "edgecolors": "black"}
            marks = axes.scatter(x, y, sizes, linewidths=rings, zorder=2, **colours)
            axes.set(title=f"{panel}: {shares[panel]:.0%} high Q", xticks=[], yticks=[])
            axes.grid(visible=False)
        line[0].set_ylabel(f"{labels['arm']}\nseed {labels['seed']}")
    figure.colorbar(marks, ax=grid, label="Q, normalised in its state", extend="both", shrink=0.8, aspect=30)
    count = len({row["state"] for row in results.proposals[found[0]["run"]]})
    note = (
        f"t-SNE of the actions at {count} states; area: how often Eq. 7's weights draw it; grey: all candidates; "
        "ringed: high Q, at or above the 90th percentile of the state's unguided candidates"
    )
    there = {labels["arm"] for labels in found}
    missing = [arm for arm in dict.fromkeys(e.labels["arm"] for e in study.entries) if arm not in there]
    head(figure, f"Proposals on the same on-policy states, {found[0]['task']}", missing, note)
    return {"fig11": figure}
