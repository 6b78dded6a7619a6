"""What a prior is to its users, and the diffusion prior with its file.

Outside a prior actions are in the environment's units; inside they are scaled so that the action space's box is
[-1, 1]. This module is the edge between the two.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ppo_dap.errors import InputError, unknown
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig
from ppo_dap.priors.samplers import Solver, sample_actions
from ppo_dap.storage import read_tensors, tree_from_tensors, tree_to_tensors, write_tensors

FORMAT = 1


@runtime_checkable
class Prior(Protocol):
    """A conditional distribution over actions, p(a | s), that was fitted to logs."""

    @property
    def kind(self) -> str:
        """Name of the family, as `fit_prior` takes it."""
        ...

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        ...

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        ...

    @property
    def task(self) -> str | None:
        """Task of the logs, where they say so."""
        ...

    def sample(self, observations: Any, key: PRNGKeyArray, num: int) -> Array:
        """`num` actions a state in environment units, shape (n, num, act)."""
        ...

    def save(self, path: str | Path) -> None:
        """Write the prior to `path`, to be read by `load_prior`."""
        ...


def scale_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Environment units to [-1, 1]; actions outside the bounds are clipped, a dimension without range becomes 0."""
    half_range = (high - low) / 2
    scaled = (np.clip(actions, low, high) - (high + low) / 2) / np.where(half_range > 0, half_range, 1)
    return scaled.astype(np.float32)


def unscale_actions(
    scaled: Float[Array, "*batch act"], low: Float[np.ndarray, " act"], high: Float[np.ndarray, " act"]
) -> Float[Array, "*batch act"]:
    """[-1, 1] to environment units, never outside the bounds."""
    low_, high_ = jnp.broadcast_to(low, scaled.shape), jnp.broadcast_to(high, scaled.shape)
    return jnp.clip((high_ + low_) / 2 + scaled * (high_ - low_) / 2, low_, high_)


@dataclass(frozen=True, eq=False)
class DiffusionPrior:
    """The action prior of Section 4.2: a denoiser and what is needed to use, check and audit it."""

    denoiser: Denoiser
    """The backbone, with the logs' observation moments and sigma_data."""
    config: DiffusionConfig
    """Settings it was fitted with; its sampler is the default of `sample`."""
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
    """Observations of a few rows of the logs, for the leakage audit alone (Eq. 11 needs an offline minibatch)."""
    probe_actions: Float[np.ndarray, "probe act"]
    """Scaled actions of the same rows."""

    kind = "diffusion"

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return self.denoiser.observation_mean.shape[0]

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.action_low.shape[0]

    def sample(
        self,
        observations: Float[Array, "n obs"] | Float[np.ndarray, "n obs"],
        key: PRNGKeyArray,
        num: int,
        condition: Float[Array, "n c"] | Float[np.ndarray, "n c"] | None = None,
    ) -> Float[Array, "n {num} act"]:
        """`num` actions a state, in environment units."""
        if observations.shape[1] != self.observation_size:
            raise InputError(f"observations have {observations.shape[1]} numbers, the prior's {self.observation_size}")
        wanted = self.config.num_conditions
        if condition is None:
            condition = np.zeros((observations.shape[0], 0), np.float32)
        if condition.shape[1] != wanted:
            raise InputError(f"condition has {condition.shape[1]} numbers, the prior's {wanted}")
        inputs = jnp.asarray(observations, jnp.float32), jnp.asarray(condition, jnp.float32)
        solver = Solver(self.config.sampler, self.config.sampler_steps)
        noise = jax.random.normal(key, solver.noise_shape(observations.shape[0], num, self.action_size))
        scaled = _sample(self.denoiser, *inputs, noise, solver, self.config)
        return unscale_actions(scaled, self.action_low, self.action_high)

    def save(self, path: str | Path) -> None:
        """Write the prior to exactly `path`."""
        tensors = tree_to_tensors(self.denoiser, "denoiser")
        for name in _ARRAYS:
            tensors[name] = getattr(self, name)
        header = {
            "kind": "prior",
            "format": FORMAT,
            "prior": self.kind,
            "config": dataclasses.asdict(self.config),
            "task": self.task,
            "logs_hash": self.logs_hash,
            "training": self.training,
            "observation_size": self.observation_size,
            "action_size": self.action_size,
        }
        try:
            write_tensors(Path(path), tensors, header)
        except OSError as error:
            raise InputError(f"cannot write prior {path}: {error.strerror}") from error

    @staticmethod
    def from_file(tensors: dict[str, np.ndarray], header: dict[str, Any], source: object) -> DiffusionPrior:
        """The prior that `save` wrote as `tensors` and `header`."""
        config = DiffusionConfig(**header["config"])
        sizes = (header["observation_size"],), (header["observation_size"],), ()
        blank = jax.eval_shape(
            lambda *m: Denoiser.create(np.random.default_rng(0), config, m[0], m[1], m[2], header["action_size"]),
            *(jax.ShapeDtypeStruct(size, jnp.float32) for size in sizes),
        )
        missing = [name for name in _ARRAYS if name not in tensors]
        if missing:
            raise InputError(f"{source} is damaged: {missing[0]} is missing")
        return DiffusionPrior(
            denoiser=tree_from_tensors(blank, tensors, "denoiser", source),
            config=config,
            task=header["task"],
            logs_hash=header["logs_hash"],
            training=header["training"],
            **{name: tensors[name] for name in _ARRAYS},
        )


_ARRAYS = ("action_low", "action_high", "probe_observations", "probe_actions")


@partial(jax.jit, static_argnames=("solver", "config"))
def _sample(denoiser, observations, condition, noise, solver, config):
    return sample_actions(denoiser, None, observations, condition, noise, solver, config)[0]


_KINDS = {"diffusion": DiffusionPrior}


def load_prior(path: str | Path) -> Prior:
    """The prior that was saved to `path`."""
    tensors, header = read_tensors(Path(path), kind="prior", newest=FORMAT)
    if header.get("prior") not in _KINDS:
        raise InputError(f"{path}: {unknown('prior kind', header.get('prior'), _KINDS)}")
    try:
        return _KINDS[header["prior"]].from_file(tensors, header, path)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged: its header lacks or misnames {error}") from error
