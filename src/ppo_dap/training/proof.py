"""The static part of the audit: the data flow of the very update that a run calls, traced once at its start."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from ppo_dap.config import Config
from ppo_dap.dap import audit
from ppo_dap.dap.dataflow import trace
from ppo_dap.dap.guide import GuideState
from ppo_dap.dap.objective import Weights
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, PPOState, Settings
from ppo_dap.training.algorithm import Frozen, Learner, Schedule, Stages, update


def prove(learner: Learner, frozen: Frozen | None, config: Config, stages: Stages) -> list[audit.Claim]:
    """Claims of Definition 1 about the traced update of this learner; nothing is executed."""
    sizes = learner.ppo.actor.mlp.layers[0].weight.shape[1], learner.ppo.actor.log_std.shape[0]
    arguments: dict[str, Any] = {
        "actor": learner.ppo.actor,
        "critic": learner.ppo.critic,
        "ppo_optimizers": (learner.ppo.actor_optimizer, learner.ppo.critic_optimizer),
        "on_policy": example_rollout(config, *sizes),
        "normaliser": Normaliser(jnp.zeros(sizes[0]), jnp.ones(sizes[0]), jnp.ones(())),
        "schedule": example_schedule(guided=learner.guide is not None),
        "key": jax.random.key(0),
    }
    if learner.guide is not None and frozen is not None:
        guide = learner.guide
        arguments |= {
            "q": (guide.q, guide.q_optimizer, guide.q_spread),
            "adapters": (guide.adapters, guide.pet_optimizer),
            "backbone": frozen.denoiser,
            "offline": frozen.probe,
        }

    def whole_update(*, actor, critic, ppo_optimizers, on_policy, normaliser, schedule, key, **guided):
        guide = None
        if guided:
            (q, q_optimizer, spread), (adapters, pet_optimizer) = guided["q"], guided["adapters"]
            guide = GuideState(q, q_optimizer, spread, adapters, pet_optimizer)
        new, _ = update(
            Learner(PPOState(actor, critic, *ppo_optimizers), guide),
            Frozen(guided["backbone"], guided["offline"]) if guided else None,
            on_policy,
            normaliser,
            schedule,
            key,
            stages,
        )
        ppo, g = new.ppo, new.guide
        results = {"actor": ppo.actor, "critic": ppo.critic, "rest": (ppo.actor_optimizer, ppo.critic_optimizer, g)}
        return results if g is None else results | {"adapters": g.adapters}

    traced = trace(whole_update, arguments)
    full = traced.flow(sources=("proposals",))
    return audit.static_claims(full, traced.flow(sources=("proposals",), cuts=("theta",)))


def example_rollout(config: Config, observation_size: int, action_size: int) -> Rollout:
    """A rollout of zeros, for tracing."""
    envs = config.ppo.num_envs
    grid = (config.ppo.rollout_steps // envs, envs)
    wide = {
        name: jnp.zeros((*grid, size))
        for size, names in (
            (observation_size, ("observations", "next_observations")),
            (action_size, ("actions", "means")),
        )
        for name in names
    }
    flags = {name: jnp.zeros(grid, bool) for name in ("terminated", "truncated", "valid")}
    scalars = {name: jnp.zeros(grid) for name in ("log_probs", "rewards")}
    return Rollout(state_ids=jnp.zeros(grid, jnp.int32), **wide, **flags, **scalars)


def example_schedule(guided: bool) -> Schedule:
    """A schedule of zeros, for tracing."""
    zero = jnp.zeros(())
    settings = Settings(zero, zero, jnp.asarray(guided), Weights(zero, zero) if guided else ())
    return Schedule(jnp.zeros((), jnp.int32), settings, zero, jnp.zeros((), jnp.int32))
