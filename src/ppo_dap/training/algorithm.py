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
from ppo_dap.dap.guide import GuideState, adapt_prior, create_guide, learn_q, make_proposals, on_policy
from ppo_dap.dap.objective import Batch, admit, proposal_gradient
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, PPOState, Rows, Settings, estimate_advantages, improve_actor, improve_critic
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


def create_learner(key: PRNGKeyArray, sizes: tuple[int, int], config: Config, denoiser: Denoiser | None) -> Learner:
    """Fresh networks; the guide's random stream is its own, so PPO's start does not depend on it."""
    ppo = PPOState.create(key, *sizes, config.ppo.hidden_size)
    if denoiser is None:
        return Learner(ppo, None)
    return Learner(ppo, create_guide(jax.random.fold_in(key, 1), ppo.critic, sizes, config, denoiser))


class Stages:
    """The stages of an iteration as jitted functions of arrays, for one configuration."""

    def __init__(self, config: Config, diffusion: DiffusionConfig | None):
        self.advantages = jax.jit(partial(_advantages, config=config))
        added_gradient = None if diffusion is None else proposal_gradient
        self.actor = jax.jit(partial(improve_actor, ppo=config.ppo, added_gradient=added_gradient))
        self.critic = jax.jit(partial(improve_critic, ppo=config.ppo))
        self.policy_metrics = jax.jit(audit.policy_metrics)
        if diffusion is not None:
            self.propose = jax.jit(partial(make_proposals, config=config, diffusion=diffusion))
            self.learn_q = jax.jit(partial(learn_q, config=config))
            self.adapt = jax.jit(partial(adapt_prior, config=config, diffusion=diffusion))
            self.leakage = jax.jit(partial(audit.leakage, ppo=config.ppo))
            self.prior_metrics = jax.jit(partial(audit.prior_metrics, diffusion=diffusion, config=config.proposals))


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
    old, guide = learner.ppo, learner.guide
    keys = [jax.random.fold_in(key, stream) for stream in range(6)]
    settings, weights = schedule.settings, schedule.settings.added_weights

    # 2) Advantages with GAE; rows that are not of the current batch lose their weight.
    rows, batch, metrics = run("update", stages.advantages, old.critic, rollout, normaliser, schedule.first_id)

    # 3) Value-guided proposals on states of D_on.
    gated: Any = ()
    if guide is not None and frozen is not None:
        gated, q_spread, proposed = run(
            "proposals",
            stages.propose,
            guide,
            frozen.denoiser,
            old.critic,
            on_policy(rows),
            batch,
            schedule.beta,
            keys[1],
        )
        metrics |= proposed

    # 4) The actor (Eq. 9) and V; Q by one-step TD.
    actor, actor_optimizer, improved = run(
        "update", stages.actor, old.actor, old.actor_optimizer, rows, gated, keys[0], settings
    )
    critic, critic_optimizer, valued = run(
        "update", stages.critic, old.critic, old.critic_optimizer, rows, keys[2], settings.learning_rate
    )
    metrics |= improved | valued | run("audit", stages.policy_metrics, actor, old.actor.log_std, rows)
    if guide is None or frozen is None:
        return Learner(PPOState(actor, critic, actor_optimizer, critic_optimizer), None), metrics
    q, critic, q_optimizer, learned = run("update", stages.learn_q, guide, critic, on_policy(rows), keys[3])

    # 5) PET: the adapters alone, on D_on.
    adapters, pet_optimizer, adapted = run(
        "pet", stages.adapt, guide, frozen.denoiser, on_policy(rows), batch, schedule.pet_steps, keys[4]
    )

    # 6) Monitoring.
    norm = improved["actor_gradient_norm"]
    leaked = run("audit", stages.leakage, actor, frozen.probe, normaliser, rows, batch, weights, norm)
    moved = run(
        "audit", stages.prior_metrics, actor, frozen.denoiser, guide.adapters, adapters, gated.proposals, keys[5]
    )
    ppo = PPOState(actor, critic, actor_optimizer, critic_optimizer)
    guide = GuideState(q, q_optimizer, q_spread, adapters, pet_optimizer)
    return Learner(ppo, guide), metrics | learned | adapted | leaked | moved
