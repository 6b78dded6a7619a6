"""The report of 5.7 on one run: Q against Monte-Carlo returns on states that the policy visits."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.priors import Prior
from ppo_dap.study.diagnostics import reliability as measures
from ppo_dap.study.diagnostics.guided_run import GuidedRun, load_guided
from ppo_dap.study.diagnostics.monte_carlo import Walk, default_horizon, monte_carlo_returns, returns_to_go, walk
from ppo_dap.tasks.catalogue import make_gymnasium
from ppo_dap.tasks.restore import MujocoSimulator, make_restorable

BINS = 10
"""Quantile bins of the ECE."""
FALLBACK = (
    "this task cannot be put back to an earlier state: Q is compared with the discounted return of its own trajectory, "
    "one action a state, so there is no rho within states"
)


class Pairs(NamedTuple):
    """What was measured: n states, their actions group after group."""

    q: Float[np.ndarray, "n k"]
    returns: Float[np.ndarray, "n k m"]
    values: Float[np.ndarray, " n"]
    groups: dict[str, slice]
    """Columns of the guided candidates, of unguided samples and of the action that the policy took."""

    @property
    def g(self) -> Float[np.ndarray, "n k"]:
        """5.7's return proxy: the mean over rollouts."""
        return self.returns.mean(2)


class Reliability(NamedTuple):
    """The report, and the pairs that it was made of."""

    report: dict[str, Any]
    pairs: Pairs


def reliability(
    folder: str | Path,
    prior: Prior | str | Path,
    *,
    states: int = 64,
    rollouts: int = 8,
    horizon: int | None = None,
    checkpoint: Literal["last", "best"] = "last",
    seed: int = 0,
    progress: Callable[[int], None] = lambda state: None,
) -> Reliability:
    """5.7 for the run in `folder`: as many of the states that its policy visits, `rollouts` futures for each of their
    actions, `horizon` steps each (default: until gamma^H is below 0.05).

    Raises `InputError` for a run that has no Q, another prior than its own, or numbers that cannot work.
    """
    # Two states at least: a calibration is judged on states that it was not fitted to.
    for name, number, least in (("states", states, 2), ("rollouts", rollouts, 1), ("horizon", horizon, 1)):
        if number is not None and number < least:
            raise InputError(f"{name} {number} must be at least {least}")
    guided = load_guided(folder, prior, checkpoint)
    horizon = horizon or default_horizon(guided.config.ppo.gamma)
    copies = make_restorable(guided.spec.task, rollouts, seed)
    env = make_gymnasium(guided.spec.task)
    save = None if copies is None else MujocoSimulator(env).save
    try:
        trajectory = walk(env, guided.policy, max(guided.config.ppo.rollout_steps, states), states, seed, save)
    finally:
        env.close()
    head = {
        "run": str(folder),
        "task": guided.spec.task,
        "checkpoint": checkpoint,
        "env_steps": guided.state.env_steps,
        "gamma": guided.config.ppo.gamma,
        "reward_std": guided.scoring.reward_std,
        "states": len(trajectory.kept),
        "monte_carlo": copies is not None,
    }
    observations, (actions, groups) = trajectory.observations[trajectory.kept], _actions(guided, trajectory, seed)
    q, values = guided.q(observations, actions), guided.values(observations)
    weights, weighting = _weighting(guided, q, values, groups, seed)
    if copies is None:
        found = _visited_pairs(guided, trajectory)
        parts = {"note": FALLBACK} | describe_pairs(found, seed) | weighting | _visited(guided, trajectory)
        return Reliability(head | parts, found)
    numbers = (guided.scoring, horizon, seed, progress)
    returns = monte_carlo_returns(copies, guided.policy, trajectory.saved, actions, *numbers)
    found = Pairs(q, returns, values, groups)
    head |= {"rollouts": rollouts, "horizon": horizon}
    earned = {"returns": _mean_returns(found, weights)}
    parts = describe_pairs(found, seed) | weighting | earned | _visited(guided, trajectory, found)
    return Reliability(head | parts, found)


def _actions(guided: GuidedRun, trajectory: Walk, seed: int) -> tuple[Float[np.ndarray, "n k act"], dict[str, slice]]:
    observations = trajectory.observations[trajectory.kept]
    found = {
        "proposals": guided.candidates(observations, True, seed),
        "unguided": guided.candidates(observations, False, seed),
        "policy": trajectory.actions[trajectory.kept][:, None],
    }
    edges = np.cumsum([0, *(part.shape[1] for part in found.values())])
    groups = {name: slice(*edge) for name, edge in zip(found, itertools.pairwise(edges), strict=True)}
    return np.concatenate(list(found.values()), axis=1), groups


def _visited_pairs(guided: GuidedRun, trajectory: Walk) -> Pairs:
    """All visited pairs, each with the return of its own trajectory."""
    q = guided.q(trajectory.observations, trajectory.actions[:, None])
    returns = returns_to_go(trajectory, guided.scoring)[:, None, None]
    return Pairs(q, returns, guided.values(trajectory.observations), {"policy": slice(0, 1)})


def describe_pairs(pairs: Pairs, seed: int = 0) -> dict[str, Any]:
    """The measures of each group and of all, the same with the advantage Q - V for Q, and the calibrations."""
    q, g, v = pairs.q, pairs.g, pairs.values[:, None]
    groups = pairs.groups | {"all": slice(None)}
    return {
        "q": {name: measures.measure(q[:, part], g[:, part], BINS, seed) for name, part in groups.items()},
        "advantage": {
            name: measures.measure((q - v)[:, part], (g - v)[:, part], BINS, seed) for name, part in groups.items()
        },
        "rank_ceiling": {name: measures.rank_ceiling(pairs.returns[:, part]) for name, part in groups.items()},
        "calibration": measures.calibrations(q, g, BINS, seed),
    }


def _weighting(
    guided: GuidedRun, q: Float[np.ndarray, "n k"], values: Float[np.ndarray, " n"], groups: dict[str, slice], seed: int
) -> tuple[Float[np.ndarray, "n proposals"], dict[str, Any]]:
    """Eq. 7's weights of the guided candidates, and how even and how greedy they are."""
    steered, free = q[:, groups["proposals"]], q[:, groups["unguided"]]
    weights = guided.energy_weights(steered)
    chosen, drawn = guided.draw(weights, seed)
    by_advantage = guided.energy_weights(steered - values[:, None])
    return weights, {
        "weighting": {
            "beta": guided.beta,
            **drawn,
            "high_q_hit_rate": measures.high_q_hit_rate(steered, np.take_along_axis(steered, chosen, axis=1)),
            "high_q_hit_rate_over_unguided": measures.high_q_hit_rate(free, steered),
            "largest_difference_by_advantage": float(np.abs(weights - by_advantage).max()),
        }
    }


def _mean_returns(pairs: Pairs, weights: Float[np.ndarray, "n proposals"]) -> dict[str, float]:
    """Whether guidance raises the real return: G by where the action comes from."""
    q, g = (x[:, pairs.groups["proposals"]] for x in (pairs.q, pairs.g))
    return {
        "policy": float(pairs.g[:, pairs.groups["policy"]].mean()),
        "unguided": float(pairs.g[:, pairs.groups["unguided"]].mean()),
        "proposals": float(g.mean()),
        "reweighted": float((weights * g).sum(1).mean()),
        "highest_q": float(np.take_along_axis(g, q.argmax(1)[:, None], axis=1).mean()),
    }


def _visited(guided: GuidedRun, trajectory: Walk, pairs: Pairs | None = None) -> dict[str, Any]:
    """Rank correlations over visited pairs, one action a state: Q - V, GAE and what the returns say of both."""
    gae, v = guided.gae(trajectory), guided.values(trajectory.observations)
    q = guided.q(trajectory.observations, trajectory.actions[:, None])[:, 0]
    advantage, to_go = q - v, returns_to_go(trajectory, guided.scoring)
    found = {
        "pairs": len(q),
        "rho_q_minus_v_and_gae": measures.rank_correlation(advantage, gae),
        "rho_q_and_return_to_go": measures.rank_correlation(q, to_go),
        "rho_q_minus_v_and_return_to_go_minus_v": measures.rank_correlation(advantage, to_go - v),
    }
    if pairs is not None:
        kept = trajectory.kept
        monte_carlo = pairs.g[:, pairs.groups["policy"]][:, 0] - pairs.values
        found["rho_q_minus_v_and_g_minus_v"] = measures.rank_correlation(advantage[kept], monte_carlo)
        found["rho_gae_and_g_minus_v"] = measures.rank_correlation(gae[kept], monte_carlo)
    return {"visited": found}


def print_reliability(report: Mapping[str, Any]) -> None:
    """The report in words."""
    r = report
    what = f"{r['rollouts']} rollouts of {r['horizon']} steps an action" if r["monte_carlo"] else r["note"]
    print(f"{r['task']} at {r['env_steps']:,} steps, {r['states']} states; {what}")
    print(f"in Q's units, reward / {r['reward_std']:.3g}:")
    for name, m in r["q"].items():
        within = "one action a state"
        if m["rho_states"]:
            within = (
                f"rho {m['rho']:.2f} [{m['rho_low']:.2f}, {m['rho_high']:.2f}] in {m['rho_states']} states (a true Q: "
                f"{r['rank_ceiling'][name]:.2f})"
            )
        print(
            f"{name:>9}: {within}, pooled {m['rho_pooled']:.2f}, MAE {m['mae']:.3g}, bias {m['bias']:+.3g}, ECE "
            f"{m['ece']:.3g}"
        )
    for name, m in r["calibration"].items():
        print(f"calibration {name}: MAE {m['mae']:.3g}, ECE {m['ece']:.3g} on held-out states")
    w = r["weighting"]
    print(
        f"energy weights: beta {w['beta']:.2f}, ESS {w['ess']:.1f}, acceptance {w['acceptance']:.2f}, high-Q hit rate "
        f"{w['high_q_hit_rate']:.2f} (guided among unguided {w['high_q_hit_rate_over_unguided']:.2f}); with Q - V "
        f"they differ by at most {w['largest_difference_by_advantage']:.1g}"
    )
    if r["monte_carlo"]:
        print("mean return of: " + ", ".join(f"{k.replace('_', ' ')} {value:.3f}" for k, value in r["returns"].items()))
    print("rank correlations over visited pairs, one action a state:")
    for name, value in r["visited"].items():
        if name != "pairs":
            print(f"  {name.removeprefix('rho_').replace('_', ' ')}: {value:.2f}")


def show_progress(states: int) -> Callable[[int], None]:
    """A line on stderr at every eighth of the states."""

    def show(done: int) -> None:
        if done * 8 // states > (done - 1) * 8 // states:
            print(f"{done} of {states} states", file=sys.stderr, flush=True)

    return show


def reliability_figure(found: Reliability, path: Path) -> None:
    """Q against G: a dot a pair, the mean of each bin of Q, and where they would be equal."""
    from ppo_dap.study.plots.png import saved_figure

    pairs = found.pairs
    with saved_figure(path, (5.4, 5.0)) as axes:
        for (name, part), (colour, mark) in zip(pairs.groups.items(), MARKS, strict=False):
            q, g = pairs.q[:, part].ravel(), pairs.g[:, part].ravel()
            size = 14 if len(q) <= len(pairs.q) else 6
            axes.plot(q, g, mark, color=colour, markersize=size**0.5, alpha=0.4, markeredgewidth=0, label=name)
        mean_q, mean_g, _ = measures.calibration_curve(pairs.q.ravel(), pairs.g.ravel(), BINS)
        axes.plot(mean_q, mean_g, "-o", color="black", linewidth=1.8, markersize=4, label="mean of a bin of Q")
        ends = [float(min(pairs.q.min(), pairs.g.min())), float(max(pairs.q.max(), pairs.g.max()))]
        axes.plot(ends, ends, "--", color="grey", linewidth=1, label="Q = G")
        proposals = found.report["q"].get("proposals", found.report["q"]["all"])
        rho = proposals["rho"] if found.report["monte_carlo"] else proposals["rho_pooled"]
        axes.set(
            xlabel="Q(s, a)",
            ylabel="G(s, a), mean of the rollouts" if found.report["monte_carlo"] else "discounted return to go",
            title=f"{found.report['task']}: rho {rho:.2f}, ECE {proposals['ece']:.2g}",
        )
        axes.legend(frameon=False, fontsize=8)


MARKS = (("#0072B2", "o"), ("#E69F00", "s"), ("#CC79A7", "D"))
"""Colours and marks of the groups."""
