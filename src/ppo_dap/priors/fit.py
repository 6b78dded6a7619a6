"""Stage I: fit a prior to logs (Section 4.2)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from ppo_dap.errors import InputError, TrainingDiverged, unknown
from ppo_dap.logs.dataset import Logs, require_logs
from ppo_dap.nets.arrays import first_state, on_device
from ppo_dap.prior_config import FITTED, PRIOR_CONFIGS
from ppo_dap.priors.kinds import NETWORKS
from ppo_dap.priors.network import Rows, TrainedNetwork
from ppo_dap.priors.prior import Prior, asked_return, checked_bounds, scale_actions

PROBE_ROWS = 256
VALIDATION_ROWS = 8192
SMALLEST_SPREAD = 0.05
MOMENT_ROWS = 2**18
ASKED_SHARE = 0.95
"""Who asks for the top return asks for this quantile of the logged ones."""
FIT_STREAM = 3
"""Keeps the fit's random numbers apart from those of the split of episodes."""


class Draws(NamedTuple):
    """Random numbers of a chunk of steps."""

    loss: Any
    """As the network draws them."""
    shown: Float[Array, "steps batch #c"]
    """1, or 0 where a row's condition is hidden."""


class FitProgress(NamedTuple):
    """What a progress callback is told after each chunk of steps."""

    step: int
    max_steps: int
    train_loss: float
    validation_loss: float
    seconds: float


class FitState(NamedTuple):
    """Everything that changes from step to step."""

    network: TrainedNetwork
    ema: TrainedNetwork
    optimizer: Any
    step: Array


Progress = Callable[[FitProgress], None]


def fit_prior(
    logs: Logs, kind: str = "diffusion", *, seed: int = 0, progress: Progress | None = None, **options: Any
) -> Prior:
    """Fit a prior of the given kind to `logs`, stopped on held-out episodes.

    Options are the fields of the kind's config (`DiffusionConfig` and so on), and `action_low` and `action_high` for
    logs that do not carry the action space's bounds, or carry infinite ones.
    """
    require_logs(logs)
    if kind not in FITTED:
        raise unknown("prior kind", kind, FITTED)
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"seed must be a whole number of 0 or more, not {seed!r}")
    config_class = PRIOR_CONFIGS[kind]
    low, high, options = _bounds(logs, options)
    known = [f.name for f in dataclasses.fields(config_class)]
    for name in options:
        if name not in known:
            raise unknown(f"option of the {kind} prior", name, [*known, "action_low", "action_high"])
    config = config_class(**options)
    if config.condition_on == "return" and logs.rewards is None:
        raise InputError("condition_on 'return' needs logs with rewards; these have none: use condition_on 'none'")
    parts = logs.split(config.validation_fraction, seed)
    asks = return_conditions(parts[0]) if config.condition_on == "return" else {}
    train, held_out = (_rows(part, low, high, asks) for part in parts)
    network, training = train_network(NETWORKS[kind], train, held_out, config, seed, progress)
    chosen = np.random.default_rng(seed).permutation(train.actions.shape[0])[:PROBE_ROWS]
    return Prior(
        network=network,
        action_low=low,
        action_high=high,
        task=logs.task,
        logs_hash=logs.hash(),
        training={"seed": seed, **training} | ({} if logs.drawn is None else {"drawn": dict(logs.drawn)}),
        probe_observations=np.asarray(train.observations)[chosen],
        probe_actions=np.asarray(train.actions)[chosen],
        asks=asks,
    )


def _bounds(logs: Logs, options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """The action space's bounds, from the options or else from the logs, and the options that are left."""
    rest = dict(options)
    low, high = rest.pop("action_low", None), rest.pop("action_high", None)
    low, high = logs.action_low if low is None else low, logs.action_high if high is None else high
    if low is None or high is None:
        raise InputError("these logs carry no action bounds: pass action_low and action_high")
    return *checked_bounds(low, high, logs.actions.shape[1]), rest


def return_conditions(logs: Logs) -> dict[str, float]:
    """Mean, spread and 95th percentile (`top`) of the episode's return over the rows of `logs`."""
    returns = row_returns(logs)
    return {"mean": float(returns.mean()), "std": float(returns.std()), "top": float(np.quantile(returns, ASKED_SHARE))}


def row_returns(logs: Logs) -> Float[np.ndarray, " rows"]:
    """The return of the episode that each row is of, undiscounted."""
    returns = logs.episode_returns()
    assert returns is not None  # `fit_prior` has checked
    return np.repeat(returns, logs.episode_lengths()).astype(np.float64)


def _rows(logs: Logs, low: np.ndarray, high: np.ndarray, asks: Mapping[str, float]) -> Rows:
    observations = np.asarray(logs.observations, np.float32)
    actions = scale_actions(np.asarray(logs.actions, np.float32), low, high)
    condition = np.zeros((observations.shape[0], 0), np.float32)
    if asks:
        condition = asked_return(row_returns(logs), asks)
    return Rows(*(on_device(a) for a in (observations, condition, actions)))


def train_network(
    network_class: Any,
    train: Rows,
    held_out: Rows,
    config: Any,
    seed: int,
    progress: Progress | None = None,
) -> tuple[Any, dict[str, Any]]:
    """Minimise the network's loss on `train`; returns the averaged weights that were best on `held_out`, and a summary.

    Of Eq. 6, for the diffusion prior. A network that is built has nothing to minimise and is built of `train`.
    """
    rng = np.random.default_rng([seed, FIT_STREAM])
    if hasattr(network_class, "build"):
        return network_class.build(train, held_out, config, rng)
    state = init_state(network_class, train, config, rng)
    # A fixed random subset, in random order and with the same noise at every look: looks differ by the weights alone.
    picked = rng.permutation(held_out.actions.shape[0])[:VALIDATION_ROWS]
    held_out = Rows(*(on_device(np.asarray(a)[picked]) for a in held_out))
    held_out_draws = state.network.draw_loss(rng, len(picked))
    best, best_loss, best_step, step, train_loss = state.ema, float("inf"), 0, 0, float("nan")
    start = time.perf_counter()
    while step < config.max_steps:
        size = (min(config.chunk_steps, config.max_steps - step), config.batch_size)
        picks = rng.integers(0, train.actions.shape[0], size, dtype=np.int32)
        draws = Draws(state.network.draw_loss(rng, *size), _shown(rng, size, config))  # type: ignore[arg-type]
        state, losses = train_chunk(state, train, held_out, picks, draws, held_out_draws, config)
        step = int(state.step)
        train_loss, validation_loss = (float(loss) for loss in losses)
        if not (np.isfinite(train_loss) and np.isfinite(validation_loss)):
            raise TrainingDiverged(
                f"fit of the prior: the loss is not finite at step {step}: lower learning_rate {config.learning_rate:g}"
            )
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


def _shown(rng: np.random.Generator, size: tuple[int, int], config: Any) -> np.ndarray:
    """1 for each row whose condition the fit sees, 0 for those where it is hidden."""
    if not config.num_conditions:
        return np.ones((*size, 0), np.float32)
    return (rng.random((*size, 1)) >= config.condition_dropout).astype(np.float32)


def init_state(network_class: Any, rows: Rows, config: Any, rng: np.random.Generator) -> FitState:
    """A fresh network with the rows' moments; a constant observation gets spread 1, so that it stays constant."""
    mean, std = _moments(np.asarray(rows.observations))
    spread = max(float(_moments(np.asarray(rows.actions).reshape(-1, 1))[1][0]), SMALLEST_SPREAD)
    network = network_class.create(
        rng,
        config,
        on_device(mean),
        on_device(np.where(std > 1e-6, std, 1.0)),
        on_device(spread),
        rows.actions.shape[1],
    )
    return FitState(network, network, first_state(_optimizer(config), network), on_device(0, np.int32))


def _moments(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "2 columns"]:
    """Mean and standard deviation in float64, a piece at a time: a copy of all would be twice the logs."""
    pieces = np.split(values, range(MOMENT_ROWS, len(values), MOMENT_ROWS))
    mean, square = np.zeros((2, values.shape[1]))
    for piece in pieces:
        mean += np.sum(piece, axis=0, dtype=np.float64) / len(values)
    for piece in pieces:
        square += np.sum(np.square(piece - mean), axis=0) / len(values)
    return np.stack([mean, np.sqrt(square)])


def _optimizer(config: Any) -> Any:  # optax's own type knows no pytrees but arrays and dicts
    warmup = min(config.warmup_steps, config.max_steps // 2)
    schedule = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, warmup, config.max_steps)
    return optax.chain(optax.clip_by_global_norm(10.0), optax.adam(schedule, b2=0.99))


@partial(jax.jit, static_argnames="config")
def train_chunk(
    state: FitState,
    train: Rows,
    held_out: Rows,
    picks: Int[Array, "steps batch"],
    draws: Draws,
    held_out_draws: Any,
    config: Any,
) -> tuple[FitState, tuple[Float[Array, ""], Float[Array, ""]]]:
    """Steps on the picked rows as one program; the mean training loss, and the averaged weights' held-out loss."""
    optimizer = _optimizer(config)

    def step(state: FitState, inputs):
        picked, (noise, shown) = inputs
        observations, condition, actions = (a[picked] for a in train)
        loss, gradient = jax.value_and_grad(lambda n: n.loss(observations, condition * shown, actions, noise))(
            state.network
        )
        updates, moments = optimizer.update(gradient, state.optimizer)
        network = jax.tree.map(jnp.add, state.network, updates)
        # Early averages must not remember the random start.
        decay = jnp.minimum(config.ema_decay, (1.0 + state.step) / (10.0 + state.step))
        # Written as a step towards the weights, so that what does not change keeps its bits.
        ema = jax.tree.map(lambda e, w: e + (1 - decay) * (w - e), state.ema, network)
        return FitState(network, ema, moments, state.step + 1), loss

    state, losses = jax.lax.scan(step, state, (picks, draws))
    validation = state.ema.loss(*held_out, held_out_draws)
    return state, (jnp.mean(losses), validation)
