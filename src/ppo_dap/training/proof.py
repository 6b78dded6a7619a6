"""The static part of the audit: the data flow of the very update that a run calls, traced once at its start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ppo_dap.config import Config
from ppo_dap.dap import audit
from ppo_dap.dap.dataflow import trace
from ppo_dap.dap.guide import GuideState
from ppo_dap.dap.objective import Weights
from ppo_dap.nets.arrays import on_device
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, PPOState, Settings
from ppo_dap.training.algorithm import Frozen, Learner, Schedule, Stages, call, iterate
from ppo_dap.training.draws import draw, num_parts


def prove(
    learner: Learner, frozen: Frozen | None, config: Config, stages: Stages, run: Callable[..., Any] = call
) -> list[audit.Claim]:
    """Claims of Definition 1 about the traced update of this learner; nothing is executed.

    What an iteration hands to the next is named by the same groups as what it was given, optimizers with what they
    move: what is proved of one iteration is then proved of all. `run` is told of every stage as it is traced.
    """
    sizes = learner.ppo.actor.mlp.layers[0].weight.shape[1], learner.ppo.actor.log_std.shape[0]
    arguments: dict[str, Any] = {
        "actor": (learner.ppo.actor, learner.ppo.actor_optimizer),
        "critic": (learner.ppo.critic, learner.ppo.critic_optimizer),
        "on_policy": (example_rollout(config, *sizes), np.float32(1)),
        "normaliser": Normaliser(np.zeros(sizes[0], np.float32), np.ones(sizes[0], np.float32)),  # type: ignore[arg-type]
        "schedule": example_schedule(stages.adds),
        "draws": draw(config, 0, None if frozen is None else frozen.prior),
        "previous": learner.previous,
    }
    if learner.guide is not None and frozen is not None:
        guide = learner.guide
        arguments |= {
            "q": (guide.q, guide.q_optimizer, guide.q_spread, guide.q_rank, guide.calibration, guide.judged),
            "adapters": (guide.adapters, guide.pet_optimizer),
            "backbone": (frozen.prior, frozen.condition),
            "offline": frozen.probe,
        }

    def whole_update(*, actor, critic, on_policy, normaliser, schedule, draws, previous, **guided):
        guide = None
        if guided:
            guide = GuideState(*guided["q"], *guided["adapters"])
        rollout, reward_std = on_policy
        new, _ = iterate(
            Learner(PPOState(actor[0], critic[0], actor[1], critic[1]), guide, previous),
            Frozen(*guided["backbone"], probe=guided["offline"]) if guided else None,
            rollout,
            normaliser,
            lambda: reward_std,
            schedule,
            draws,
            stages,
            run,
        )
        ppo, g = new.ppo, new.guide
        results = {"actor": (ppo.actor, ppo.actor_optimizer), "critic": (ppo.critic, ppo.critic_optimizer)}
        results["rest"] = (ppo.actor_optimizer, ppo.critic_optimizer, g, new.previous)
        return results if g is None or g.adapters is None else results | {"adapters": (g.adapters, g.pet_optimizer)}

    traced = trace(whole_update, arguments)
    return audit.static_claims(lambda cut: traced.flow(sources=("proposals",), cuts=(cut,) if cut else ()))


def example_rollout(config: Config, observation_size: int, action_size: int) -> list[Rollout]:
    """A rollout of zeros, for tracing; numpy's, as a collector's are."""
    envs, parts = config.ppo.num_envs, num_parts(config)
    grid = (config.ppo.rollout_steps // envs // parts, envs)
    sizes = {"observations": observation_size, "next_observations": observation_size}
    sizes |= {"actions": action_size, "means": action_size}
    wide = {name: np.zeros((*grid, size), np.float32) for name, size in sizes.items()}
    flags = {name: np.zeros(grid, bool) for name in ("terminated", "truncated", "valid")}
    scalars = {name: np.zeros(grid, np.float32) for name in ("log_probs", "rewards")}
    return [Rollout(state_ids=np.zeros(grid, np.int32), **wide, **flags, **scalars)] * parts  # type: ignore[arg-type]


def example_schedule(added: bool) -> Schedule:
    """A schedule of zeros, for tracing."""
    zero, none = on_device(0), on_device(0, np.int32)
    settings = Settings(zero, zero, on_device(added, bool), Weights(zero, zero, zero) if added else ())
    return Schedule(none, settings, zero, none)
