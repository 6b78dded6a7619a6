"""The loop around Algorithm 1: rollouts, schedules, statistics, evaluation, checkpoints."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ppo_dap.config import Config
from ppo_dap.dap import audit
from ppo_dap.dap.adaptation import steps_until
from ppo_dap.dap.guidance import beta_schedule
from ppo_dap.dap.objective import Weights
from ppo_dap.errors import TrainingDiverged
from ppo_dap.ppo.rollout import Collector, Rollout
from ppo_dap.ppo.update import Normaliser, Settings
from ppo_dap.storage import write_atomically
from ppo_dap.tasks import TaskSpec, make_vector_env
from ppo_dap.training.algorithm import Frozen, Schedule, Stages, update
from ppo_dap.training.evaluation import evaluate_policy
from ppo_dap.training.recording import Progress, Recorder
from ppo_dap.training.state import TrainState, save_checkpoint

LOSSES = ("ppo_loss", "value_loss", "kl_loss", "aux_loss", "q_loss", "pet_loss")
EXPLODED = 1e8
"""A loss beyond this is not coming back."""
ROLLOUT_STREAM, ENV_STREAM, EVALUATION_STREAM = 0, 1, 2


class Stopwatch:
    """Times the stages of an iteration by name; waits for each, so that its time is its own."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    def __call__(self, name: str, function: Any, *arguments: Any) -> Any:
        """Call `function` and add the time it took to `name`."""
        start = time.perf_counter()
        result = jax.block_until_ready(function(*arguments))
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        return result


@dataclass
class Trainer:
    """One run in one folder."""

    config: Config
    spec: TaskSpec
    state: TrainState
    frozen: Frozen | None
    stages: Stages
    folder: Path
    identity: dict[str, Any]
    """Which run a checkpoint belongs to."""
    static_claims: list[audit.Claim]
    recorder: Recorder
    progress: Progress
    interrupted: bool = field(default=False, init=False)
    _last_return: float | None = field(default=None, init=False)

    def run(self) -> None:
        """Train until the budget is spent, or until Ctrl-C; the last checkpoint holds the end either way."""
        self._write_audit()
        try:
            with self._deferred_interrupt():
                if self.state.iteration == 0:
                    self.evaluate()
                while self.state.env_steps < self.config.run.steps and not self.interrupted:
                    self._segment()
                    self.checkpoint("last")
            self.state.policy(self.spec, self.config.ppo.observation_clip).save(self.folder / "policy.safetensors")
        finally:
            self.recorder.close()
            self.progress.close()

    def _segment(self) -> None:
        """Iterations up to the next checkpoint.

        Environments start anew with each segment, so that a resumed run sees what an uninterrupted one does.
        """
        config, state = self.config.run, self.state
        seed = _seed(config.seed, ENV_STREAM, state.iteration)
        state.reward_scale = state.reward_scale.restart()
        env = make_vector_env(self.spec.task, self.config.ppo.num_envs, seed, config.threads)
        try:
            collector = Collector(env)
            while not self.interrupted:
                before = state.env_steps
                self.iterate(collector)
                due = config.eval_every and state.env_steps // config.eval_every > before // config.eval_every
                if due or state.env_steps >= config.steps:
                    self.evaluate()
                if state.env_steps >= config.steps or state.iteration % config.checkpoint_every == 0:
                    break
        finally:
            env.close()

    def iterate(self, collector: Collector) -> None:
        """One iteration of Algorithm 1 and its line in the metrics."""
        state, config, ppo = self.state, self.config, self.config.ppo
        clock, start = Stopwatch(), time.perf_counter()
        # 1) Rollout with the current policy and frozen statistics.
        rollout = self._collect(collector, clock)
        valid, ended = np.asarray(rollout.valid), np.asarray(rollout.terminated | rollout.truncated)
        state.reward_scale = state.reward_scale.update(np.asarray(rollout.rewards), ended, valid, ppo.gamma)
        # 2) to 6)
        key = jax.random.fold_in(jax.random.key(config.run.seed), state.iteration)
        state.learner, device_metrics = update(
            state.learner, self.frozen, rollout, self._normaliser(), self.schedule(), key, self.stages, clock
        )
        metrics = {name: float(value) for name, value in device_metrics.items()}
        self._guard(metrics)
        state.observations = state.observations.update(np.asarray(rollout.observations)[valid])
        state.iteration += 1
        state.env_steps += int(valid.sum())
        self._apply_kl_rule(metrics["policy_kl"])
        self._record(metrics, collector, int(valid.sum()), clock.seconds, time.perf_counter() - start)

    def _collect(self, collector: Collector, clock: Stopwatch) -> Rollout:
        state, config = self.state, self.config
        policy = state.policy(self.spec, config.ppo.observation_clip)
        rng = np.random.default_rng([config.run.seed, ROLLOUT_STREAM, state.iteration])
        rollout = clock("rollout", collector.collect, policy, config.ppo.rollout_steps, state.iteration, rng)
        clock.seconds["env"] = collector.env_seconds
        clock.seconds["policy"] = clock.seconds.pop("rollout") - collector.env_seconds
        return rollout

    def _normaliser(self) -> Normaliser:
        state = self.state
        return Normaliser(
            jnp.asarray(state.observations.mean, jnp.float32),
            jnp.asarray(state.observations.std, jnp.float32),
            jnp.asarray(state.reward_scale.std, jnp.float32),
        )

    def schedule(self) -> Schedule:
        """What the run's progress sets for the next iteration."""
        config, state = self.config, self.state
        ppo, objective = config.ppo, config.objective
        progress = min(1.0, state.env_steps / config.run.steps)
        rate = ppo.learning_rate * (1 - progress) * state.learning_rate_scale
        limit = ppo.kl_target if ppo.kl_rule == "stop_epochs" else math.inf
        decay = 1.0 if objective.lambda_decay is None else max(0.0, 1 - progress / objective.lambda_decay)
        updates = ppo.num_epochs * ppo.rollout_steps // ppo.minibatch_size
        pet = [steps_until(state.iteration + i, config.adaptation.pet_frequency, updates) for i in (0, 1)]
        guided = self.frozen is not None
        weights = Weights(_f32(objective.lambda_kl * decay), _f32(objective.lambda_aux * decay))
        return Schedule(
            jnp.asarray(state.iteration * ppo.rollout_steps, jnp.int32),
            Settings(_f32(rate), _f32(limit), jnp.asarray(guided), weights if guided else ()),
            _f32(beta_schedule(progress, config.proposals.beta_max, config.proposals.beta_anneal)),
            jnp.asarray(pet[1] - pet[0], jnp.int32),
        )

    def _apply_kl_rule(self, policy_kl: float) -> None:
        if self.config.ppo.kl_rule == "reduce_lr":
            scale, target = self.state.learning_rate_scale, self.config.ppo.kl_target
            if policy_kl > target:
                self.state.learning_rate_scale = scale / 2
            elif policy_kl < target / 2:
                self.state.learning_rate_scale = min(1.0, scale * 2)

    def _guard(self, metrics: dict[str, float]) -> None:
        """Stop a run whose losses are not numbers any more, before anything of it is saved."""
        for name in LOSSES:
            if name in metrics and not abs(metrics[name]) < EXPLODED:
                last = self.folder / "checkpoints" / "last.safetensors"
                kept = f"the last good checkpoint is {last}" if last.is_file() else "there is no checkpoint yet"
                raise TrainingDiverged(f"iteration {self.state.iteration}: {name} is {metrics[name]:g}; {kept}")

    def _record(self, metrics: dict, collector: Collector, steps: int, seconds: dict, total: float) -> None:
        finished, collector.finished_returns = collector.finished_returns, []
        mean = float(np.mean(finished)) if finished else None
        self._last_return = mean if mean is not None else self._last_return
        schedule_free = {"env_steps": self.state.env_steps, "iteration": self.state.iteration, "return_train": mean}
        timing = {"steps_per_second": steps / total} | {f"seconds_{k}": v for k, v in seconds.items()}
        self.recorder.add("metrics", schedule_free | metrics | timing)
        self.progress.update(
            self.state.env_steps, {"return": self._last_return, "steps_per_second": timing["steps_per_second"]}
        )

    def evaluate(self) -> None:
        """Evaluate the deterministic policy with frozen statistics; keep the best one's checkpoint."""
        config, state = self.config.run, self.state
        policy = state.policy(self.spec, self.config.ppo.observation_clip)
        seed = _seed(config.seed, EVALUATION_STREAM, state.env_steps // max(config.eval_every, 1))
        result = evaluate_policy(policy, self.spec.task, config.eval_episodes, seed, config.threads)
        row = result.row(state.env_steps)
        self.recorder.add("evaluations", row)
        if row["return_mean"] > state.best_return:
            state.best_return = row["return_mean"]
            self.checkpoint("best")

    def checkpoint(self, name: str) -> None:
        """Write the state atomically; on failure the file of that name is what it was."""
        path = self.folder / "checkpoints" / f"{name}.safetensors"
        run = self.identity | {"lines": self.recorder.counts}
        try:
            save_checkpoint(path, self.state, run)
        except OSError as error:
            last = self.folder / "checkpoints" / "last.safetensors"
            kept = f"the last good checkpoint is {last}" if last.is_file() else "there is no checkpoint yet"
            raise OSError(f"checkpoint {path} could not be written ({error.strerror}); {kept}") from error

    def _write_audit(self) -> None:
        """What was proved about the update; what is measured is in the metrics."""
        claims = [dataclasses.asdict(claim) for claim in self.static_claims]
        write_atomically(self.folder / "audit.json", json.dumps({"static": claims}, indent=1).encode())

    @contextmanager
    def _deferred_interrupt(self) -> Iterator[None]:
        """Ctrl-C ends the run after the iteration that is under way; a second one ends it at once."""

        def note(signum, frame):
            self.interrupted = True
            signal.signal(signal.SIGINT, previous)

        try:
            previous = signal.signal(signal.SIGINT, note)
        except ValueError:  # not the main thread: whoever runs us handles signals
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, previous)


def _f32(value: float) -> jax.Array:
    return jnp.asarray(value, jnp.float32)


def _seed(*numbers: int) -> int:
    """A 31-bit seed that depends on all of `numbers`."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] >> 1)
