"""Settings of the priors, apart from `config` because they belong to Stage I and are kept in the prior's file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from ppo_dap.errors import InputError
from ppo_dap.fields import AT_LEAST_0, POSITIVE, SHARE, Rule, validate_fields

CONDITIONS = {"none": 0, "return": 2}
"""What a prior can be conditioned on beside the observation, and how many numbers that takes."""


@dataclass(frozen=True)
class FromLogs:
    """What every prior that is made from logs has."""

    kind: ClassVar[str]
    rules: ClassVar[dict[str, Rule]] = {}
    """Of the kind's own fields, where they are no numbers above 0."""
    condition_on: Literal["none", "return"] = "none"
    """What the prior can be asked for: nothing, or the return of the episode that an action comes from (then the logs
    need rewards)."""
    validation_fraction: float = 0.1
    """Share of the episodes that is held out."""

    def __post_init__(self):
        validate_fields(self, field_rules(type(self)))
        if self.validation_fraction >= 1:
            raise InputError(f"validation_fraction must be below 1, not {self.validation_fraction!r}")

    @property
    def num_conditions(self) -> int:
        """Numbers beside the observation that the prior is conditioned on."""
        return CONDITIONS[self.condition_on]


@dataclass(frozen=True)
class FitConfig(FromLogs):
    """What the fit of every trained prior has."""

    condition_dropout: float = 0.2
    """Share of the rows whose condition is hidden in the fit, so that the prior can also be asked for nothing."""
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

    def __post_init__(self):
        super().__post_init__()
        if self.ema_decay >= 1:
            raise InputError(f"ema_decay must be below 1, not {self.ema_decay!r}")


@dataclass(frozen=True)
class DiffusionConfig(FitConfig):
    """Network, noise range, fit and default sampler of a diffusion prior."""

    kind = "diffusion"
    width: int = 96
    """Units of the layers that see the noisy action: what sampling costs."""
    depth: int = 1
    """Hidden layers between the first and the output layer: the place of the adapters."""
    state_width: int = 128
    """Units of the two layers that see the state, once for all proposals and steps."""
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
    sampler: Literal["ancestral", "dpmpp_2m"] = "ancestral"
    """Solver of `Prior.sample`."""
    sampler_steps: int = 20
    """Denoising steps of `Prior.sample`."""

    def __post_init__(self):
        super().__post_init__()
        if not self.sigma_min < self.sigma_max:
            raise InputError(f"sigma_min {self.sigma_min} must be below sigma_max {self.sigma_max}")


@dataclass(frozen=True)
class RetrievalConfig(FromLogs):
    """Memory and distance of a retrieval prior."""

    kind = "retrieval"
    whitening: Literal["columns", "covariance"] = "columns"
    """What makes distances in states comparable: each column's spread, or the covariance of all of them."""
    return_weight: float = 1.0
    """With condition_on 'return': what a standard deviation of the return counts in the distance, where one of a
    state's column counts 1."""
    max_rows: int = 100_000
    """Most rows that are kept, drawn by the seed: a search compares each state with all of them."""


@dataclass(frozen=True)
class RandomConfig:
    """The random control has no settings: it is made without logs and knows no condition."""

    kind: ClassVar[str] = "random"
    num_conditions: ClassVar[int] = 0


@dataclass(frozen=True)
class BehaviourConfig(FitConfig):
    """A cloned Gaussian policy: the prior of "PPO + Behavior-prior KL" in Table 3."""

    kind = "behaviour"
    rules: ClassVar[dict[str, Rule]] = {"log_std_floor": (lambda v: v < 0, "a number below 0")}
    learning_rate: float = 2e-3
    """Adam's rate after warm-up; falls to 0 along a cosine over `max_steps`."""
    max_steps: int = 3_000
    """Most steps of the fit."""
    width: int = 128
    """Units of the two hidden layers."""
    log_std_floor: float = -2.0
    """What the log standard deviation stays above: as the clone's spread goes to 0, the KL to it goes to infinity."""


@dataclass(frozen=True)
class FlowConfig(FitConfig):
    """A conditional normalising flow: the prior of "PPO + Flow-prior" in Table 3."""

    kind = "flow"
    learning_rate: float = 2e-3
    """Adam's rate after warm-up; falls to 0 along a cosine over `max_steps`."""
    max_steps: int = 2_000
    """Most steps of the fit."""
    couplings: int = 4
    """Affine couplings between the noise and the action."""
    width: int = 64
    """Units of the two layers of a coupling that see the action."""
    state_width: int = 128
    """Units of the two layers that see the state, once for all actions and couplings."""
    dequantization: float = 0.005
    """Half-width of the uniform noise that the fit adds, in scaled actions, to give actions at a bound a density."""


@dataclass(frozen=True)
class VAEConfig(FitConfig):
    """A conditional variational autoencoder: the prior of "VAE + PPO (ctrl)" in Table 7."""

    kind = "vae"
    learning_rate: float = 1e-3
    """Adam's rate after warm-up; falls to 0 along a cosine over `max_steps`."""
    max_steps: int = 2_000
    """Most steps of the fit."""
    width: int = 256
    """Units of the two hidden layers of the encoder and of the decoder."""
    latents_per_action: int = 2
    """Numbers of the latent code for each action dimension."""
    kl_weight: float = 0.5
    """Weight of the mean KL of a latent number beside the mean squared error of an action dimension (BCQ's)."""


_KINDS = (DiffusionConfig, BehaviourConfig, FlowConfig, VAEConfig, RetrievalConfig, RandomConfig)
PRIOR_CONFIGS: dict[str, Any] = {config.kind: config for config in _KINDS}
"""Kind of prior -> its settings."""
FITTED = tuple(kind for kind, config in PRIOR_CONFIGS.items() if issubclass(config, FromLogs))
"""The kinds that are made from logs, which `fit_prior` takes."""


def field_rules(config: type) -> dict[str, Rule]:
    """What is right for each field of a prior's settings."""
    rules = {f.name: POSITIVE for f in dataclasses.fields(config)}
    rules |= dict.fromkeys(("warmup_steps", "ema_decay"), AT_LEAST_0)
    return rules | {"condition_dropout": SHARE} | config.rules  # type: ignore[attr-defined]
