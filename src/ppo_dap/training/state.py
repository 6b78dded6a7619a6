"""The whole state of a run, and its checkpoint: one safetensors file with everything needed to go on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.nets.normalizer import RewardScale, RunningMoments
from ppo_dap.nets.policy import Policy
from ppo_dap.storage import read_tensors, tree_from_tensors, tree_to_tensors, write_tensors
from ppo_dap.tasks import TaskSpec
from ppo_dap.training.algorithm import Learner

FORMAT = 1


@dataclass
class TrainState:
    """What changes while a run goes on. Random streams are functions of (seed, iteration), so they need no state."""

    learner: Learner
    observations: RunningMoments
    reward_scale: RewardScale
    iteration: int = 0
    env_steps: int = 0
    learning_rate_scale: float = 1.0
    best_return: float = -np.inf

    def policy(self, spec: TaskSpec, observation_clip: float) -> Policy:
        """The current policy in numpy, with the statistics as they are now."""
        actor = self.learner.ppo.actor
        return Policy(
            tuple(np.asfortranarray(layer.weight) for layer in actor.mlp.layers),  # so that .T is contiguous
            tuple(np.asarray(layer.bias) for layer in actor.mlp.layers),
            np.asarray(actor.log_std),
            self.observations.mean.astype(np.float32),
            self.observations.std.astype(np.float32),
            observation_clip,
            spec.action_low,
            spec.action_high,
            spec.task,
        )


def save_checkpoint(path: Path, state: TrainState, run: dict[str, Any]) -> None:
    """Write `state` atomically; `run` says which run it belongs to. Raises `OSError` with the file as it was."""
    tensors = _tensors(state)
    numbers = {name: getattr(state, name) for name in _NUMBERS}
    numbers["best_return"] = None if state.best_return == -np.inf else state.best_return
    write_tensors(path, tensors, {"kind": "checkpoint", "format": FORMAT, "run": run, "numbers": numbers})


def load_checkpoint(path: Path, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
    """State of the checkpoint at `path`, shaped as `like`, and which run it belongs to.

    A run that went on without its guide has none in its later checkpoints; then nor has the state.

    Raises `InputError` for a file that is no checkpoint, is damaged, newer, or of other networks.
    """
    tensors, meta = read_tensors(path, kind="checkpoint", newest=FORMAT)
    guided = any(name.startswith("learner.guide.") for name in tensors)
    learner = tree_from_tensors(like.learner if guided else like.learner.alone(), tensors, "learner", path)
    moments = {
        key: RunningMoments(float(tensors[f"{key}.count"]), tensors[f"{key}.mean"], tensors[f"{key}.m2"])
        for key in ("observations", "rewards")
    }
    numbers = meta["numbers"]
    numbers["best_return"] = -np.inf if numbers["best_return"] is None else numbers["best_return"]
    reward_scale = RewardScale(moments["rewards"], np.zeros_like(like.reward_scale.discounted))
    return TrainState(learner, moments["observations"], reward_scale, **numbers), meta["run"]


_NUMBERS = ("iteration", "env_steps", "learning_rate_scale", "best_return")


def _tensors(state: TrainState) -> dict[str, np.ndarray]:
    tensors = tree_to_tensors(state.learner, "learner")
    for key, moments in (("observations", state.observations), ("rewards", state.reward_scale.moments)):
        tensors |= {f"{key}.count": np.array(moments.count), f"{key}.mean": moments.mean, f"{key}.m2": moments.m2}
    return tensors
