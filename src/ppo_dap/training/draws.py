"""All random numbers of an iteration's update, drawn on the host: functions of (seed, iteration) and nothing else.

Jitted stages are deterministic functions of arrays. numpy draws normal numbers several times as fast as XLA on a CPU,
in the time that the host would spend waiting for the actor.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ppo_dap.config import Config
from ppo_dap.dap.adaptation import PETDraws, is_tuned
from ppo_dap.dap.audit import PROXY_SOLVER, PROXY_STATES
from ppo_dap.dap.guide import num_proposal_states
from ppo_dap.dap.proposals import ProposalDraws
from ppo_dap.ppo.update import Orders, draw_orders
from ppo_dap.priors.network import Network

PARTS = 8
"""Most parts of a rollout: proposals on each are computed while the next is collected."""
PPO_STREAM, GUIDE_STREAM, REUSE_STREAM = 3, 4, 7


class Draws(NamedTuple):
    """Random numbers of one iteration; those of the guide are empty for plain PPO."""

    actor: Orders
    critic: Int[np.ndarray, "epochs rows"]
    proposals: tuple[ProposalDraws, ...] = ()
    q: Any = ()
    pet: Any = ()
    audit: Any = ()
    reuse: Any = ()
    """Orders of the candidate that uses the previous batch again."""


def num_parts(config: Config) -> int:
    """Parts into which a rollout is cut, all of one length."""
    return math.gcd(PARTS, config.ppo.rollout_steps // config.ppo.num_envs)


def draw(config: Config, iteration: int, prior: Network | None) -> Draws:
    """The draws of an iteration. PPO's have a stream of their own: a guide with its prior does not change them."""
    ppo, rows = config.ppo, config.ppo.rollout_steps
    rng = np.random.default_rng([config.run.seed, PPO_STREAM, iteration])
    actor, critic = (draw_orders(rng, ppo.num_epochs, rows) for _ in range(2))
    if prior is None:
        nothing = np.zeros((ppo.num_epochs, 0), np.int32)
        return Draws(Orders(actor, nothing), critic, reuse=_reuse(config, iteration, 0))  # type: ignore[arg-type]
    rng = np.random.default_rng([config.run.seed, GUIDE_STREAM, iteration])
    parts = num_parts(config)
    states = num_proposal_states(rows, parts, config)
    few, k = min(PROXY_STATES, states), config.proposals.num_proposals
    updates = ppo.num_epochs * rows // ppo.minibatch_size
    return Draws(
        Orders(actor, draw_orders(rng, ppo.num_epochs, states)),  # type: ignore[arg-type]
        critic,
        tuple(ProposalDraws.make(rng, rows // parts, states // parts, prior, config.proposals) for _ in range(parts)),
        draw_orders(rng, config.q.q_epochs, rows),
        PETDraws.make(rng, prior, updates, config.adaptation) if is_tuned(prior, config.adaptation) else (),
        rng.standard_normal(prior.noise_shape(PROXY_SOLVER, few, k), dtype=np.float32),
        _reuse(config, iteration, states),
    )


def _reuse(config: Config, iteration: int, added: int) -> Any:
    if not config.ppo.reuse_batches:
        return ()
    rng = np.random.default_rng([config.run.seed, REUSE_STREAM, iteration])
    return Orders(*(draw_orders(rng, config.ppo.num_epochs, n) for n in (config.ppo.rollout_steps, added)))  # type: ignore[arg-type]
