"""A run's checkpoint as what guides it: policy, V, Q, the adapted prior, and the proposals that these make.

Whatever of training and of the guide a diagnostic needs is called here, and nowhere else in this package.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ppo_dap import config as configs
from ppo_dap.config import Config
from ppo_dap.dap.guidance import beta_schedule, effective_sample_size, energy_weights, top_k_mask
from ppo_dap.dap.guide import GuideState, Visited, make_proposals
from ppo_dap.dap.proposals import ProposalDraws, Proposals, acceptance, resample
from ppo_dap.errors import InputError
from ppo_dap.methods import get_method
from ppo_dap.nets.critic import q_features
from ppo_dap.nets.normalizer import RewardScale, RunningMoments
from ppo_dap.nets.policy import Policy
from ppo_dap.ppo.gae import gae
from ppo_dap.priors import Prior, load_prior
from ppo_dap.study.diagnostics.monte_carlo import Scoring, Walk
from ppo_dap.tasks import TaskSpec, describe
from ppo_dap.training.algorithm import create_learner
from ppo_dap.training.run import Run, load_run
from ppo_dap.training.state import TrainState, load_checkpoint


@dataclass(frozen=True)
class GuidedRun:
    """A run with a prior, at one of its checkpoints. Observations are raw, actions scaled to [-1, 1]."""

    run: Run
    config: Config
    spec: TaskSpec
    state: TrainState
    guide: GuideState
    prior: Prior

    @cached_property
    def policy(self) -> Policy:
        """The checkpoint's policy in numpy."""
        return self.state.policy(self.spec, self.config.ppo.observation_clip)

    @cached_property
    def scoring(self) -> Scoring:
        """Returns in Q's units."""
        ppo = self.config.ppo
        return Scoring(ppo.gamma, self.state.reward_scale.std, ppo.reward_clip, self.values)

    @cached_property
    def beta(self) -> float:
        """Energy temperature at the checkpoint; 0 where the method has no energy weights."""
        proposals, progress = self.config.proposals, min(1.0, self.state.env_steps / self.config.run.steps)
        on = "energy" in proposals.guidance
        return float(on and beta_schedule(progress, proposals.beta_max, proposals.beta_anneal))

    def normalised(self, observations: Float[np.ndarray, "n obs"]) -> Float[np.ndarray, "n obs"]:
        """Observations as the networks see them."""
        moments, clip = self.state.observations, self.config.ppo.observation_clip
        return np.clip((observations - moments.mean) / moments.std, -clip, clip).astype(np.float32)

    def values(self, observations: Float[np.ndarray, "n obs"]) -> Float[np.ndarray, " n"]:
        """V(s)."""
        return np.asarray(self.state.learner.ppo.critic(jnp.asarray(self.normalised(observations))), np.float64)

    def q(
        self, observations: Float[np.ndarray, "n obs"], actions: Float[np.ndarray, "n k act"]
    ) -> Float[np.ndarray, "n k"]:
        """Q(s, a), as proposals see it."""
        seen = jnp.asarray(self.normalised(observations))
        features = q_features(self.state.learner.ppo.critic, self.guide.q, seen, shared=False)
        values = self.guide.q(features, jnp.asarray(actions, jnp.float32), self.config.proposals.q_pessimism)
        return np.asarray(values if self.guide.calibration is None else self.guide.calibration(values), np.float64)

    def candidates(
        self, observations: Float[np.ndarray, "n obs"], guided: bool, seed: int
    ) -> Float[np.ndarray, "n k act"]:
        """K samples of the adapted prior at each state before energy weighting; `guided`: with grad Q (Eq. 8), where
        the run's method has it. The same seed gives the same noise for both.
        """
        steered = guided and "gradient" in self.config.proposals.guidance
        # Without energy and top_k nothing is drawn again: what comes back are the candidates themselves.
        plain = {"top_k": None, "keep_diverse": None, "mode_seeking": 0.0}
        config = configs.replace(self.config, guidance="gradient" if steered else "none", **plain)
        n = len(observations)
        draws = ProposalDraws.make(np.random.default_rng([seed, 2]), n, n, self.prior.network, config.proposals)
        visited = Visited(
            jnp.arange(n, dtype=jnp.int32),
            jnp.asarray(observations),
            jnp.asarray(self.normalised(observations)),
            jnp.ones(n),
        )
        proposed = _propose(self, visited, draws, config)
        return np.asarray(proposed.actions)[np.argsort(np.asarray(proposed.state_ids))]

    def energy_weights(self, q: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Eq. 7 as the run has it at the checkpoint: its beta, its running scale of Q, its filter."""
        config, values = self.config.proposals, jnp.asarray(q, jnp.float32)
        scale = jnp.maximum(self.guide.q_spread, 1e-6) if config.q_scale == "running" else jnp.ones(())
        return np.asarray(energy_weights(values, jnp.asarray(self.beta), scale, top_k_mask(values, config.top_k)))

    def draw(self, weights: Float[np.ndarray, "n k"], seed: int) -> tuple[np.ndarray, dict[str, float]]:
        """Which candidates D_syn would hold under `weights`, (n, k) indices; with ESS (5.6) and acceptance (5.5)."""
        uniform = np.random.default_rng([seed, 3]).random(weights.shape, dtype=np.float32)
        drawing = self.beta > 0 or self.config.proposals.top_k is not None
        everyone = np.broadcast_to(np.arange(weights.shape[1]), weights.shape)
        chosen = np.asarray(resample(jnp.asarray(weights), jnp.asarray(uniform))) if drawing else everyone
        ess = float(np.mean(np.asarray(effective_sample_size(jnp.asarray(weights)))))
        return chosen, {"ess": ess, "acceptance": float(acceptance(jnp.asarray(chosen)))}

    def gae(self, trajectory: Walk) -> Float[np.ndarray, " steps"]:
        """GAE advantages of a walk, as PPO would take them."""

        def column(values):
            return jnp.asarray(values)[:, None]

        ppo = self.config.ppo
        advantages = gae(
            column(np.float32(self.scoring(trajectory.rewards))),
            column(np.float32(self.values(trajectory.observations))),
            column(np.float32(self.values(trajectory.next_observations))),
            column(trajectory.terminated),
            column(trajectory.truncated),
            column(np.ones(len(trajectory.rewards), bool)),
            ppo.gamma,
            ppo.gae_lambda,
        )
        return np.asarray(advantages, np.float64)[:, 0]


def _propose(guided: GuidedRun, visited: Visited, draws: ProposalDraws, config: Config) -> Proposals:
    """The one call of the guide: its proposals on all of `visited`."""
    condition = jnp.asarray(guided.prior.condition(config.proposals.prior_return))
    proposer = guided.guide.proposer(guided.prior.network, condition, guided.state.learner.ppo.critic, None)
    return _make_proposals(proposer, visited, jnp.zeros(()), draws, config=config).proposals


_make_proposals = jax.jit(make_proposals, static_argnames="config")


def load_guided(
    folder: str | Path, prior: Prior | str | Path, checkpoint: Literal["last", "best"] = "last"
) -> GuidedRun:
    """Open a run folder at a checkpoint, with the prior that it was trained with. Of a run that went on without its
    guide, `last` is the checkpoint that keeps it.

    Raises `InputError` for a method without a prior, another prior than the run's, and a checkpoint that is missing
    or of other networks.
    """
    run = load_run(folder)
    kind = get_method(run.config["method"]).prior
    if kind == "none":
        raise InputError(f"{folder} is a run of {run.config['method']}: it has no Q head, and nothing it would guide")
    found = prior if isinstance(prior, Prior) else load_prior(prior)
    if found.kind not in (kind, "random"):
        raise InputError(
            f"prior {prior} is of kind {found.kind!r}, {folder} was trained with a {kind} prior: name that"
        )
    if found.logs_hash != run.config["prior_hash"]:
        raise InputError(f"prior {prior} was fitted to other logs than the prior that {folder} was trained with")
    config = configs.replace(Config(), **run.config["config"])
    spec = describe(run.config["task"])
    sizes = spec.observation_size, spec.action_size
    learner = create_learner(sizes, config, found.network)
    like = TrainState(learner, RunningMoments.create(sizes[0]), RewardScale.create(config.ppo.num_envs))
    kept = run.folder / "checkpoints" / "guided.safetensors"
    path = kept if checkpoint == "last" and kept.is_file() else kept.with_stem(checkpoint)
    state, _ = load_checkpoint(path, like)
    if state.learner.guide is None:
        raise InputError(
            f"checkpoint {checkpoint} of {folder} is of {state.env_steps:,} steps, when the run went on without its "
            "guide: choose checkpoint last, which is the guide's last"
        )
    return GuidedRun(run, config, spec, state, state.learner.guide, found)
