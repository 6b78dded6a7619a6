"""The policy in plain numpy: what rollouts and evaluation step with, and what a user deploys. No JAX needed."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ppo_dap.errors import InputError
from ppo_dap.storage import read_tensors, write_tensors

FORMAT = 1
HALF, ONE = np.float32(0.5), np.float32(1)


@dataclass(frozen=True)
class Policy:
    """A Gaussian policy with its observation normaliser and action scaling inside."""

    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, " _"], ...]
    log_std: Float[np.ndarray, " act"]
    observation_mean: Float[np.ndarray, " obs"]
    observation_std: Float[np.ndarray, " obs"]
    observation_clip: float
    action_low: Float[np.ndarray, " act"]
    action_high: Float[np.ndarray, " act"]
    task: str | None = None

    def mean(self, observations: Float[np.ndarray, "n obs"]) -> Float[np.ndarray, "n act"]:
        """Means in scaled actions at raw observations."""
        # A rollout is thousands of calls on few rows, where overhead is all there is: in place, np.dot for @, numpy's
        # scalars for Python's, and no np.clip, which costs as much as a layer.
        hidden = observations - self.observation_mean
        hidden /= self.observation_std
        low, high = self._clip_limits
        np.maximum(hidden, low, out=hidden)
        np.minimum(hidden, high, out=hidden)
        for weight, bias in self._layers[:-1]:
            hidden = np.dot(hidden, weight)
            hidden += bias
            np.tanh(hidden, out=hidden)
        weight, bias = self._layers[-1]
        hidden = np.dot(hidden, weight)
        hidden += bias
        return hidden

    @cached_property
    def _clip_limits(self) -> tuple[np.float32, np.float32]:
        return np.float32(-self.observation_clip), np.float32(self.observation_clip)

    @cached_property
    def _layers(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        return tuple((weight.T, bias) for weight, bias in zip(self.weights, self.biases, strict=True))

    def log_prob_of_noise(self, noise: Float[np.ndarray, "*n act"]) -> Float[np.ndarray, "*n"]:
        """Log-density of mean + std * noise."""
        constant = self.log_std.sum() + 0.5 * math.log(2 * math.pi) * len(self.log_std)
        return -0.5 * np.square(noise).sum(-1) - np.float32(constant)

    def unscale(self, actions: Float[np.ndarray, "n act"]) -> Float[np.ndarray, "n act"]:
        """Scaled actions, clipped to the box, in environment units."""
        return unscale_actions(actions, self.action_low, self.action_high)

    def __call__(self, observation) -> np.ndarray:
        """Deterministic action in environment units for one observation (obs,) or a batch (n, obs).

        Raises `InputError` if the observation has another size than the policy was trained with, or NaN in it.
        """
        try:
            observations = np.asarray(observation, dtype=np.float32)
        except (TypeError, ValueError):
            raise InputError(f"observation must be numbers, not {observation!r}") from None
        if observations.ndim not in (1, 2) or observations.shape[-1] != len(self.observation_mean):
            raise InputError(
                f"observation of shape {observations.shape}: this policy takes ({len(self.observation_mean)},) or "
                f"(n, {len(self.observation_mean)})"
            )
        if (nan := np.argwhere(np.isnan(observations))).size:
            raise InputError(f"observation is nan at {nan[0].tolist()}: this policy takes numbers")
        actions = self.unscale(self.mean(np.atleast_2d(observations)))
        return actions if observations.ndim == 2 else actions[0]

    def save(self, path: str | os.PathLike) -> None:
        """Write one safetensors file, atomically."""
        tensors = {f"weight{i}": w for i, w in enumerate(self.weights)}
        tensors |= {f"bias{i}": b for i, b in enumerate(self.biases)}
        for name in ("log_std", "observation_mean", "observation_std", "action_low", "action_high"):
            tensors[name] = getattr(self, name)
        meta = {"kind": "policy", "format": FORMAT, "task": self.task, "observation_clip": self.observation_clip}
        write_tensors(Path(path), tensors, meta)


def load_policy(path: str | os.PathLike) -> Policy:
    """Read a file that `Policy.save` wrote; raises `InputError` for anything else."""
    tensors, meta = read_tensors(Path(path), kind="policy", newest=FORMAT)
    depth = sum(name.startswith("weight") for name in tensors)
    wanted = [f"{part}{i}" for i in range(max(depth, 1)) for part in ("weight", "bias")]
    wanted += ["log_std", "observation_mean", "observation_std", "action_low", "action_high"]
    if missing := [name for name in wanted if name not in tensors]:
        raise InputError(f"{path} is not a whole policy file: {', '.join(missing)} missing")
    return Policy(
        tuple(tensors[f"weight{i}"] for i in range(depth)),
        tuple(tensors[f"bias{i}"] for i in range(depth)),
        tensors["log_std"],
        tensors["observation_mean"],
        tensors["observation_std"],
        float(meta["observation_clip"]),
        tensors["action_low"],
        tensors["action_high"],
        meta["task"],
    )


def unscale_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[-1, 1] to [low, high]; what lies outside is clipped first."""
    scaled = np.maximum(actions, -ONE)
    np.minimum(scaled, ONE, out=scaled)
    scaled += ONE
    scaled *= HALF * (high - low)
    scaled += low
    return scaled


def scale_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[low, high] to [-1, 1]."""
    return (actions - low) / (0.5 * (high - low)) - 1.0
