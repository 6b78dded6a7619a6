"""Every setting of a run, as frozen dataclasses: the paper's Table 2, the PPO recipe, and what both leave open.

Field names are unique over all groups, so one flat name (`lambda_kl`, on the command line `--lambda-kl`) finds its
field; `replace` does that. `PRESETS` holds the settings that results are quoted with: `paper` is Table 2 to the letter,
`tuned` the best that our own studies found with a prior alone, `tuned-warm` with logs that also start the networks
(docs/results.md says on which seeds).
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass, field
from typing import Any, Literal

from ppo_dap.errors import InputError, unknown
from ppo_dap.fields import AT_LEAST_0, POSITIVE, SHARE, Rule, type_hints, validate_fields


@dataclass(frozen=True)
class PPOConfig:
    """The one PPO recipe, the same for every method."""

    num_envs: int = 8
    """Environments stepped side by side."""
    rollout_steps: int = 2048
    """Environment steps of one iteration, over all environments (size of D_on)."""
    minibatch_size: int = 256
    """Rows of one actor update (Table 2: batch size)."""
    num_epochs: int = 10
    """Passes over D_on in one iteration."""
    learning_rate: float = 3e-4
    """Adam's rate at the start; decays linearly to 0 over the run."""
    gamma: float = 0.99
    """Discount (Eq. 1); Swimmer-v5 has 0.9999 unless it is set (docs/tasks.md)."""
    gae_lambda: float = 0.95
    """GAE's lambda (Table 2)."""
    clip_epsilon: float = 0.2
    """Clip range of the importance ratio (Eq. 5, Table 2)."""
    value_coefficient: float = 0.5
    """Weight of the value loss."""
    max_grad_norm: float = 0.5
    """Global gradient norm at which the actor's and the critic's gradients are clipped, each on its own."""
    kl_rule: Literal["stop_epochs", "reduce_lr", "monitor"] = "stop_epochs"
    """What happens when the policy-KL of an epoch exceeds `kl_target`: skip the iteration's remaining epochs, halve
    the learning rate from the next iteration on (until the KL falls below half the target), or only log it."""
    kl_target: float = 0.02
    """Policy-KL monitoring target (Table 2)."""
    hidden_size: int = 64
    """Width of the two tanh layers of actor and critic."""
    initial_std: float | None = 1.0
    """Standard deviation that the policy starts with, in scaled actions; None: the prior's own (`Prior.spread`), from
    `warm_start_std_floor` to 1, so that fresh states are those that the prior knows. A warm start of the actor sets it
    anew."""
    observation_clip: float = 10.0
    """Normalised observations are clipped to this many standard deviations."""
    reward_clip: float = 10.0
    """Scaled rewards are clipped to this absolute value."""
    surrogate: Literal["clip", "authentic_boundary", "generalised_clip"] = "clip"
    """Objective of the actor: Eq. 5, or the reconstructions of ABPPO's and of PPO-GC's (ppo/surrogate.py)."""
    clip_slope: float = 0.1
    """alpha: slope of the generalised clip outside the clip range; 0 is Eq. 5, 1 does not clip at all."""
    boundary_kl: float | None = None
    """delta: KL ball in nats, in which the authentic boundary bounds the ratio; None: the one for which the upper bound
    is 1 + clip_epsilon on average, by the number of action dimensions."""
    reuse_batches: int = 0
    """1: PPO-ARC as reconstructed (ppo/reuse.py), an update on the current and the previous batch competes with PPO's,
    which is not strictly on-policy and the audit reports it; 0: PPO."""
    contest_kl_weight: float = 1.0
    """beta: weight of the policy-KL in the score that decides PPO-ARC's contest."""


@dataclass(frozen=True)
class ProposalConfig:
    """Value-guided proposals (4.3) and the Gaussian proxy (Eq. 10)."""

    num_proposals: int = 10
    """K: candidate actions a state (Table 2)."""
    sampler: Literal["ancestral", "dpmpp_2m"] = "ancestral"
    """Denoising solver: the stochastic one of Eq. 8, or DPM-Solver++ 2M, which needs half the steps (4.7)."""
    sampler_steps: int = 20
    """N_steps: denoising steps (Table 2)."""
    proposal_fraction: float = 0.2
    """Share of D_on's states that get proposals, drawn anew in each iteration; 1 is Algorithm 1 to the letter."""
    guidance: Literal["none", "energy", "gradient", "energy+gradient"] = "energy+gradient"
    """Value guidance: energy weights (Eq. 7), gradient inside the denoising (Eq. 8), both, or none."""
    beta_max: float = 1.0
    """Energy temperature after annealing (Eq. 7)."""
    beta_anneal: float = 0.3
    """Fraction of the iterations over which beta rises linearly from 0."""
    alpha_max: float = 0.3
    """Gradient guidance at zero noise (Eq. 8)."""
    guidance_cap: float = 0.1
    """c: largest norm of one guidance step (4.3)."""
    cap_on: Literal["step", "gradient"] = "step"
    """What the cap bounds: alpha_t * grad Q (4.3), or grad Q before alpha_t (Table 2, 5.5)."""
    displacement_cap: float | None = None
    """Largest norm of all guidance steps of one proposal together, in scaled actions; None: no such bound."""
    q_scale: Literal["running", "none"] = "running"
    """Eq. 7 sees Q less the state's mean over one running global scale, or Q as printed."""
    top_k: int | None = None
    """Keep only the k proposals of a state with the highest Q before weighting (4.3); None keeps all."""
    proxy_std_floor: float = 0.1
    """Smallest standard deviation of the Gaussian proxy (Eq. 10), in scaled actions."""
    keep_diverse: int | None = None
    """Of a state's proposals keep this many that lie farthest apart, before weighting (5.6: diversity-aware sampling,
    for a larger K); None keeps all."""
    guidance_gate: bool = False
    """Multiply beta and alpha by the rank correlation of Q - V with the advantages of fresh rows, from 0 (Q ranks no
    better than chance) to 1 (5.6: gating)."""
    q_pessimism: float = 0.0
    """Standard deviations between Q's heads by which proposals see Q lower (needs q_heads of 2 or more)."""
    mode_seeking: float = 0.0
    """kappa: energy weights become exp(beta Q + kappa log pi(a|s)), so that proposals near the mode that the policy is
    in count more; 0 is Eq. 7."""
    prior_return: Literal["none", "top"] = "none"
    """What a prior that was fitted with condition_on 'return' is asked for: nothing, or the logs' best returns."""
    prior_return_weight: float = 1.0
    """Classifier-free guidance: how far beyond the unconditioned prior the diffusion prior goes towards what it is
    asked for; 1 is the conditioned prior itself, other numbers cost twice the sampling."""


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of what is added to PPO's objective (Eq. 9)."""

    lambda_kl: float = 5e-3
    """Weight of KL(pi || proxy) (Table 2)."""
    lambda_aux: float = 1e-2
    """Weight of the imitation of proposals (Table 2)."""
    lambda_decay: float | None = None
    """Share of the run in which all these weights decay linearly to 0; then it is PPO alone. None keeps them."""
    lambda_decay_steps: int | None = None
    """Environment steps after which they are 0 at the latest, however long the run; None sets no limit."""
    std_floor: float = 0.0
    """KL and imitation leave the policy's standard deviations alone, in scaled actions, where they are at or below it;
    0 is Eq. 9, whose terms make a policy that seeks its own mode all but deterministic."""
    std_after: float = 0.0
    """Least standard deviation that the policy goes on with, times the share of their time that the limit cut off."""
    lambda_awr: float = 0.0
    """Weight of advantage-weighted imitation of the policy's own fresh actions (PPO + AWR/AWAC-aux)."""
    awr_temperature: float = 1.0
    """tau: weights are exp(standardised advantage / tau)."""
    awr_weight_cap: float = 20.0
    """Largest weight of a row."""


@dataclass(frozen=True)
class QConfig:
    """The action-value head that guides proposals; it never touches PPO."""

    q_trunk: Literal["stop_gradient", "shared", "separate"] = "stop_gradient"
    """Features Q reads: the value trunk's with the gradient stopped, the same with its gradient let in (the audit
    reports it), or a trunk of its own."""
    q_hidden_size: int = 64
    """Width of Q's hidden layer."""
    q_learning_rate: float = 1e-3
    """Adam's rate for Q."""
    q_epochs: int = 2
    """Passes over D_on a Q update makes in each iteration."""
    q_target: Literal["td", "gae", "advantage"] = "td"
    """What Q is regressed on: r + gamma V(s') (4.4), GAE's returns, or GAE's advantages (5.7: advantage-energy)."""
    q_heads: int = 1
    """Heads of Q, which differ by their start; 2 are twin heads."""
    q_calibration: Literal["none", "affine", "isotonic"] = "none"
    """Map Q, before it guides, to the returns that followed it on the last rollout (5.6); the host waits for Q then."""


@dataclass(frozen=True)
class AdaptationConfig:
    """Parameter-efficient tuning of the prior on D_on (4.2, PET)."""

    pet_frequency: int = 10
    """f: PET steps per 100 actor updates (minibatch steps); 0 is No-PET (Table 2)."""
    pet_learning_rate: float = 1e-5
    """Adam's rate for the adapters (Table 2)."""
    pet_minibatch_size: int = 256
    """Rows of one PET step, all from D_on."""
    adapter: Literal["lora", "bottleneck"] = "lora"
    """Kind of adapter; both start as an exact identity."""
    adapter_rank: int = 8
    """r: rank of LoRA, width of the bottleneck (Table 2)."""


@dataclass(frozen=True)
class WarmStartConfig:
    """Supervised start of the networks from logs (3.4, optional)."""

    warm_start: Literal["none", "actor", "actor_critic"] = "none"
    """What logs initialise: nothing, the actor (maximum likelihood) and the normaliser, or also V and Q (logged
    returns-to-go)."""
    warm_start_epochs: int = 20
    """Most passes over the logs; early stopping on held-out episodes ends it sooner."""
    warm_start_std_floor: float = 0.2
    """Smallest standard deviation that logs or a prior start the policy with, in scaled actions, so that PPO can still
    explore."""
    q_warm_start: bool = False
    """With `warm_start = actor`, start Q as well, by regression on logged returns-to-go; `actor_critic` always does."""
    logs_filter: float = 1.0
    """Share of the logs' rows that a warm start sees: whole episodes, those of the highest return first."""


@dataclass(frozen=True)
class RunConfig:
    """What surrounds the learning."""

    steps: int = 1_000_000
    """Environment steps of the run (Table 2)."""
    seed: int = 0
    """Seed of everything random."""
    eval_every: int = 10_000
    """Environment steps between evaluations of the deterministic policy; 0: none but the last."""
    eval_episodes: int = 5
    """Episodes of an evaluation, side by side."""
    checkpoint_every: int = 25
    """Iterations between checkpoints; environments restart there, in every run."""
    threads: int = 1
    """Threads that step the environments."""
    pin_core: bool = True
    """Keep a run with one thread on a core that no other run has claimed, so that handing over to the environments'
    thread wakes no other core."""
    tensorboard: bool = True
    """Write TensorBoard event files."""
    keep_history: bool = False
    """Keep each iteration's rollout and each evaluation's policy, for `ppo-dap collect`."""


@dataclass(frozen=True)
class Config:
    """All settings of one run."""

    ppo: PPOConfig = field(default_factory=PPOConfig)
    proposals: ProposalConfig = field(default_factory=ProposalConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    q: QConfig = field(default_factory=QConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)
    warm: WarmStartConfig = field(default_factory=WarmStartConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self):
        validate(self)


PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "tuned": {
        "lambda_kl": 3.0, "lambda_aux": 0.1, "mode_seeking": 1.0, "guidance_gate": True, "kl_rule": "monitor",
        "lambda_decay": 0.5, "lambda_decay_steps": 100_000, "initial_std": None, "std_floor": 0.3, "std_after": 0.75,
    },
    "tuned-warm": {
        "lambda_kl": 0.2, "lambda_aux": 0.0, "lambda_decay": 0.5, "kl_rule": "monitor",
        "warm_start": "actor_critic", "logs_filter": 0.3,
    },
}  # fmt: skip


@functools.cache
def field_groups() -> dict[str, str]:
    """Flat field name -> name of its group in `Config`."""
    groups = type_hints(Config)
    return {f.name: group for group, cls in groups.items() for f in dataclasses.fields(cls)}


def replace(config: Config, **options: Any) -> Config:
    """`config` with flat `options` replaced; raises `InputError` for an unknown name or an impossible value."""
    owner = field_groups()
    changes: dict[str, dict[str, Any]] = {}
    for name, value in options.items():
        if name not in owner:
            raise unknown("option", name, owner)
        whole = isinstance(value, int) and not isinstance(value, bool)
        changes.setdefault(owner[name], {})[name] = float(value) if whole and name in _FLOATS else value
    groups = {g: dataclasses.replace(getattr(config, g), **values) for g, values in changes.items()}
    return dataclasses.replace(config, **groups)


def make(preset: str = "paper", **options: Any) -> Config:
    """The named preset with flat `options` on top."""
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return replace(Config(), **{**PRESETS[preset], **options})


def flatten(config: Config) -> dict[str, Any]:
    """Flat name -> value, the inverse of `replace(Config(), **flat)`."""
    return {name: getattr(getattr(config, group), name) for name, group in field_groups().items()}


# name -> (predicate, what would be right); every number a user can set is in here.
# fmt: off
_RULES: dict[str, Rule] = {
    **dict.fromkeys(
        ("num_envs", "rollout_steps", "minibatch_size", "num_epochs", "hidden_size", "num_proposals", "sampler_steps",
         "q_hidden_size", "q_epochs", "pet_minibatch_size", "adapter_rank", "warm_start_epochs", "steps",
         "eval_episodes", "checkpoint_every", "threads", "learning_rate", "max_grad_norm", "kl_target",
         "observation_clip", "reward_clip", "guidance_cap", "proxy_std_floor", "q_learning_rate", "pet_learning_rate",
         "warm_start_std_floor", "clip_epsilon", "q_heads", "awr_temperature", "awr_weight_cap"),
        POSITIVE,
    ),
    **dict.fromkeys(
        ("value_coefficient", "beta_max", "alpha_max", "lambda_kl", "lambda_aux", "lambda_awr", "pet_frequency",
         "eval_every", "q_pessimism", "mode_seeking", "std_floor", "std_after", "prior_return_weight",
         "contest_kl_weight"),
        AT_LEAST_0,
    ),
    "seed": (lambda v: 0 <= v < 2**32, "a number from 0 to 4294967295"),
    **dict.fromkeys(["proposal_fraction", "beta_anneal", "logs_filter"], SHARE),
    **dict.fromkeys(("gamma", "gae_lambda"), (lambda v: 0 <= v <= 1, "a number from 0 to 1")),
    "clip_slope": (lambda v: -1 <= v <= 1, "a number from -1 to 1"),
    "reuse_batches": (lambda v: 0 <= v <= 1, "a number from 0 to 1"),
    **dict.fromkeys(
        ("displacement_cap", "top_k", "keep_diverse", "boundary_kl", "lambda_decay_steps", "initial_std"),
        (lambda v: v is None or v > 0, "a number above 0, or None"),
    ),
    "lambda_decay": (lambda v: v is None or 0 < v <= 1, "a number above 0 and at most 1, or None"),
}
# fmt: on


def validate(config: Config) -> None:
    """Raise `InputError` for the first field whose type or value cannot work, naming what would be right."""
    for group in type_hints(Config):
        validate_fields(getattr(config, group), _RULES)
    ppo = config.ppo
    if ppo.rollout_steps % ppo.num_envs:
        raise InputError(f"rollout_steps {ppo.rollout_steps} must be a multiple of num_envs {ppo.num_envs}")
    if ppo.rollout_steps % ppo.minibatch_size:
        raise InputError(f"rollout_steps {ppo.rollout_steps} must be a multiple of minibatch_size {ppo.minibatch_size}")
    proposals = config.proposals
    most = proposals.num_proposals
    for name in ("keep_diverse", "top_k"):
        value = getattr(proposals, name)
        if value is not None and value > most:
            what = "keep_diverse" if most != proposals.num_proposals else "num_proposals"
            raise InputError(f"{name} {value} must be at most {what} {most}")
        most = value or most
    if config.warm.q_warm_start and config.warm.warm_start == "none":
        raise InputError("q_warm_start needs a warm_start: 'actor', or 'actor_critic', which starts Q as well")
    if proposals.q_pessimism and config.q.q_heads < 2:
        raise InputError(f"q_pessimism {proposals.q_pessimism} needs q_heads of 2 or more, not {config.q.q_heads}")


_FLOATS = frozenset(
    f.name
    for cls in type_hints(Config).values()
    for f in dataclasses.fields(cls)
    if float in (typing.get_args(type_hints(cls)[f.name]) or (type_hints(cls)[f.name],))
)
"""Fields that take a number; a whole one given for it becomes a float."""
