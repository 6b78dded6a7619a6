"""What a prior is to its users, and its file.

Outside a prior actions are in the environment's units; inside they are scaled so that the action space's box is
[-1, 1]. This module is the edge between the two.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ppo_dap.errors import InputError, unknown
from ppo_dap.prior_config import PRIOR_CONFIGS
from ppo_dap.priors.kinds import NETWORKS
from ppo_dap.priors.samplers import Solver
from ppo_dap.storage import kind_of, read_tensors, require_place, tree_from_tensors, tree_to_tensors, write_tensors

FORMAT = 2
"""1 held diffusion priors alone."""
Asked = Literal["none", "top"]
"""What a prior that is conditioned on the return can be asked for: nothing in particular, or a high one."""


def scale_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Environment units to [-1, 1]; actions outside the bounds are clipped, a dimension without range becomes 0."""
    half_range = (high - low) / 2
    scaled = (np.clip(actions, low, high) - (high + low) / 2) / np.where(half_range > 0, half_range, 1)
    return scaled.astype(np.float32)


def checked_bounds(low: Any, high: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of `size` actions, given as a number or as `size` numbers each; raises `InputError` for others."""
    try:
        bounds = [np.broadcast_to(np.asarray(bound, np.float32), (size,)).copy() for bound in (low, high)]
    except ValueError:
        raise InputError(f"action_low {low} and action_high {high} must be a number or {size} numbers") from None
    if not (np.all(np.isfinite(bounds)) and np.all(bounds[0] <= bounds[1])):
        raise InputError(f"action_low {low} and action_high {high} must be finite, low <= high")
    return bounds[0], bounds[1]


def unscale_actions(
    scaled: Float[Array, "*batch act"], low: Float[np.ndarray, " act"], high: Float[np.ndarray, " act"]
) -> Float[Array, "*batch act"]:
    """[-1, 1] to environment units, never outside the bounds."""
    low_, high_ = jnp.broadcast_to(low, scaled.shape), jnp.broadcast_to(high, scaled.shape)
    return jnp.clip((high_ + low_) / 2 + scaled * (high_ - low_) / 2, low_, high_)


def asked_return(returns: Float[np.ndarray, " n"], asks: Mapping[str, float]) -> Float[np.ndarray, "n 2"]:
    """The condition that stands for these returns: in the logs' standard deviations, and 1 for "known"."""
    scaled = (np.asarray(returns) - asks["mean"]) / max(asks["std"], 1e-6)
    return np.stack([scaled, np.ones_like(scaled)], axis=1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Prior:
    """A conditional distribution over actions, p(a | s), that was fitted to logs (Section 4.2), of any kind."""

    network: Any
    """The fitted `Network`, with the logs' observation moments."""
    action_low: Float[np.ndarray, " act"]
    """Lower bounds of the action space."""
    action_high: Float[np.ndarray, " act"]
    """Upper bounds of the action space."""
    task: str | None
    """Task of the logs, where they say so."""
    logs_hash: str
    """Hash of the logs."""
    training: dict[str, Any]
    """Summary of the fit: steps, losses, rows, seconds."""
    probe_observations: Float[np.ndarray, "probe obs"]
    """Observations of a few rows of the logs, for `spread` and the leakage audit (Eq. 11's offline minibatch)."""
    probe_actions: Float[np.ndarray, "probe act"]
    """Scaled actions of the same rows."""
    asks: dict[str, float] = field(default_factory=dict)
    """Mean, spread and top quantile of the logged returns, for a prior that is conditioned on them; else empty."""

    @property
    def kind(self) -> str:
        """Name of the family, as `fit_prior` takes it."""
        return self.config.kind

    @property
    def config(self) -> Any:
        """Settings it was fitted with; a diffusion prior's sampler is the default of `sample`."""
        return self.network.config

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return self.probe_observations.shape[1]

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.action_low.shape[0]

    def hash(self) -> str:
        """Sha256 (hex) over kind, settings and network: two fits to the same logs share `logs_hash` and not this."""
        digest = hashlib.sha256(f"{self.kind}:{dataclasses.asdict(self.config)}".encode())
        for name, array in sorted(tree_to_tensors(self.network, "network").items()):
            digest.update(f"{name}:{array.shape}:{array.dtype.str}:".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def condition(self, asked: Asked) -> Float[np.ndarray, " c"]:
        """The condition that asks for the `top` return, or for `none`.

        Raises `InputError` if the prior was not conditioned on the return and is asked for one.
        """
        if asked not in get_args(Asked):
            raise unknown("return to ask for", asked, get_args(Asked))
        if asked == "none":
            return np.zeros(self.config.num_conditions, np.float32)
        if not self.asks:
            raise InputError(
                f"prior_return {asked!r} needs a prior that was fitted with condition_on 'return'; this one was not"
            )
        return asked_return(np.array([self.asks[asked]]), self.asks)[0]

    def sample(
        self,
        observations: Float[Array, "n obs"] | Float[np.ndarray, "n obs"],
        key: PRNGKeyArray,
        num: int,
        asked: Asked = "none",
    ) -> Float[Array, "n {num} act"]:
        """`num` actions a state, in environment units; raises `InputError` for other observations than the logs'."""
        if np.ndim(observations) != 2 or np.shape(observations)[1] != self.observation_size:
            raise InputError(
                f"observations have shape {np.shape(observations)}: this prior takes (n, {self.observation_size})"
            )
        if not np.isfinite(np.asarray(observations)).all():
            raise InputError("observations have NaN or infinite entries: this prior takes finite numbers")
        if num < 0:
            raise InputError(f"num must be a whole number of 0 or more, not {num!r}")
        solver = Solver(getattr(self.config, "sampler", "ancestral"), getattr(self.config, "sampler_steps", 1))
        noise = jax.random.normal(key, self.network.noise_shape(solver, len(observations), num))
        inputs = jnp.asarray(observations, jnp.float32), jnp.asarray(self.condition(asked))
        scaled = _sample(self.network, *inputs, noise, solver)
        return unscale_actions(scaled, self.action_low, self.action_high)

    def spread(self, asked: Asked = "none") -> Float[np.ndarray, " act"]:
        """Standard deviation of the prior's actions at a state, scaled: root mean square over its probe states.

        Estimated from 16 actions a state, always with the same noise.
        """
        samples = np.asarray(self.sample(self.probe_observations, jax.random.key(0), 16, asked))
        scaled = scale_actions(samples, self.action_low, self.action_high)
        return np.sqrt(scaled.var(axis=1, ddof=1).mean(axis=0))

    def save(self, path: str | Path) -> None:
        """Write the prior to exactly `path`; raises `InputError` where that would cost another file its content."""
        path = require_prior_place(path)
        tensors = tree_to_tensors(self.network, "network")
        for name in _ARRAYS:
            tensors[name] = getattr(self, name)
        header = {"kind": "prior", "format": FORMAT, "prior": self.kind, "config": dataclasses.asdict(self.config)}
        header |= {name: getattr(self, name) for name in _HEADER}
        try:
            write_tensors(path, tensors, header)
        except OSError as error:
            raise InputError(f"cannot write prior {path}: {error.strerror}") from error


_ARRAYS = ("action_low", "action_high", "probe_observations", "probe_actions")
_HEADER = ("task", "logs_hash", "training", "asks")


def require_prior_place(path: str | Path) -> Path:
    """`path` as a Path; raises `InputError` unless a prior can be written there, in the place of none or of another."""
    path = require_place("prior", path)
    if path.exists() and kind_of(path) != "prior":
        raise InputError(f"prior {path} is there already and is no prior: name a new file")
    return path


@partial(jax.jit, static_argnames="solver")
def _sample(network, observations, condition, noise, solver):
    condition = jnp.broadcast_to(condition[None], (observations.shape[0], condition.shape[0]))
    return network.sample(observations, condition, noise, solver)[0]


def load_prior(path: str | Path) -> Prior:
    """The prior that was saved to `path`."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"prior must be a Prior, or the path of one, not {path!r}")
    tensors, header = read_tensors(Path(path), kind="prior", newest=FORMAT)
    if header["format"] < FORMAT:
        raise InputError(f"{path} was written by an older ppo-dap: fit the prior again with `ppo-dap pretrain`")
    if header.get("prior") not in NETWORKS:
        raise InputError(f"{path}: {unknown('prior kind', header.get('prior'), NETWORKS)}")
    missing = [name for name in _ARRAYS if name not in tensors]
    if missing:
        raise InputError(f"{path} is damaged: {missing[0]} is missing")
    try:
        config = PRIOR_CONFIGS[header["prior"]](**header["config"])
        others: dict[str, Any] = {name: header[name] for name in _HEADER}
        others |= {name: tensors[name] for name in _ARRAYS}
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged: its header lacks or misnames {error}") from error
    network = _read_network(NETWORKS[config.kind], config, tensors, path)
    return Prior(network=network, **others)


def _read_network(network_class: Any, config: Any, tensors: dict[str, np.ndarray], source: object) -> Any:
    if hasattr(network_class, "blank"):
        return tree_from_tensors(network_class.blank(config, tensors), tensors, "network", source)
    moments = [jax.ShapeDtypeStruct((tensors["probe_observations"].shape[1],), jnp.float32)] * 2
    spread, action_size = jax.ShapeDtypeStruct((), jnp.float32), tensors["action_low"].shape[0]
    blank = jax.eval_shape(
        lambda *stats: network_class.create(np.random.default_rng(0), config, *stats, action_size), *moments, spread
    )
    return tree_from_tensors(blank, tensors, "network", source)
