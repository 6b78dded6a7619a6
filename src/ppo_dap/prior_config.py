"""Settings of the priors, apart from `config` because they belong to Stage I and are kept in the prior's file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from ppo_dap.errors import InputError
from ppo_dap.fields import AT_LEAST_0, POSITIVE, validate_fields


@dataclass(frozen=True)
class DiffusionConfig:
    """Network, noise range, fit and default sampler of a diffusion prior."""

    width: int = 96
    """Units of the layers that see the noisy action: what sampling costs."""
    depth: int = 1
    """Hidden layers between the first and the output layer: the place of the adapters."""
    state_width: int = 128
    """Units of the two layers that see the state, once for all proposals and steps."""
    num_conditions: int = 0
    """Numbers beside the observation that the prior is conditioned on."""
    sigma_min: float = 0.02
    """Smallest noise level, in scaled actions."""
    sigma_max: float = 5.0
    """Largest noise level; must exceed the box's width for the start to forget the action."""
    rho: float = 7.0
    """Spacing of the sampling levels (Karras et al., Eq. 5)."""
    noise_distribution: Literal["lognormal", "loguniform"] = "lognormal"
    """P(sigma) of Eq. 6."""
    loss_weighting: Literal["edm", "none"] = "edm"
    """Weight of a noise level in the loss: Karras et al.'s, which lets each level count the same, or Eq. 6 as is."""
    batch_size: int = 512
    """Rows of one step of the fit."""
    learning_rate: float = 5e-3
    """Adam's rate after warm-up; falls to 0 along a cosine over `max_steps`."""
    warmup_steps: int = 200
    """Steps over which the rate rises from 0."""
    max_steps: int = 6_000
    """Most steps of the fit."""
    chunk_steps: int = 200
    """Steps between two looks at the held-out loss."""
    patience: int = 10
    """Looks at the held-out loss without a better one before the fit stops."""
    ema_decay: float = 0.999
    """Decay of the averaged weights, which are the ones that are validated and kept."""
    validation_fraction: float = 0.1
    """Share of the episodes that is held out."""
    sampler: Literal["ancestral", "dpmpp_2m"] = "ancestral"
    """Solver of `Prior.sample`."""
    sampler_steps: int = 20
    """Denoising steps of `Prior.sample`."""

    def __post_init__(self):
        validate_fields(self, _RULES)
        if not self.sigma_min < self.sigma_max:
            raise InputError(f"sigma_min {self.sigma_min} must be below sigma_max {self.sigma_max}")
        for name in ("validation_fraction", "ema_decay"):
            if getattr(self, name) >= 1:
                raise InputError(f"{name} must be below 1, not {getattr(self, name)!r}")


_RULES = {f.name: POSITIVE for f in dataclasses.fields(DiffusionConfig)}
_RULES |= dict.fromkeys(("num_conditions", "warmup_steps", "ema_decay"), AT_LEAST_0)
