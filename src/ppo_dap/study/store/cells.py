"""What a study is made of: cells. A cell is one thing that is made once, named by what it is made of and nothing else.

Runs need priors, priors need logs, logs need behaviour policies; each of these is a cell of its own, so that studies
share them. A cell's name is a hash of its settings and of its needs' names; versions of the code are not in it.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from ppo_dap import config as configs
from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.coverage import COVERAGES
from ppo_dap.methods import get_method, resolve
from ppo_dap.prior_config import FITTED, PRIOR_CONFIGS
from ppo_dap.tasks import describe

KINDS = ("behaviour", "logs", "prior", "run", "reliability")
Kind = Literal["behaviour", "logs", "prior", "run", "reliability"]
COUNTED = ("seed", "steps")
"""Settings of a run that nothing else depends on, and that a grid has many of."""
RANDOM = "random"
"""Stands for a prior that needs no cell: the control that proposes anything."""


@dataclass(frozen=True, eq=False, repr=False)
class Cell:
    """One thing to make. Two cells of the same name are the same."""

    kind: Kind
    settings: Mapping[str, Any]
    """Everything that decides what comes out, resolved; JSON values."""
    needs: Mapping[str, Cell] = field(default_factory=dict)
    """What must be there first, by its role."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Settings that are left out of the name where they have this value, so that a setting which a later version adds
    leaves the names of older cells as they are."""
    call: Mapping[str, Any] = field(default_factory=dict)
    """The options that lead to `settings`, for whoever makes the cell; not in the name."""

    @functools.cached_property
    def name(self) -> str:
        """16 hexadecimal digits."""
        own = {k: v for k, v in self.settings.items() if k not in self.defaults or self.defaults[k] != v}
        identity = {"kind": self.kind, "settings": own, "needs": {role: c.name for role, c in self.needs.items()}}
        return hashlib.sha256(json.dumps(identity, sort_keys=True, allow_nan=False).encode()).hexdigest()[:16]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cell) and other.name == self.name

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        return f"<{self.name}: {self}>"

    def __str__(self) -> str:
        """What a person calls it."""
        s = self.settings
        if self.kind == "behaviour":
            return f"behaviour of {s['task']}, seed {s['seed']}, {s['steps']:,} steps"
        if self.kind == "logs":
            return f"logs {s['tier']} of {s['task']}, {s['rows']:,} rows"
        if self.kind == "prior":
            source = self.needs["logs"].settings
            extra = "" if s["logs_filter"] == 1 else f", best {s['logs_filter']:.0%}"
            extra += "".join(f", {k} {v}" for k, v in self.call.items())
            return f"{s['kind']} prior on {s['coverage']} {source['tier']} logs of {source['task']}{extra}"
        if self.kind == "reliability":
            return f"reliability of {self.needs['run']}"
        shown = [f"{k} {v}" for k, v in self.call.items() if k not in (*COUNTED, "tensorboard")]
        shown += [f"{need.settings['tier']} logs" for role, need in self.needs.items() if role == "logs"]
        shown += [str(need) for role, need in self.needs.items() if role == "prior"]
        about = "".join(f"; {part}" for part in shown)
        return f"{s['method']} ({s['preset']}) on {s['task']}, seed {s['seed']}, {s['steps']:,} steps{about}"

    def description(self) -> dict[str, Any]:
        """What a store keeps of it."""
        needs = {role: cell.name for role, cell in self.needs.items()}
        return {
            "cell": self.name,
            "kind": self.kind,
            "settings": dict(self.settings),
            "call": dict(self.call),
            "needs": needs,
        }


def in_order(cells: Iterable[Cell]) -> list[Cell]:
    """The cells and all that they need, each once, every one after what it needs."""
    found: dict[Cell, None] = {}

    def add(cell: Cell) -> None:
        if cell not in found:
            for need in cell.needs.values():
                add(need)
            found[cell] = None

    for cell in cells:
        add(cell)
    return list(found)


def behaviour(task: str, seed: int, steps: int) -> Cell:
    """PPO's run that keeps its history, which logs are made from (`training.tiers.behave`)."""
    return Cell("behaviour", {"task": _spec(task).task, "seed": seed, "steps": steps})


def logs(task: str, tier: str, rows: int, seed: int, steps: int) -> Cell:
    """Logs of a tier by behaviours of our own (`training.tiers.make_tier`)."""
    tiers = {"random": 1, "medium": 1, "medium-replay": 1, "medium-expert": 1, "expert": 1, "mixed": 3}
    if tier not in tiers:
        raise unknown("tier", tier, tiers)
    needs = {f"behaviour{i}": behaviour(task, seed + i, steps) for i in range(tiers[tier])}
    settings = {"task": _spec(task).task, "tier": tier, "rows": rows, "seed": seed, "steps": steps}
    return Cell("logs", settings, needs)


def prior(
    source: Cell,
    kind: str = "diffusion",
    coverage: str = "wide",
    logs_filter: float = 1.0,
    seed: int = 0,
    coverage_fraction: float = 0.3,
    **options: Any,
) -> Cell:
    """A prior of this kind on logs, as `logs.coverage` thins them; `options` are fields of the kind's settings."""
    for what, value, known in (("kind", kind, FITTED), ("coverage", coverage, COVERAGES)):
        if value not in known:
            raise unknown(what, value, known)
    own = [f.name for f in dataclasses.fields(PRIOR_CONFIGS[kind])]
    for name in options:
        if name not in own:
            raise unknown(f"option of the {kind} prior", name, own)
    fit = dataclasses.asdict(PRIOR_CONFIGS[kind](**options))
    settings = {"kind": kind, "coverage": coverage, "logs_filter": logs_filter, "seed": seed, **fit}
    settings["coverage_fraction"] = coverage_fraction
    defaults = dataclasses.asdict(PRIOR_CONFIGS[kind]()) | {"logs_filter": 1.0, "coverage_fraction": 0.3}
    return Cell("prior", settings, {"logs": source}, defaults, options)


def run(
    task: str,
    method: str,
    preset: str = "paper",
    *,
    prior: Cell | Literal["random"] | None = None,
    logs: Cell | None = None,
    **options: Any,
) -> Cell:
    """A run as `training.run.train` makes it from the same arguments; raises its `InputError` for what cannot work."""
    chosen, spec = get_method(method), _spec(task)
    kind = None if prior is None else prior if isinstance(prior, str) else prior.settings["kind"]
    own = {name: value for name, value in options.items() if name not in COUNTED}
    counted = {name: value for name, value in options.items() if name in COUNTED}
    flat = _resolved(chosen.name, preset, kind, spec.gamma, tuple(sorted(own.items())))
    flat = flat | {name: _counted(name, value) for name, value in counted.items()}
    if (chosen.prior == "none") != (prior is None) or kind not in (None, RANDOM, chosen.prior):
        raise InputError(f"method {chosen.name} takes a prior of kind {chosen.prior!r}, not {kind!r}")
    if (flat["warm_start"] == "none") != (logs is None):
        given = "no logs" if logs is None else "logs"
        raise InputError(f"warm_start {flat['warm_start']!r} of method {chosen.name} does not go with {given}")
    needs = {} if logs is None else {"logs": logs}
    if isinstance(prior, Cell):
        needs["prior"] = prior
    settings = {"task": spec.task, "method": chosen.name, "preset": preset, **flat}
    if prior == RANDOM:
        settings["prior"] = RANDOM
    return Cell("run", settings, needs, _resolved("ppo", "paper", None, None, ()) | _unfelt(flat), options)


def _unfelt(flat: Mapping[str, Any]) -> dict[str, Any]:
    """A limit that this run does not reach, and what would follow it: it is made and named as without."""
    share, limit = flat["lambda_decay"], flat["lambda_decay_steps"]
    unfelt = limit is not None and share is not None and share * flat["steps"] <= limit
    return {name: flat[name] for name in ("lambda_decay_steps", "std_after")} if unfelt else {}


def reliability(of: Cell, states: int, rollouts: int, horizon: int | None = None, seed: int = 0) -> Cell:
    """The report of 5.7 on a finished run that has a prior."""
    settings = {"states": states, "rollouts": rollouts, "horizon": horizon, "seed": seed}
    return Cell("reliability", settings, {"run": of, "prior": of.needs["prior"]})


@functools.cache
def _resolved(method: str, preset: str, kind: str | None, gamma: float | None, options: tuple) -> dict[str, Any]:
    """All settings of a run as `training.run.train` resolves them. A grid has few that differ, and one takes 20 ms."""
    of_task, given = {} if gamma is None else {"gamma": gamma}, dict(options)
    return configs.flatten(resolve(get_method(method), configs.make(preset, **of_task | given), given, kind))


@functools.cache
def _counted(name: str, value: int) -> int:
    option: dict[str, Any] = {name: value}
    return configs.flatten(configs.make(**option))[name]


_spec = functools.cache(describe)
