"""The public way into Stage II: `train` makes or resumes a run folder, `load_run` opens one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ppo_dap import config as configs
from ppo_dap.config import Config
from ppo_dap.dap import audit
from ppo_dap.dap.objective import weights_left
from ppo_dap.errors import InputError
from ppo_dap.logs import Logs, load_logs, require_compatible
from ppo_dap.logs.check import family
from ppo_dap.methods import Method, get_method, resolve
from ppo_dap.nets.arrays import on_device
from ppo_dap.nets.normalizer import RewardScale, RunningMoments
from ppo_dap.nets.policy import Policy, load_policy
from ppo_dap.priors import Prior, load_prior, random_prior
from ppo_dap.storage import require_folder, write_atomically
from ppo_dap.tasks import TaskSpec, describe
from ppo_dap.training.ahead import CompileAhead
from ppo_dap.training.algorithm import Frozen, Stages, create_learner
from ppo_dap.training.manifest import manifest
from ppo_dap.training.proof import prove
from ppo_dap.training.recording import Recorder, make_progress, read_table
from ppo_dap.training.state import TrainState, load_checkpoint
from ppo_dap.training.trainer import Trainer
from ppo_dap.training.warm_start import warm_start


@dataclass(frozen=True)
class Run:
    """A run folder."""

    folder: Path

    @cached_property
    def config(self) -> dict[str, Any]:
        """`config.json`: the resolved settings, at their defaults what its version did not know; the manifest."""
        return _read_config(self.folder)

    @cached_property
    def policy(self) -> Policy:
        """The policy at the run's end: numpy in, numpy out, deterministic, the normaliser inside."""
        path = self.folder / "policy.safetensors"
        if not path.is_file():
            raise InputError(f"no policy file at {path}: a run has one at its end; go on with `ppo-dap train --resume`")
        return load_policy(path)

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """One row an iteration."""
        return read_table(self.folder, "metrics")

    @property
    def evaluations(self) -> list[dict[str, Any]]:
        """One row an evaluation point."""
        return read_table(self.folder, "evaluations")

    @property
    def finished(self) -> bool:
        """Whether the budget was spent."""
        rows = self.metrics
        return bool(rows) and rows[-1]["env_steps"] >= self.config["config"]["steps"]

    def audit(self) -> list[audit.Claim]:
        """Definition 1, claim by claim: proved on the traced update, and measured in every iteration so far."""
        static = audit.require_proofs(_proofs(self.folder))
        guided, config = self.config["prior_hash"] is not None, self.config["config"]
        evaluations = self.evaluations
        rows = audit.every_iteration(self.metrics, evaluations[-1]["env_steps"] if evaluations else 0)
        start, in_use = 0, 0
        for row in rows:
            in_use += weights_left(start, config) > 0
            start = row.get("env_steps", start)
        return static + audit.measured_claims(rows, guided, guided and config["pet_frequency"] > 0, in_use)

    def verdict(self) -> tuple[bool, bool]:
        """Whether the run was strictly on-policy, and whether that is what its method's row says it is."""
        strictly = all(claim.holds for claim in self.audit())
        return strictly, strictly or not get_method(self.config["method"]).strictly_on_policy


def _proofs(folder: Path) -> list[audit.Claim]:
    """What was proved of the run's update, in each of the sittings in which it was made."""
    path = folder / "audit.json"
    if not path.is_file():
        raise InputError(f"{folder} has no audit.json: is it a run folder?")
    try:
        return [audit.Claim(**claim) for claim in json.loads(path.read_text())["static"]]
    except (ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is damaged ({error}): it must be what `ppo-dap train` wrote") from error


def _read_config(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    try:
        stored = json.loads(path.read_text())
        lacking = {"task", "method", "preset", "prior_hash", "config"} - stored.keys()
        lacking = lacking or {"seed", "steps"} - stored["config"].keys()
        if lacking:
            raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
        return stored | {"config": configs.flatten(Config()) | stored["config"]}
    except (ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error}): it must be what `ppo-dap train` wrote") from error


def load_run(folder: str | Path) -> Run:
    """Open a run folder; raises `InputError` if it is none."""
    folder = Path(folder)
    if not (folder / "config.json").is_file():
        raise InputError(f"{folder} is not a run folder: it has no config.json")
    return Run(folder)


def train(
    task: str,
    method: str = "ppo-dap",
    *,
    prior: Prior | str | Path | None = None,
    logs: Logs | str | Path | None = None,
    out: str | Path,
    preset: str = "paper",
    resume: bool = False,
    progress: bool = True,
    **options: Any,
) -> Run:
    """Train `method` on `task` and write everything to the run folder `out`.

    `prior` is needed by methods that have one, `logs` by a warm start; `options` are fields of `Config` by name, and
    where `gamma` is not among them, the task's own is taken if the catalogue has one. With `resume` the run in `out`
    goes on from its last checkpoint, under the config that it was started with.

    Raises `InputError` for anything that cannot work, before anything is written.
    """
    chosen = get_method(method)
    spec = describe(task)
    of_task = {} if spec.gamma is None else {"gamma": spec.gamma}
    config = configs.make(preset, **of_task | options)
    prior = _check_prior(chosen, prior, spec)
    config = resolve(chosen, config, options, None if prior is None else prior.kind)
    condition = None if prior is None else prior.condition(config.proposals.prior_return)
    folder = Path(out)
    logs = _check_logs(config, logs, spec)
    description = {
        "task": spec.task,
        "method": chosen.name,
        "preset": preset,
        "config": configs.flatten(config),
        "prior_hash": None if prior is None else prior.logs_hash,
        "prior_weights": None if prior is None else prior.hash(),
        "logs_hash": None if logs is None else logs.hash(),
    }
    _check_folder(folder, description, resume)
    trainer = _make_trainer(config, spec, prior, condition, logs, folder, description, resume, progress)
    trainer.run()
    return Run(folder)


def _make_trainer(
    config: Config,
    spec: TaskSpec,
    prior: Prior | None,
    condition: Float[np.ndarray, " c"] | None,
    logs: Logs | None,
    folder: Path,
    description: dict[str, Any],
    resume: bool,
    show: bool,
) -> Trainer:
    sizes = (spec.observation_size, spec.action_size)
    frozen = None
    if prior is not None:
        probe = audit.Probe(on_device(prior.probe_observations), on_device(prior.probe_actions))
        frozen = Frozen(prior.network, on_device(condition), probe)
    spread = None
    if prior is not None and config.ppo.initial_std is None:
        spread = prior.spread(config.proposals.prior_return)
    learner = create_learner(sizes, config, None if frozen is None else frozen.prior, spread)
    state = TrainState(learner, RunningMoments.create(sizes[0]), RewardScale.create(config.ppo.num_envs))
    flat = configs.flatten(config)
    lines, before = None, []
    checkpoint = folder / "checkpoints" / "last.safetensors"
    if resume and checkpoint.is_file():
        state, run = load_checkpoint(checkpoint, state)
        lines = run["lines"]
        before = _proofs(folder)
        if frozen is not None and state.learner.guide is None and weights_left(state.env_steps, flat):
            raise InputError(f"{checkpoint} has no guide, which the run still needs: was it another config?")
    elif logs is not None:
        state = warm_start(state, logs, spec, config)
    stages = Stages(config, guided=frozen is not None)
    ahead = CompileAhead()
    claims = prove(learner, frozen, config, stages, ahead.trace)
    alone = stages.alone()
    if stages.adds and weights_left(config.run.steps, flat) == 0:
        claims = audit.both(claims, prove(learner.alone(), None, config, alone, ahead.trace))
    claims = audit.both(before, claims)
    if lines is None:
        write_atomically(folder / "config.json", json.dumps(description | manifest(), indent=1).encode())
    recorder = Recorder(folder, config.run.tensorboard, lines)
    label = f"{spec.task} {description['method']} seed {config.run.seed}"
    bar = make_progress(label, config.run.steps, state.env_steps, show)
    return Trainer(
        config, spec, state, frozen, stages, alone, folder, {"task": spec.task}, claims, recorder, bar,
        before_first=ahead.wait,
    )  # fmt: skip


def _check_prior(method: Method, prior: Any, spec: TaskSpec) -> Prior | None:
    if method.prior == "none":
        if prior is not None:
            raise InputError(f"method {method.name} has no prior, but prior {prior} was given: leave it out")
        return None
    if prior is None:
        fit = f"`ppo-dap pretrain --kind {method.prior}`"
        raise InputError(f"method {method.name} needs a {method.prior} prior: fit one with {fit} and pass it as prior")
    if isinstance(prior, str) and prior == "random":
        return random_prior(spec.observation_size, spec.action_low, spec.action_high, spec.task)
    prior = prior if isinstance(prior, Prior) else load_prior(prior)
    if prior.kind not in (method.prior, "random"):
        raise InputError(
            f"method {method.name} needs a {method.prior} prior, but this one is of kind {prior.kind!r}: fit one with "
            f"`ppo-dap pretrain --kind {method.prior}`, or choose the method of that prior"
        )
    for name in ("observation_size", "action_size"):
        if getattr(prior, name) != getattr(spec, name):
            raise InputError(
                f"the prior was fitted to logs of {prior.task or 'another task'} with {name} {getattr(prior, name)}; "
                f"{spec.task} has {name} {getattr(spec, name)}: fit a prior to logs of {spec.task}"
            )
    if prior.task is not None and family(prior.task) != family(spec.task):
        raise InputError(f"the prior was fitted to logs of {prior.task}, not of {spec.task}")
    if not (np.allclose(prior.action_low, spec.action_low) and np.allclose(prior.action_high, spec.action_high)):
        raise InputError(
            f"the prior's action bounds {prior.action_low}..{prior.action_high} are not those of {spec.task}, "
            f"{spec.action_low}..{spec.action_high}"
        )
    return prior


def _check_logs(config: Config, logs: Any, spec: TaskSpec) -> Logs | None:
    if config.warm.warm_start == "none":
        if logs is not None:
            raise InputError("logs are used by a warm start alone: set warm_start, or leave logs out")
        return None
    if logs is None:
        raise InputError(f"warm_start {config.warm.warm_start!r} needs logs")
    logs = logs if isinstance(logs, Logs) else load_logs(logs)
    require_compatible(logs, task=spec.task, observation_size=spec.observation_size, action_size=spec.action_size)
    return logs


def _check_folder(folder: Path, description: dict[str, Any], resume: bool) -> None:
    """Refuse to write over a run, and to resume one as another."""
    path = folder / "config.json"
    require_folder("out", folder)
    if not path.is_file():
        if resume:
            raise InputError(f"nothing to resume in {folder}: it has no config.json")
        if folder.is_dir() and any(folder.iterdir()):
            raise InputError(f"out {folder} is a folder with other files in it: name a new one")
        return
    if not resume:
        raise InputError(f"out {folder} holds a run already: name a new folder, or resume it")
    stored = _read_config(folder)
    for name, value in description.items():
        if name == "config":
            for option, wanted in value.items():
                _require_same(folder, option, wanted, stored["config"][option])
        else:
            _require_same(folder, name, value, stored.get(name, value))  # an earlier version wrote less


def _require_same(folder: Path, name: str, wanted: Any, started: Any) -> None:
    if started != wanted:
        raise InputError(f"cannot resume {folder} with {name} {wanted!r}: it was started with {started!r}")
