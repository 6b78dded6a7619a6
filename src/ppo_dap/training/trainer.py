"""The loop around Algorithm 1: rollouts, schedules, statistics, evaluation, checkpoints."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ppo_dap.config import Config, flatten
from ppo_dap.dap import audit
from ppo_dap.dap.adaptation import steps_until
from ppo_dap.dap.guidance import beta_schedule
from ppo_dap.dap.guide import recalibrated
from ppo_dap.dap.objective import Weights, regained_std, weights_left
from ppo_dap.errors import TrainingDiverged
from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.policy import Policy
from ppo_dap.ppo.rollout import Collector, Rollout
from ppo_dap.ppo.update import Normaliser, Settings
from ppo_dap.storage import write_atomically
from ppo_dap.tasks import TaskSpec, make_vector_env
from ppo_dap.training.algorithm import Frozen, Learner, Schedule, Stages, iterate
from ppo_dap.training.clock import Clock
from ppo_dap.training.cores import pinned
from ppo_dap.training.draws import Draws, draw, num_parts
from ppo_dap.training.evaluation import evaluate_policy
from ppo_dap.training.history import History
from ppo_dap.training.interrupt import Interrupt
from ppo_dap.training.recording import Progress, Recorder
from ppo_dap.training.state import TrainState, save_checkpoint
from ppo_dap.training.witness import Witness

LOSSES = ("ppo_loss", "value_loss", "kl_loss", "aux_loss", "awr_loss", "q_loss", "pet_loss")
EXPLODED = 1e8
"""A loss beyond this is not coming back."""
ROLLOUT_STREAM, ENV_STREAM, EVALUATION_STREAM = 0, 1, 2


class Pending(NamedTuple):
    """An iteration whose metrics the device may still be computing."""

    row: dict[str, Any]
    metrics: dict[str, Any]
    seconds: Callable[[], Mapping[str, float]]
    """Gives the seconds of its stages, once they are done."""
    total: float


@dataclass
class Trainer:
    """One run in one folder."""

    config: Config
    spec: TaskSpec
    state: TrainState
    frozen: Frozen | None
    stages: Stages
    alone: Stages
    """Those that are left when all weights of what is added have decayed to 0."""
    folder: Path
    identity: dict[str, Any]
    """Which run a checkpoint belongs to."""
    static_claims: list[audit.Claim]
    recorder: Recorder
    progress: Progress
    before_first: Callable[[], None] = lambda: None
    """Called before the first iteration: waits until the stages are compiled."""
    clock: Clock = field(default_factory=Clock, init=False)
    _interrupt: Interrupt = field(default_factory=Interrupt, init=False)
    history: History | None = field(init=False)
    _witness: Witness = field(init=False)
    _pending: Pending | None = field(default=None, init=False)
    _next_draws: tuple[int, Draws] | None = field(default=None, init=False)
    _recorded_steps: int = field(init=False)
    _settings: dict[str, Any] = field(init=False)
    _last_return: float | None = field(default=None, init=False)
    _segment_start: int = field(default=0, init=False)

    def __post_init__(self):
        self.history = History(self.folder) if self.config.run.keep_history else None
        self._recorded_steps, self._settings = self.state.env_steps, flatten(self.config)
        self._witness = Witness(self.state, self.spec, (self.config.run.seed, ROLLOUT_STREAM))

    def run(self) -> None:
        """Train until the budget is spent, or until a checkpoint after Ctrl-C, which holds the end either way."""
        self._write_audit()
        try:
            with self._interrupt.deferred(), pinned(self.config.run.pin_core and self.config.run.threads == 1):
                if self.state.iteration == 0:
                    self.evaluate()
                self.before_first()
                while self.state.env_steps < self.config.run.steps and not self._interrupt.asked:
                    self._segment()
                    self.checkpoint("last")
            self._policy().save(self.folder / "policy.safetensors")
        finally:
            self.clock.close()
            self.recorder.close()
            self.progress.close()

    def _segment(self) -> None:
        """Iterations up to the next checkpoint.

        Environments start anew with each segment, so that a resumed run sees what an uninterrupted one does.
        """
        config, state = self.config.run, self.state
        self._segment_start = state.iteration
        seed = _seed(config.seed, ENV_STREAM, state.iteration)
        state.reward_scale = state.reward_scale.restart()
        env = self._witness.watch(make_vector_env(self.spec.task, self.config.ppo.num_envs, seed, config.threads))
        try:
            collector = Collector(env)
            while True:
                before = state.env_steps
                self.iterate(collector)
                due = config.eval_every and state.env_steps // config.eval_every > before // config.eval_every
                if due or state.env_steps >= config.steps:
                    self.evaluate()
                left = -state.iteration % config.checkpoint_every
                if state.env_steps >= config.steps or not left:
                    break
                self._interrupt.tell(self.folder, left)
        finally:
            env.close()

    def iterate(self, collector: Collector) -> None:
        """One iteration of Algorithm 1. Returns when the actor is there; the last iteration's metrics are recorded."""
        state, config, start = self.state, self.config, time.perf_counter()
        self._witness.before(state)
        if self.stages.adds and not self._weights_left():
            self._go_on_alone()
        parts: list[Rollout] = []
        schedule = self.schedule()
        state.learner, metrics = iterate(
            self._calibrated(state.learner),
            self.frozen,
            self._collect(collector, parts),
            Normaliser(_array(state.observations.mean), _array(state.observations.std)),
            lambda: self._reward_std(parts),
            schedule,
            self._draws(state.iteration),
            self.stages,
            self.clock.dispatch,
        )
        # The host does its own work while the device works on the actor.
        with self.clock.host("host"):
            valid = np.concatenate([part.valid for part in parts])
            state.observations = state.observations.update(np.concatenate([p.observations for p in parts])[valid])
            row: dict[str, Any] = {"env_steps": state.env_steps + int(valid.sum()), "iteration": state.iteration + 1}
            std, ended = regained_std(self._settings), not weights_left(row["env_steps"], self._settings)
            if std > 0 and self.stages.adds and ended and self._weights_left():
                state.learner = _widened(state.learner, std)
            row["witnessed"] = self._witness.after(state, parts)
            row["return_train"] = float(np.mean(r)) if (r := collector.finished_returns) else None
            collector.finished_returns = []
            self._next_draws = state.iteration + 1, self._draws(state.iteration + 1)
        with self.clock.host("recording"):
            self.settle()
            if self.history is not None:
                self.history.keep_rollout(state.iteration, self._segment_start, parts, self.spec)
        state.iteration, state.env_steps = row["iteration"], row["env_steps"]
        with self.clock.host("waiting"):
            jax.block_until_ready(state.learner.ppo.actor)
        with np.errstate(over="ignore"):  # of a run that diverges, which the next iteration tells
            row["policy_std"] = float(np.exp(np.asarray(state.learner.ppo.actor.log_std)).mean())
        if self.frozen is not None:
            row["beta"] = float(schedule.beta)
        if config.ppo.kl_rule == "reduce_lr":
            self._reduce_lr(float(metrics["policy_kl"]))
        self._pending = Pending(row, metrics, self.clock.turn(), time.perf_counter() - start)

    def _weights_left(self) -> float:
        return weights_left(self.state.env_steps, self._settings)

    def _go_on_alone(self) -> None:
        """From here on the run is PPO: what has weight 0 for good need not be computed. A checkpoint keeps the guide.

        PPO's bits stay what they would be, but for a shared trunk: V then learns without Q. Of a run that was resumed
        after this the guide is gone already.
        """
        if self.state.learner.guide is not None:
            self.checkpoint("guided")
        self.state.learner, self.frozen, self.stages = self.state.learner.alone(), None, self.alone
        self._next_draws = None

    def _calibrated(self, learner: Learner) -> Learner:
        if learner.guide is None:
            return learner
        return Learner(learner.ppo, recalibrated(learner.guide, self.config.q), learner.previous)

    def _collect(self, collector: Collector, parts: list[Rollout]) -> Iterator[Rollout]:
        """The rollout, part by part; `parts` keeps them."""
        state, config = self.state, self.config
        policy = self._policy()
        rng = np.random.default_rng([config.run.seed, ROLLOUT_STREAM, state.iteration])
        steps, count = config.ppo.rollout_steps, num_parts(config)
        rollout = collector.collect(policy, steps, count, state.iteration, rng)
        while True:
            with self.clock.host("rollout"):
                part = next(rollout, None)
            if part is None:
                break
            parts.append(part)
            yield part
        self.clock.add("env", collector.env_seconds)

    def _policy(self) -> Policy:
        policy = self.state.policy(self.spec, self.config.ppo.observation_clip)
        if not all(np.isfinite(array).all() for array in (*policy.weights, *policy.biases, policy.log_std)):
            self.settle()  # names the loss that did it
            raise TrainingDiverged(f"iteration {self.state.iteration}: the policy is not finite; {self._kept()}")
        return policy

    def _draws(self, iteration: int) -> Draws:
        if self._next_draws is not None and self._next_draws[0] == iteration:
            return self._next_draws[1]
        return draw(self.config, iteration, None if self.frozen is None else self.frozen.prior)

    def _reward_std(self, parts: list[Rollout]) -> np.ndarray:
        """What this rollout's rewards are divided by: the running scale with the rollout itself in it."""
        rewards, ended, valid = (
            np.concatenate(x)
            for x in zip(*((p.rewards, p.terminated | p.truncated, p.valid) for p in parts), strict=True)
        )
        self.state.reward_scale = self.state.reward_scale.update(rewards, ended, valid, self.config.ppo.gamma)
        return _array(self.state.reward_scale.std)

    def schedule(self) -> Schedule:
        """What the run's progress sets for the next iteration."""
        config, state = self.config, self.state
        ppo, objective = config.ppo, config.objective
        progress = min(1.0, state.env_steps / config.run.steps)
        rate = ppo.learning_rate * (1 - progress) * state.learning_rate_scale
        limit = ppo.kl_target if ppo.kl_rule == "stop_epochs" else math.inf
        updates = ppo.num_epochs * ppo.rollout_steps // ppo.minibatch_size
        pet = [steps_until(state.iteration + i, config.adaptation.pet_frequency, updates) for i in (0, 1)]
        added = self.stages.adds
        lambdas = (objective.lambda_kl, objective.lambda_aux, objective.lambda_awr)
        weights = Weights(*(_array(weight * self._weights_left()) for weight in lambdas))
        return Schedule(
            _array(state.iteration * ppo.rollout_steps, np.int32),
            Settings(_array(rate), _array(limit), _array(added, np.bool_), weights if added else ()),
            _array(beta_schedule(progress, config.proposals.beta_max, config.proposals.beta_anneal)),
            _array(pet[1] - pet[0], np.int32),
        )

    def _reduce_lr(self, policy_kl: float) -> None:
        scale, target = self.state.learning_rate_scale, self.config.ppo.kl_target
        if policy_kl > target:
            self.state.learning_rate_scale = scale / 2
        elif policy_kl < target / 2:
            self.state.learning_rate_scale = min(1.0, scale * 2)

    def settle(self) -> None:
        """Record the iteration that is pending, if one is. Raises `TrainingDiverged` if its losses are no numbers."""
        if self._pending is None:
            return
        (row, metrics, seconds, total), self._pending = self._pending, None
        metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}
        metrics["batch_fresh"] *= row["witnessed"]
        for name in LOSSES:
            if name in metrics and not abs(metrics[name]) < EXPLODED:
                raise TrainingDiverged(f"iteration {row['iteration'] - 1}: {name} is {metrics[name]:g}; {self._kept()}")
        steps, self._recorded_steps = row["env_steps"] - self._recorded_steps, row["env_steps"]
        timing = dict(seconds())
        timing["policy"] = timing.pop("rollout") - timing["env"]
        speed = steps / total
        self.recorder.add(
            "metrics",
            row
            | metrics
            | {"steps_per_second": speed, "seconds_iteration": total}
            | {f"seconds_{name}": value for name, value in timing.items()},
        )
        self._last_return = self._last_return if row["return_train"] is None else row["return_train"]
        self.progress.update(row["env_steps"], {"return": self._last_return, "steps_per_second": speed})

    def _kept(self) -> str:
        last = self.folder / "checkpoints" / "last.safetensors"
        return f"the last good checkpoint is {last}" if last.is_file() else "there is no checkpoint yet"

    def evaluate(self) -> None:
        """Evaluate the deterministic policy with frozen statistics; keep the best one's checkpoint."""
        self.settle()
        config, state, policy = self.config.run, self.state, self._policy()
        seed = _seed(config.seed, EVALUATION_STREAM, state.env_steps // max(config.eval_every, 1))
        result = evaluate_policy(policy, self.spec.task, config.eval_episodes, seed, config.threads)
        row = result.row(state.env_steps)
        self.recorder.add("evaluations", row)
        if self.history is not None:
            self.history.keep_policy(state.env_steps, policy)
        if row["return_mean"] > state.best_return:
            state.best_return = row["return_mean"]
            self.checkpoint("best")

    def checkpoint(self, name: str) -> None:
        """Write the state atomically; on failure the file of that name is what it was."""
        self.settle()
        path = self.folder / "checkpoints" / f"{name}.safetensors"
        run = self.identity | {"lines": self.recorder.counts}
        try:
            save_checkpoint(path, self.state, run)
        except OSError as error:
            raise OSError(f"checkpoint {path} could not be written ({error.strerror}); {self._kept()}") from error

    def _write_audit(self) -> None:
        """What was proved about the update; what is measured is in the metrics."""
        claims = [dataclasses.asdict(claim) for claim in self.static_claims]
        write_atomically(self.folder / "audit.json", json.dumps({"static": claims}, indent=1).encode())


def _widened(learner: Learner, std: float) -> Learner:
    """With a policy whose standard deviations are at least `std`."""
    log_std = np.maximum(np.asarray(learner.ppo.actor.log_std), np.float32(np.log(std)))
    return eqx.tree_at(lambda learner: learner.ppo.actor.log_std, learner, on_device(log_std))


def _array(value: Any, dtype: Any = np.float32) -> Any:
    """numpy's: making a JAX array of it here would cost ten times what passing it to a stage does."""
    return np.asarray(value, dtype)


def _seed(*numbers: int) -> int:
    """A 31-bit seed that depends on all of `numbers`."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)
