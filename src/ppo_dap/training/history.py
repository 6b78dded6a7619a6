"""What a run leaves behind when it is asked to: the rollout of each iteration, and the policy of each evaluation.

Files are named by the iteration and by the environment steps, so a resumed run writes the same ones again.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.nets.policy import Policy, load_policy, unscale_actions
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.storage import write_atomically
from ppo_dap.tasks import TaskSpec
from ppo_dap.training.collect import Episode

FOLDER = "history"
COLUMNS = ("observations", "actions", "rewards", "terminated", "truncated", "valid")


class History:
    """Writes and reads the history in a run folder."""

    def __init__(self, run_folder: Path):
        self.folder = run_folder / FOLDER

    def keep_policy(self, env_steps: int, policy: Policy) -> None:
        """Write the policy that was evaluated after `env_steps`."""
        policy.save(self.folder / f"policy-{env_steps:09d}.safetensors")

    def keep_rollout(self, iteration: int, segment: int, parts: Sequence[Rollout], spec: TaskSpec) -> None:
        """Write the rows of an iteration, actions as executed; those of one `segment` share their environments."""
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
        columns["actions"] = unscale_actions(columns["actions"], spec.action_low, spec.action_high)
        # Successors only where no later row shows them: at an episode's end, and after the last row.
        last = columns["terminated"] | columns["truncated"]
        last[-1] = True
        final = np.concatenate([part.next_observations for part in parts])[last]
        buffer = io.BytesIO()
        np.savez(buffer, segment=segment, last=last, final=final, **columns)
        write_atomically(self.folder / f"rollout-{iteration:06d}.npz", buffer.getvalue())

    def policies(self) -> dict[int, Policy]:
        """Policies by the environment steps of their evaluation."""
        paths = sorted(self.folder.glob("policy-*.safetensors"))
        if not paths:
            raise InputError(f"{self.folder} holds no policies: train with keep_history")
        return {int(path.stem.removeprefix("policy-")): load_policy(path) for path in paths}

    def episodes(self, iterations: int) -> list[Episode]:
        """The episodes of the first `iterations`, in the order of their first rows within each segment.

        An episode that was still open when its environments were closed ends there, as a timeout would.
        """
        paths = sorted(self.folder.glob("rollout-*.npz"))[:iterations]
        if len(paths) < iterations:
            raise InputError(f"{self.folder} holds {len(paths)} rollouts of {iterations}: train with keep_history")
        segments: dict[int, list[dict[str, np.ndarray]]] = {}
        for path in paths:
            with np.load(path) as file:
                columns = {name: file[name] for name in file.files}
            segments.setdefault(int(columns.pop("segment")), []).append(columns)
        return [episode for rollouts in segments.values() for episode in _in_order(rollouts)]


def _in_order(rollouts: Sequence[dict[str, np.ndarray]]) -> list[Episode]:
    """Episodes of one segment, by the time of their first row."""
    segment = {name: np.concatenate([rollout[name] for rollout in rollouts]) for name in (*COLUMNS, "last")}
    finals = dict(zip(map(tuple, np.argwhere(segment["last"])), _finals(rollouts), strict=True))
    found = []
    for env in range(segment["valid"].shape[1]):
        times = np.flatnonzero(segment["valid"][:, env])
        ended = (segment["terminated"] | segment["truncated"])[times, env]
        for piece in np.split(times, np.flatnonzero(ended) + 1):
            if len(piece):
                rows = {name: segment[name][piece, env] for name in Episode._fields[:-1]}
                found.append((piece[0], env, Episode(**rows, final_observation=finals[piece[-1], env])))
    return [episode for _, _, episode in sorted(found, key=lambda entry: entry[:2])]


def _finals(rollouts: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    return np.concatenate([rollout["final"] for rollout in rollouts])
