"""Algorithm 1: one iteration of PPO-DAP after its rollout, step by step. Plain PPO is the same without a guide."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ppo_dap.config import Config
from ppo_dap.dap import audit
from ppo_dap.dap.guide import GuideState, adapt_prior, create_guide, learn_q, make_proposals
from ppo_dap.dap.objective import Batch, admit, proposal_gradient
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, PPOState, Rows, Settings, estimate_advantages, improve
from ppo_dap.priors.diffusion import Denoiser, DiffusionConfig

Metrics = dict[str, Float[Array, ""]]


class Learner(eqx.Module):
    """Everything that an iteration updates on the device."""

    ppo: PPOState
    guide: GuideState | None


class Frozen(NamedTuple):
    """The prior as Stage I left it, and the offline minibatch of the leakage audit."""

    denoiser: Denoiser
    probe: audit.Probe


class Schedule(NamedTuple):
    """What changes with the run's progress, as arrays, so that nothing recompiles."""

    first_id: Int[Array, ""]
    settings: Settings
    beta: Float[Array, ""]
    pet_steps: Int[Array, ""]


def create_learner(
    key: PRNGKeyArray, sizes: tuple[int, int], config: Config, denoiser: Denoiser | None
) -> Learner:
    """Fresh networks; the guide's random stream is its own, so PPO's start does not depend on it."""
    ppo = PPOState.create(key, *sizes, config.ppo.hidden_size)
    if denoiser is None:
        return Learner(ppo, None)
    return Learner(ppo, create_guide(jax.random.fold_in(key, 1), ppo.critic, sizes, config, denoiser))


class Stages:
    """The stages of an iteration as jitted functions of arrays, for one configuration."""

    def __init__(self, config: Config, diffusion: DiffusionConfig | None):
        self.advantages = jax.jit(partial(_advantages, config=config))
        self.improve = jax.jit(
            partial(improve, ppo=config.ppo, added_gradient=None if diffusion is None else proposal_gradient)
        )
        self.policy_metrics = jax.jit(audit.policy_metrics)
        if diffusion is not None:
            self.propose = jax.jit(partial(make_proposals, config=config, diffusion=diffusion))
            self.learn_q = jax.jit(partial(learn_q, config=config))
            self.adapt = jax.jit(partial(adapt_prior, config=config, diffusion=diffusion))
            self.leakage = jax.jit(partial(audit.leakage, ppo=config.ppo))
            self.prior_metrics = jax.jit(
                partial(audit.prior_metrics, diffusion=diffusion, config=config.proposals)
            )


def _advantages(
    critic: Critic, rollout: Rollout, normaliser: Normaliser, first_id: Int[Array, ""], *, config: Config
) -> tuple[Rows, Batch, Metrics]:
    rows = estimate_advantages(critic, rollout, normaliser, config.ppo)
    batch = Batch(first_id, rows.raw_observations, rows.weights)
    admitted = admit(rows, batch)
    return admitted, batch, {"batch_fresh": jnp.sum(admitted.weights) / jnp.sum(rows.weights)}


def call(name: str, stage: Callable[..., Any], *arguments: Any) -> Any:
    """Run a stage; the trainer's replacement also takes the time under `name`."""
    return stage(*arguments)


def update(
    learner: Learner,
    frozen: Frozen | None,
    rollout: Rollout,
    normaliser: Normaliser,
    schedule: Schedule,
    key: PRNGKeyArray,
    stages: Stages,
    run: Callable[..., Any] = call,
) -> tuple[Learner, Metrics]:
    """Steps 2 to 6 of Algorithm 1 on the rollout of step 1. Without a guide it is PPO."""
    ppo, guide, old_log_std = learner.ppo, learner.guide, learner.ppo.actor.log_std
    keys = [jax.random.fold_in(key, stream) for stream in range(5)]

    # 2) Advantages with GAE; rows that are not of the current batch lose their weight.
    rows, batch, metrics = run("update", stages.advantages, ppo.critic, rollout, normaliser, schedule.first_id)

    if guide is None or frozen is None:
        ppo, improved = run("update", stages.improve, ppo, rows, (), keys[0], schedule.settings)
        return Learner(ppo, None), metrics | improved | run("audit", stages.policy_metrics, ppo.actor, old_log_std, rows)

    # 3) Value-guided proposals on states of D_on.
    gated, q_spread, proposed = run(
        "proposals", stages.propose, guide, frozen.denoiser, ppo.critic, rows, batch, schedule.beta, keys[1]
    )
    # 4) Actor (Eq. 9) and V, then Q by one-step TD.
    ppo, improved = run("update", stages.improve, ppo, rows, gated, keys[0], schedule.settings)
    q, critic, q_optimizer, learned = run("update", stages.learn_q, guide, ppo.critic, rows, keys[2])
    ppo = eqx.tree_at(lambda p: p.critic, ppo, critic)
    # 5) PET: the adapters alone, on D_on.
    adapters, pet_optimizer, adapted = run(
        "pet", stages.adapt, guide, frozen.denoiser, rows, batch, schedule.pet_steps, keys[3]
    )
    # 6) Monitoring.
    norm, weights = improved["actor_gradient_norm"], schedule.settings.added_weights
    audited = (
        run("audit", stages.policy_metrics, ppo.actor, old_log_std, rows)
        | run("audit", stages.leakage, ppo.actor, frozen.probe, normaliser, rows, batch, weights, norm)
        | run(
            "audit", stages.prior_metrics, ppo.actor, frozen.denoiser, guide.adapters, adapters, gated.proposals, keys[4]
        )
    )
    guide = GuideState(q, q_optimizer, q_spread, adapters, pet_optimizer)
    return Learner(ppo, guide), metrics | proposed | improved | learned | adapted | audited
