"""Stage I: fit a prior to logs (Section 4.2)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ppo_dap.errors import InputError, TrainingDiverged, unknown
from ppo_dap.logs.dataset import Logs
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig, LossDraws, denoising_loss
from ppo_dap.priors.prior import DiffusionPrior, scale_actions

PROBE_ROWS = 256
VALIDATION_ROWS = 8192
SMALLEST_SIGMA_DATA = 0.05
MOMENT_ROWS = 2**18
FIT_STREAM = 3
"""Keeps the fit's random numbers apart from those of the split of episodes."""


class Rows(NamedTuple):
    """Rows to fit to, with scaled actions."""

    observations: Float[Array, "rows obs"]
    condition: Float[Array, "rows c"]
    actions: Float[Array, "rows act"]


class FitProgress(NamedTuple):
    """What a progress callback is told after each chunk of steps."""

    step: int
    max_steps: int
    train_loss: float
    validation_loss: float
    seconds: float


class FitState(NamedTuple):
    """Everything that changes from step to step."""

    denoiser: Denoiser
    ema: Denoiser
    optimizer: Any
    step: Array


Progress = Callable[[FitProgress], None]


def fit_prior(
    logs: Logs, kind: str = "diffusion", *, seed: int = 0, progress: Progress | None = None, **options: Any
) -> DiffusionPrior:
    """Fit a prior of the given kind to `logs`.

    Options are the fields of the kind's config (`DiffusionConfig`), and `action_low` and `action_high` for logs that
    do not carry the action space's bounds, or carry infinite ones.
    """
    if kind not in _FITTERS:
        raise unknown("prior kind", kind, _FITTERS)
    return _FITTERS[kind](logs, seed, progress, options)


def fit_diffusion(logs: Logs, seed: int, progress: Progress | None, options: dict[str, Any]) -> DiffusionPrior:
    """Stage I for the diffusion prior: Eq. 6 on the logs' rows, stopped on held-out episodes."""
    low, high, options = _bounds(logs, options)
    known = [f.name for f in dataclasses.fields(DiffusionConfig)]
    for name in options:
        if name not in known:
            raise unknown("option of the diffusion prior", name, [*known, "action_low", "action_high"])
    config = DiffusionConfig(**options)
    if config.num_conditions:
        raise InputError("num_conditions must be 0: logs carry no condition (use train_denoiser with rows that do)")
    train, held_out = (_rows(part, low, high) for part in logs.split(config.validation_fraction, seed))
    denoiser, training = train_denoiser(train, held_out, config, seed, progress)
    chosen = np.random.default_rng(seed).permutation(train.actions.shape[0])[:PROBE_ROWS]
    return DiffusionPrior(
        denoiser=denoiser,
        config=config,
        action_low=low,
        action_high=high,
        task=logs.task,
        logs_hash=logs.hash(),
        training={"seed": seed, **training} | ({} if logs.drawn is None else {"drawn": dict(logs.drawn)}),
        probe_observations=np.asarray(train.observations)[chosen],
        probe_actions=np.asarray(train.actions)[chosen],
    )


_FITTERS = {"diffusion": fit_diffusion}


def _bounds(logs: Logs, options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """The action space's bounds, from the options or else from the logs, and the options that are left."""
    rest = dict(options)
    low, high = rest.pop("action_low", None), rest.pop("action_high", None)
    low, high = logs.action_low if low is None else low, logs.action_high if high is None else high
    if low is None or high is None:
        raise InputError("these logs carry no action bounds: pass action_low and action_high")
    size = logs.actions.shape[1]
    try:
        bounds = [np.broadcast_to(np.asarray(bound, np.float32), (size,)).copy() for bound in (low, high)]
    except ValueError:
        raise InputError(f"action_low {low} and action_high {high} must be a number or {size} numbers") from None
    if not (np.all(np.isfinite(bounds)) and np.all(bounds[0] <= bounds[1])):
        raise InputError(f"action_low {low} and action_high {high} must be finite, low <= high")
    return bounds[0], bounds[1], rest


def _rows(logs: Logs, low: np.ndarray, high: np.ndarray) -> Rows:
    observations = np.asarray(logs.observations, np.float32)
    actions = scale_actions(np.asarray(logs.actions, np.float32), low, high)
    empty = np.zeros((observations.shape[0], 0), np.float32)
    return Rows(*(jnp.asarray(a) for a in (observations, empty, actions)))


def train_denoiser(
    train: Rows, held_out: Rows, config: DiffusionConfig, seed: int, progress: Progress | None = None
) -> tuple[Denoiser, dict[str, Any]]:
    """Minimise Eq. 6 on `train`; returns the averaged weights that were best on `held_out`, and a summary."""
    rng = np.random.default_rng([seed, FIT_STREAM])
    state = init_state(train, config, rng)
    # A fixed random subset, in random order and with the same noise at every look: looks differ by the weights alone.
    picked = rng.permutation(held_out.actions.shape[0])[:VALIDATION_ROWS]
    held_out = Rows(*(a[picked] for a in held_out))
    held_out_draws = LossDraws.make(rng, *held_out.actions.shape)
    size, act = (config.chunk_steps, config.batch_size), train.actions.shape[1]
    best, best_loss, best_step, step, train_loss = state.ema, float("inf"), 0, 0, float("nan")
    start = time.perf_counter()
    while step < config.max_steps:
        picks = rng.integers(0, train.actions.shape[0], size, dtype=np.int32)
        state, losses = train_chunk(
            state, train, held_out, picks, LossDraws.make(rng, *size, act), held_out_draws, config
        )
        step = int(state.step)
        train_loss, validation_loss = (float(loss) for loss in losses)
        if not (np.isfinite(train_loss) and np.isfinite(validation_loss)):
            raise TrainingDiverged(f"fit of the prior: the denoising loss is not finite at step {step}")
        if validation_loss < best_loss:
            best, best_loss, best_step = state.ema, validation_loss, step
        if progress is not None:
            seconds = time.perf_counter() - start
            progress(FitProgress(step, config.max_steps, train_loss, validation_loss, seconds))
        if step - best_step >= config.patience * config.chunk_steps:
            break
    summary = {
        "rows": train.actions.shape[0],
        "steps": step,
        "best_step": best_step,
        "train_loss": train_loss,
        "validation_loss": best_loss,
        "seconds": round(time.perf_counter() - start, 2),
    }
    return best, summary


def init_state(rows: Rows, config: DiffusionConfig, rng: np.random.Generator) -> FitState:
    """A fresh denoiser with the rows' moments; a constant observation gets spread 1, so that it stays constant."""
    mean, std = _moments(np.asarray(rows.observations))
    sigma_data = max(float(_moments(np.asarray(rows.actions).reshape(-1, 1))[1][0]), SMALLEST_SIGMA_DATA)
    denoiser = Denoiser.create(
        rng,
        config,
        jnp.asarray(mean, jnp.float32),
        jnp.asarray(np.where(std > 1e-6, std, 1.0), jnp.float32),
        jnp.asarray(sigma_data, jnp.float32),
        rows.actions.shape[1],
    )
    return FitState(denoiser, denoiser, _optimizer(config).init(denoiser), jnp.zeros((), jnp.int32))


def _moments(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "2 columns"]:
    """Mean and standard deviation in float64, a piece at a time: a copy of all would be twice the logs."""
    pieces = np.split(values, range(MOMENT_ROWS, len(values), MOMENT_ROWS))
    mean, square = np.zeros((2, values.shape[1]))
    for piece in pieces:
        mean += np.sum(piece, axis=0, dtype=np.float64) / len(values)
    for piece in pieces:
        square += np.sum(np.square(piece - mean), axis=0) / len(values)
    return np.stack([mean, np.sqrt(square)])


def _optimizer(config: DiffusionConfig) -> Any:  # optax's own type knows no pytrees but arrays and dicts
    warmup = min(config.warmup_steps, config.max_steps // 2)
    schedule = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, config.max_steps)
    return optax.chain(optax.clip_by_global_norm(10.0), optax.adam(schedule, b2=0.99))


@partial(jax.jit, static_argnames="config")
def train_chunk(
    state: FitState,
    train: Rows,
    held_out: Rows,
    picks: Int[Array, "steps batch"],
    draws: LossDraws,
    held_out_draws: LossDraws,
    config: DiffusionConfig,
) -> tuple[FitState, tuple[Float[Array, ""], Float[Array, ""]]]:
    """Steps on the picked rows as one program; the mean training loss, and the averaged weights' held-out loss."""
    optimizer = _optimizer(config)

    def step(state: FitState, inputs):
        picked, noise = inputs
        batch = Rows(*(a[picked] for a in train))
        loss, gradient = jax.value_and_grad(denoising_loss)(state.denoiser, None, *batch, noise, config)
        updates, moments = optimizer.update(gradient, state.optimizer)
        denoiser = jax.tree.map(jnp.add, state.denoiser, updates)
        # Early averages must not remember the random start.
        decay = jnp.minimum(config.ema_decay, (1.0 + state.step) / (10.0 + state.step))
        # Written as a step towards the weights, so that what does not change keeps its bits.
        ema = jax.tree.map(lambda e, w: e + (1 - decay) * (w - e), state.ema, denoiser)
        return FitState(denoiser, ema, moments, state.step + 1), loss

    state, losses = jax.lax.scan(step, state, (picks, draws))
    validation = denoising_loss(state.ema, None, *held_out, held_out_draws, config)
    return state, (jnp.mean(losses), validation)
