"""PPO-ARC (Cheng, Guo and Wang 2024), a reconstruction: PPO's update against one that uses the previous batch again.

Two candidates start from pi_k, with the optimizer steps of PPO each: PPO's own on D_k, and one on D_k and D_{k-1} with
half the weight each (`ppo_loss` with previous rows). The better one by a score on D_k is pi_{k+1}. Its old rows are not
of pi_k: whoever uses this is not strictly on-policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from ppo_dap.config import PPOConfig
from ppo_dap.nets.actor import Actor, gaussian_kl, log_prob
from ppo_dap.nets.critic import Critic
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.surrogate import normalise, weighted_mean
from ppo_dap.ppo.update import Normaliser, PreviousRows, Rows

REJECTED_AT = 2.0
"""A candidate whose KL from pi_k is above this many `kl_target` does not take part."""


class Candidate(NamedTuple):
    """What `improve_actor` returns."""

    actor: Actor
    optimizer: optax.OptState
    metrics: dict[str, Float[Array, ""]]


def no_batch(ppo: PPOConfig, observation_size: int, action_size: int) -> Rollout:
    """What stands for the previous batch in the first iteration: no row of it is valid."""
    grid = (ppo.rollout_steps // ppo.num_envs, ppo.num_envs)
    wide = {"observations": observation_size, "next_observations": observation_size}
    wide |= {"actions": action_size, "means": action_size}
    never = jnp.zeros(grid, bool)
    return Rollout(
        state_ids=jnp.full(grid, -1, jnp.int32),
        **{name: jnp.zeros((*grid, size)) for name, size in wide.items()},
        **{name: jnp.zeros(grid) for name in ("log_probs", "rewards")},
        **dict.fromkeys(("terminated", "truncated", "valid"), never),
    )


def remember(parts: Sequence[Rollout]) -> Rollout:
    """The batch that the next iteration uses again; `parts` follow each other in time."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def previous_rows(
    actor: Actor,
    critic: Critic,
    batch: Rollout,
    normaliser: Normaliser,
    reward_std: Float[Array, ""],
    *,
    ppo: PPOConfig,
) -> PreviousRows:
    """D_{k-1} under pi_k, the current V and the current statistics of observations and rewards."""

    def flat(x):
        return x.reshape(-1, *x.shape[2:])

    grid, weights = batch.rewards.shape, flat(batch.valid).astype(jnp.float32)
    observations = normaliser(flat(batch.observations), ppo.observation_clip)
    successors = normaliser(flat(batch.next_observations), ppo.observation_clip)
    actions, old_log_probs = flat(batch.actions), flat(batch.log_probs)
    log_probs = log_prob(actions, actor(observations), actor.log_std)
    centre = jnp.exp(jnp.where(weights > 0, log_probs - old_log_probs, 0.0))
    advantages = truncated_gae(
        jnp.clip(batch.rewards / reward_std, -ppo.reward_clip, ppo.reward_clip),
        critic(observations).reshape(grid),
        critic(successors).reshape(grid),
        batch.terminated,
        batch.truncated,
        batch.valid,
        centre.reshape(grid),
        ppo.gamma,
        ppo.gae_lambda,
    )
    return PreviousRows(
        state_ids=flat(batch.state_ids),
        raw_observations=flat(batch.observations),
        observations=observations,
        actions=actions,
        old_log_probs=old_log_probs,
        centre=centre,
        advantages=checkpoint_name(flat(advantages), "advantages"),
        weights=weights,
    )


def truncated_gae(
    rewards: Float[Array, "time envs"],
    values: Float[Array, "time envs"],
    next_values: Float[Array, "time envs"],
    terminated: Bool[Array, "time envs"],
    truncated: Bool[Array, "time envs"],
    valid: Bool[Array, "time envs"],
    ratio: Float[Array, "time envs"],
    gamma: float,
    gae_lambda: float,
) -> Float[Array, "time envs"]:
    """GAE of pi_k on rows of an older policy mu: a later temporal difference counts by the product of min(1, ratio)
    over the actions between, `ratio` = pi_k / mu (V-trace, Espeholt et al. 2018, truncated at 1). For a ratio of 1 it
    is `gae`. The row's own ratio is not in it: the surrogate has it. Rows that are not `valid` get 0.
    """
    deltas = rewards + gamma * jnp.where(terminated, 0.0, next_values) - values
    carries_on = ~(terminated | truncated)

    def backwards(traced, row):
        delta, carry_on, is_valid, trace = row
        advantage = delta + gamma * gae_lambda * jnp.where(carry_on, traced, 0.0)
        advantage = jnp.where(is_valid, advantage, 0.0)
        return trace * advantage, advantage

    columns = (deltas, carries_on, valid, jnp.minimum(ratio, 1.0))
    _, advantages = jax.lax.scan(backwards, jnp.zeros_like(values[0]), columns, reverse=True)
    return advantages


def contest(
    old_log_std: Float[Array, " act"], own: Candidate, reused: Candidate, rows: Rows, previous: PreviousRows,
    *, ppo: PPOConfig,
) -> tuple[Candidate, Bool[Array, ""], dict[str, Float[Array, ""]]]:  # fmt: skip
    """pi_{k+1}: the candidate with the higher `score` on D_k; whether that is `reused`; scores and KLs.

    A candidate with too large a KL from pi_k is rejected; `own` stands if both are, and while there is no previous row.
    """
    scores, kls = zip(*(score(c.actor, old_log_std, rows, ppo) for c in (own, reused)), strict=True)
    passes = [kl <= REJECTED_AT * ppo.kl_target for kl in kls]
    won = jnp.any(previous.weights > 0) & passes[1] & (~passes[0] | (scores[1] > scores[0]))
    winner: Any = jax.tree.map(lambda a, b: jnp.where(won, b, a), own, reused)
    metrics = {"arc_reused": won.astype(jnp.float32)}
    metrics |= {"arc_score_ppo": scores[0], "arc_score_reuse": scores[1]}
    return winner, won, metrics | {"arc_kl_ppo": kls[0], "arc_kl_reuse": kls[1]}


def score(
    actor: Actor, old_log_std: Float[Array, " act"], rows: Rows, ppo: PPOConfig
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """E[r A] - beta KL on D_k, and that KL(pi_k || pi). A is normalised over D_k: beta means the same on every task."""
    means, seen = actor(rows.observations), rows.weights > 0
    log_ratio = log_prob(rows.actions, means, actor.log_std) - rows.old_log_probs
    gain = jnp.exp(jnp.where(seen, log_ratio, 0.0)) * normalise(rows.advantages, rows.weights)
    kls = gaussian_kl(rows.old_means, old_log_std[None], means, actor.log_std[None])
    kl = weighted_mean(jnp.where(seen, kls, 0.0), rows.weights)
    return weighted_mean(gain, rows.weights) - ppo.contest_kl_weight * kl, kl
