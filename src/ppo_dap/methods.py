"""Table 3: every system as one line of one table. A method says which parts are on; the recipe is the same for all.

The parts are settings of `config`: surrogate, data reuse, guidance, PET, KL term, auxiliary terms, warm start; and the
kind of prior. A method that combines them in a new way is one more line of `METHODS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ppo_dap.config import Config, flatten, replace
from ppo_dap.errors import InputError, unknown

Fixed = Mapping[str, Any]
"""Setting -> the value that it has, or a tuple of those that it may have; the first is the default."""


@dataclass(frozen=True)
class Method:
    """One row: its prior, and the settings that make it what it is (a user cannot change those)."""

    name: str
    row: str
    """Name in the paper."""
    prior: str = "none"
    """Kind of prior, as `fit_prior` takes it."""
    fixed: Fixed = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Settings that a user may change."""
    needs_logs: bool = False
    """Whether logs are needed beside the prior."""
    source: str = "paper"
    """`paper`; `reconstruction` of a method that the paper names and nobody describes; or `ours`."""

    @property
    def strictly_on_policy(self) -> bool:
        """What the audit's verdict must be."""
        return not self.fixed.get("reuse_batches", 0)


_PLAIN: Fixed = {"surrogate": "clip", "lambda_awr": 0.0}
_NO_GUIDANCE: Fixed = {"guidance": "none"}
_COLD: Fixed = {**_PLAIN, "warm_start": "none"}
_WARM: Fixed = {**_PLAIN, "warm_start": ("actor", "actor_critic")}

METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method("ppo", "PPO (Vanilla)", fixed=_COLD),
        Method("ppo-bc", "PPO + BC Warmup", fixed=_WARM, needs_logs=True),
        Method("ppo-dap", "PPO-DAP (Ours)", "diffusion"),
        Method("ppo-dap-no-vg", "PPO-DAP (No-VG)", "diffusion", _NO_GUIDANCE),
        Method("ppo-dap-no-pet", "PPO-DAP (No-PET)", "diffusion", {"pet_frequency": 0}),
        Method("ppo-dap-prior-kl-only", "PPO-DAP (Prior-KL-only)", "diffusion", {**_NO_GUIDANCE, "lambda_aux": 0.0}),
        Method("ppo-dap-aux-only", "PPO-DAP (Aux-only)", "diffusion", {"lambda_kl": 0.0}),
        Method("ppo-behavior-kl", "PPO + Behavior-prior KL", "behaviour", {**_NO_GUIDANCE, "lambda_aux": 0.0}),
        Method("ppo-flow", "PPO + Flow-prior", "flow"),
        Method("ppo-vae", "VAE + PPO (ctrl)", "vae"),
        Method("ppo-retrieval", "Retrieval prior (2.3)", "retrieval", source="ours"),
        Method("ppo-awr", "PPO + AWR/AWAC-aux", fixed={"surrogate": "clip"}, defaults={"lambda_awr": 1e-2}),
        Method("ppo-abppo", "ABPPO", fixed={"surrogate": "authentic_boundary"}, source="reconstruction"),
        Method("ppo-arc", "PPO-ARC", fixed={**_COLD, "reuse_batches": 1}, source="reconstruction"),
        Method("ppo-gc", "PPO-GC", fixed={"surrogate": "generalised_clip"}, source="reconstruction"),
    )
}
ALIASES = {"diffusion-novg": "ppo-dap-no-vg"}
"""Other names of the paper for the same algorithm (Table 7's Diffusion-NoVG is No-VG)."""

_LIMITS: Fixed = {"guidance": ("energy", "none"), "pet_frequency": 0, "prior_return_weight": 1.0}
_REASONS = {
    "guidance": "only a diffusion prior has denoising steps to guide (Table 3, notes: flow and VAE have energy alone)",
    "pet_frequency": "adapters are the diffusion prior's (Table 3: PET is off for the others)",
    "prior_return_weight": "classifier-free guidance is the diffusion prior's",
    "reuse_batches": "only ppo-arc reuses rows of an earlier policy, and is not strictly on-policy",
}
_PARTS = (
    "guidance", "pet_frequency", "lambda_kl", "lambda_aux", "prior_return", "mode_seeking", "guidance_gate",
    "q_calibration", "q_warm_start",
)  # fmt: skip
"""Options that switch on what only a prior has; the knobs of it are harmless without."""
_NEEDS: dict[str, tuple[str, Any]] = {
    "clip_slope": ("surrogate", "generalised_clip"),
    "boundary_kl": ("surrogate", "authentic_boundary"),
    "contest_kl_weight": ("reuse_batches", 1),
}
"""Option -> (setting, value) without which it has no effect."""


TABLES = {
    "What each method uses (Table 3)": (
        "method", "paper", "source", "strictly on-policy", "prior", "value guidance", "PET", "extra losses",
    ),
    "Its knobs (Table 7), and what its loss is made of": (
        "method", "K", "N_steps", "grad-guided", "f", "r", "surrogate", "advantages on logs", "earlier policies' rows",
    ),
}  # fmt: skip
"""Columns of `capability_rows`, as they are printed."""


def get_method(name: str) -> Method:
    """The method of that name or alias; raises `InputError` that lists the names."""
    method = METHODS.get(ALIASES.get(name, name))
    if method is None:
        raise unknown("method", name, [*METHODS, *ALIASES])
    return method


def limits(method: Method, kind: str | None = None) -> Fixed:
    """What `method` fixes, and what its prior's kind cannot do (`kind` where another takes its place)."""
    kind = kind or method.prior
    return {**({} if kind in ("none", "diffusion") else _LIMITS), "reuse_batches": 0, **method.fixed}


def resolve(method: Method, config: Config, given: Mapping[str, Any], kind: str | None = None) -> Config:
    """`config` with what the method and its prior's kind fix; `given` are the options that a user set.

    Raises `InputError`, with the reason, for one that contradicts the method or has no effect in it.
    """
    config = replace(config, **{name: value for name, value in method.defaults.items() if name not in given})
    chosen: dict[str, Any] = {}
    for name, value in limits(method, kind).items():
        allowed = value if isinstance(value, tuple) else (value,)
        if name in given and given[name] not in allowed:
            reason = f": {_REASONS[name]}" if name in _REASONS and name not in method.fixed else ""
            raise InputError(
                f"{name} {given[name]!r} contradicts method {method.name}, which has {name} "
                f"{' or '.join(repr(v) for v in allowed)}{reason}"
            )
        current = flatten(config)[name]
        chosen[name] = current if current in allowed else allowed[0]
    config = replace(config, **chosen)
    if method.prior == "none" and config.ppo.initial_std is None:
        if "initial_std" in given:
            raise InputError(f"initial_std None is the prior's, and method {method.name} has none: give a number")
        config = replace(config, initial_std=1.0)
    for name in given:
        _require_effect(name, given[name], method, flatten(config))
    return config


def _require_effect(name: str, value: Any, method: Method, settings: Mapping[str, Any]) -> None:
    told = f"{name} {value!r} has no effect in method {method.name}"
    if method.prior == "none" and name in _PARTS:
        raise InputError(f"{told}, which has no prior: choose a method that has one, or leave it out")
    needed = _NEEDS.get(name)
    if needed is not None and settings[needed[0]] != needed[1]:
        raise InputError(f"{told}: it needs {needed[0]} {needed[1]!r}")
    if name.startswith("awr_") and not settings["lambda_awr"]:
        raise InputError(f"{told}: it needs lambda_awr above 0")
    if name == "std_after" and value and settings["lambda_decay_steps"] is None:
        raise InputError(f"{told}: it needs lambda_decay_steps")


def capability_rows() -> list[dict[str, str]]:
    """The capability matrix of Table 3, one dict a row; beside it the knobs of Table 7."""
    return [_row(method, resolve(method, Config(), {})) for method in METHODS.values()]


def _row(method: Method, config: Config) -> dict[str, str]:
    guided, proposals, objective = method.prior != "none", config.proposals, config.objective
    adapted = guided and config.adaptation.pet_frequency > 0
    losses = {
        "soft prior-KL": guided and objective.lambda_kl > 0,
        "auxiliary BC": guided and objective.lambda_aux > 0,
        "advantage-weighted BC": objective.lambda_awr > 0,
    }
    denoises = method.prior == "diffusion"
    sampled = guided and not (method.prior == "behaviour" and not objective.lambda_aux)
    return {
        "method": method.name,
        "paper": method.row,
        "source": method.source,
        "strictly on-policy": "yes" if method.strictly_on_policy else "no",
        "advantages on logs": "no",
        "prior": "warm start" if method.needs_logs else method.prior,
        "value guidance": proposals.guidance if guided and proposals.guidance != "none" else "no",
        "PET": "yes" if adapted else "no",
        "extra losses": " + ".join(name for name, on in losses.items() if on)
        or ("offline BC only" if method.needs_logs else "none"),
        "K": str(proposals.num_proposals) if sampled else "-",
        "N_steps": str(proposals.sampler_steps) if denoises else "-",
        "grad-guided": ("yes" if "gradient" in proposals.guidance else "no") if denoises else "-",
        "f": str(config.adaptation.pet_frequency) if denoises else "-",
        "r": str(config.adaptation.adapter_rank) if adapted else "-",
        "surrogate": config.ppo.surrogate,
        "earlier policies' rows": "1 batch" if config.ppo.reuse_batches else "no",
    }
