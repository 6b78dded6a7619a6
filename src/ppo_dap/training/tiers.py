"""Logs of behaviour policies of our own, in the tiers that D4RL defines, each with a card that says what it is."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError, unknown
from ppo_dap.logs.card import card_text, describe_logs
from ppo_dap.logs.writing import save_minari
from ppo_dap.nets.policy import Policy
from ppo_dap.storage import write_atomically
from ppo_dap.tasks import describe, make_vector_env
from ppo_dap.training.collect import Episode, as_logs, collect_episodes, thin
from ppo_dap.training.history import History
from ppo_dap.training.manifest import manifest
from ppo_dap.training.run import Run, load_run, train

TIERS = {
    "random": "the policy before its first update, with its noise",
    "medium": "the first policy that is a third of the way from the random to the expert return",
    "medium-replay": "what training saw until the medium policy, thinned evenly where that is more than was asked for",
    "medium-expert": "half of the rows by the medium policy, half by the expert",
    "expert": "the best policy of the run",
    "mixed": "the experts of three runs with other seeds, a third of the rows each: several gaits",
}
MEDIUM_SHARE = 1 / 3
"""Where D4RL puts medium between random (0) and expert (1)."""
MIXED_RUNS = 3
STORE, CARD = "behaviours", "card.json"
TRAINING_SHARE = 0.7
"""Speed of training, evaluations included, over that of the bare environments; for the estimate alone."""


@dataclass(frozen=True)
class Behaviour:
    """A finished PPO run that kept its history, and the policies that the tiers are made by."""

    run: Run

    @cached_property
    def returns(self) -> dict[int, float]:
        """Mean return by the environment steps of the evaluation."""
        return {row["env_steps"]: row["return_mean"] for row in self.run.evaluations}

    @cached_property
    def policies(self) -> dict[int, Policy]:
        """The policy of each evaluation."""
        return History(self.run.folder).policies()

    @property
    def random(self) -> int:
        """Environment steps of the first evaluation, which is before the first update."""
        return min(self.returns)

    @property
    def expert(self) -> int:
        """Environment steps of the best evaluation."""
        return max(self.returns, key=self.returns.__getitem__)

    @property
    def medium(self) -> int:
        """Environment steps of the first evaluation that is `MEDIUM_SHARE` of the way to the expert's return."""
        low, high = self.returns[self.random], self.returns[self.expert]
        return next(at for at in sorted(self.returns) if self.returns[at] >= low + MEDIUM_SHARE * (high - low))

    @property
    def seconds(self) -> float:
        """What training took, evaluations apart."""
        return sum(row["seconds_iteration"] for row in self.run.metrics)

    def replay(self) -> list[Episode]:
        """Episodes of the training until the medium policy."""
        iterations = sum(row["env_steps"] <= self.medium for row in self.run.metrics)
        return History(self.run.folder).episodes(max(iterations, 1))

    def about(self, at: int) -> dict[str, Any]:
        """Which policy this is, for a card."""
        config = self.run.config["config"]
        return {"seed": config["seed"], "train_steps": config["steps"], "at_step": at, "return": self.returns[at]}


def behave(task: str, seed: int, steps: int, store: Path) -> Behaviour:
    """PPO's run of this task, seed and steps in `store`: trained if it is not there, gone on with if it was cut off."""
    folder = behaviour_folder(task, seed, steps, store)
    if not is_done(folder):
        started = (folder / "config.json").is_file()
        options = {"steps": steps, "seed": seed, "keep_history": True, "eval_every": max(1, min(10_000, steps // 10))}
        train(task, "ppo", out=folder, resume=started, progress=False, tensorboard=False, **options)
    return Behaviour(load_run(folder))


def behaviour_folder(task: str, seed: int, steps: int, store: Path) -> Path:
    """Where a behaviour run goes."""
    return store / f"{task}-ppo-{steps}-{seed}"


def is_done(folder: Path) -> bool:
    """Whether a behaviour run came to its end."""
    written = all((folder / name).is_file() for name in ("config.json", "policy.safetensors"))
    return written and load_run(folder).finished


def tier_episodes(
    tier: str, rows: int, seed: int, behaviours: Sequence[Behaviour]
) -> tuple[list[Episode], list[dict[str, Any]]]:
    """At least `rows` rows of whole episodes of a tier, and which policies they are by.

    `behaviours` are runs of one task: one for every tier but `mixed`, which takes `MIXED_RUNS`.
    """
    first = behaviours[0]
    for behaviour in behaviours if tier != "random" else ():
        if behaviour.expert == behaviour.random:
            steps = behaviour.run.config["config"]["steps"]
            raise InputError(f"no policy of {behaviour.run.folder} is better than its first: {steps} steps are too few")
    if tier == "medium-replay":
        return thin(first.replay(), rows), [first.about(first.random), first.about(first.medium)]
    chosen = {
        "random": [(first, first.random)],
        "medium": [(first, first.medium)],
        "medium-expert": [(first, first.medium), (first, first.expert)],
        "expert": [(first, first.expert)],
        "mixed": [(behaviour, behaviour.expert) for behaviour in behaviours],
    }[tier]
    share, task = -(-rows // len(chosen)), first.run.config["task"]
    episodes = [
        episode
        for i, (behaviour, at) in enumerate(chosen)
        for episode in collect_episodes(behaviour.policies[at], task, share, seed + i)
    ]
    return episodes, [behaviour.about(at) for behaviour, at in chosen]


def make_tier(task: str, tier: str, rows: int, seed: int, steps: int, folder: Path) -> dict[str, Any]:
    """A tier as a Minari dataset with its card below `folder`, and what it needs trained; returns a row about it.

    A dataset that is there already stays as it is; raises `InputError` if it was made otherwise.
    """
    check_tiers([tier])
    out = tier_folder(task, tier, folder)
    command = f"ppo-dap collect --task {task} --tier {tier} --steps {rows} --train-steps {steps} --seed {seed}"
    if not (out / CARD).is_file():
        start = time.perf_counter()
        needed = range(seed, seed + runs_needed(tier))
        behaviours = [behave(task, number, steps, folder / STORE) for number in needed]
        trained = sum(behaviour.seconds for behaviour in behaviours)
        episodes, policies = tier_episodes(tier, rows, seed, behaviours)
        made = {"tier": tier, "meaning": TIERS[tier], "policies": policies, "command": command}
        _write(task, episodes, made | {"versions": manifest()["versions"]}, folder, start, trained)
    card = json.loads((out / CARD).read_text())
    if card["command"] != command:
        raise InputError(f"{out} was made by `{card['command']}`: ask for the same, or name another folder")
    row = {"out": str(out), "task": task, "tier": tier, "return": card["returns"]["mean"]}
    return row | {name: card[name] for name in ("rows", "episodes", "seconds", "training_seconds", "sha256")}


def tier_folder(task: str, tier: str, folder: Path) -> Path:
    """Where a tier goes, by Minari's rules for names."""
    return folder / re.sub(r"[^a-z0-9-]+", "-", task.lower()) / f"{tier}-v0"


def _write(
    task: str, episodes: Sequence[Episode], made: dict[str, Any], folder: Path, start: float, trained: float
) -> None:
    out, spec = tier_folder(task, made["tier"], folder), describe(task)
    name = out.relative_to(folder).as_posix()
    logs = as_logs(episodes, task=task, source=name, action_low=spec.action_low, action_high=spec.action_high)
    finals = np.stack([episode.final_observation for episode in episodes])
    said = {"algorithm_name": "PPO", "description": f"{made['tier']}: {made['meaning']}", "task": task}
    shutil.rmtree(out, ignore_errors=True)  # without its card it is half of a dataset
    save_minari(logs, name, said, root=folder, final_observations=finals, env_spec=_registered(task))
    seconds = {"seconds": round(time.perf_counter() - start, 1), "training_seconds": round(trained, 1)}
    card = describe_logs(logs) | made | seconds
    write_atomically(out / "README.md", card_text(name, card).encode())
    write_atomically(out / CARD, json.dumps(card, indent=1).encode())


def _registered(task: str) -> bool:
    """Whether Gymnasium knows the id: not Striker's, nor a class's import path."""
    import gymnasium

    try:
        return gymnasium.spec(task) is not None
    except gymnasium.error.Error:
        return False


def runs_needed(tier: str) -> int:
    """Behaviour runs that a tier is made of."""
    return MIXED_RUNS if tier == "mixed" else 1


def estimate(task: str, tiers: Sequence[str], rows: int, seed: int, steps: int, folder: Path) -> float:
    """Seconds that what is not in `folder` yet will take on one core, from half a second of the environments."""
    missing = [tier for tier in tiers if not (tier_folder(task, tier, folder) / CARD).is_file()]
    seeds = {seed + i for tier in missing for i in range(runs_needed(tier))}
    runs = sum(not is_done(behaviour_folder(task, number, steps, folder / STORE)) for number in seeds)
    collected = sum(tier != "medium-replay" for tier in missing)
    if not (runs or collected):
        return 0.0
    speed = speed_of(task)
    return runs * steps / (TRAINING_SHARE * speed) + collected * rows / speed


def speed_of(task: str) -> float:
    """Steps per second of the bare environments, from half a second of random actions."""
    env = make_vector_env(task, 8, seed=0)
    spec, rng, count = describe(task), np.random.default_rng(0), 0
    try:
        env.reset()
        start = time.perf_counter()
        while time.perf_counter() < start + 0.5:
            env.step(rng.uniform(spec.action_low, spec.action_high, (8, spec.action_size)).astype(np.float32))
            count += 8
        return count / (time.perf_counter() - start)
    finally:
        env.close()


def check_tiers(tiers: Sequence[str]) -> None:
    """Raise `InputError` for a tier that is none."""
    for tier in tiers:
        if tier not in TIERS:
            raise unknown("tier", tier, TIERS)
    if not tiers:
        raise InputError(f"tier is missing: must be one or more of {', '.join(TIERS)}")
