"""Table 3: every system as one line of one table. A method says which parts are on; the recipe is the same for all."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from ppo_dap.config import Config, flatten, replace
from ppo_dap.errors import InputError, unknown


@dataclass(frozen=True)
class Method:
    """One row of Table 3: its prior, and the settings that make it what it is (a user cannot change those)."""

    name: str
    row: str
    """Name in the paper."""
    prior: Literal["none", "diffusion"] = "none"
    fixed: dict[str, Any] = field(default_factory=dict)
    needs_logs: bool = False
    """Whether logs are needed beside the prior."""


_NO_GUIDANCE = {"guidance": "none"}

METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        Method("ppo", "PPO (Vanilla)", fixed={"warm_start": "none"}),
        Method("ppo-bc", "PPO + BC Warmup", fixed={"warm_start": ("actor", "actor_critic")}, needs_logs=True),
        Method("ppo-dap", "PPO-DAP (Ours)", "diffusion"),
        Method("ppo-dap-no-vg", "PPO-DAP (No-VG)", "diffusion", _NO_GUIDANCE),
        Method("ppo-dap-no-pet", "PPO-DAP (No-PET)", "diffusion", {"pet_frequency": 0}),
        Method("ppo-dap-prior-kl-only", "PPO-DAP (Prior-KL-only)", "diffusion", {**_NO_GUIDANCE, "lambda_aux": 0.0}),
        Method("ppo-dap-aux-only", "PPO-DAP (Aux-only)", "diffusion", {"lambda_kl": 0.0}),
    )
}
ALIASES = {"diffusion-novg": "ppo-dap-no-vg"}
"""Other names of the paper for the same algorithm (Table 7's Diffusion-NoVG is No-VG)."""


def get_method(name: str) -> Method:
    """The method of that name or alias; raises `InputError` that lists the names."""
    method = METHODS.get(ALIASES.get(name, name))
    if method is None:
        raise unknown("method", name, [*METHODS, *ALIASES])
    return method


def resolve(method: Method, config: Config, given: dict[str, Any]) -> Config:
    """`config` with what the method fixes; `given` are the options a user set, which must not contradict it."""
    chosen: dict[str, Any] = {}
    for name, value in method.fixed.items():
        allowed = value if isinstance(value, tuple) else (value,)
        if name in given and given[name] not in allowed:
            raise InputError(
                f"{name} {given[name]!r} contradicts method {method.name}, which has {name} "
                f"{' or '.join(repr(v) for v in allowed)}"
            )
        current = flatten(config)[name]
        chosen[name] = current if current in allowed else allowed[0]
    return replace(config, **chosen)


def capability_rows() -> list[dict[str, str]]:
    """The capability matrix of Table 3 for the methods that are here, one dict a row."""
    rows = []
    for method in METHODS.values():
        config = resolve(method, Config(), {})
        guided = method.prior != "none"
        guidance = config.proposals.guidance
        losses = [
            name
            for name, on in (
                ("soft prior-KL", guided and config.objective.lambda_kl > 0),
                ("auxiliary BC", guided and config.objective.lambda_aux > 0),
            )
            if on
        ]
        rows.append(
            {
                "method": method.name,
                "paper": method.row,
                "strictly on-policy": "yes",
                "advantages on logs": "no",
                "prior": "warm start" if method.needs_logs else method.prior,
                "value guidance": guidance if guided and guidance != "none" else "no",
                "PET": "yes" if guided and config.adaptation.pet_frequency else "no",
                "extra losses": " + ".join(losses) or ("offline BC only" if method.needs_logs else "none"),
            }
        )
    return rows
