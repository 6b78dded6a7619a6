"""What the actor objective adds to PPO (4.4): the last two terms of Eq. 9, behind the provenance gate."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ppo_dap.config import ObjectiveConfig
from ppo_dap.dap.proposals import Proposals
from ppo_dap.nets.actor import Actor, gaussian_kl, log_prob
from ppo_dap.ppo.surrogate import normalise, weighted_mean
from ppo_dap.ppo.update import Rows

SAME_STATE = 1e-3
"""Largest difference of a normalised observation to the one that it is."""


class Weights(NamedTuple):
    """Weights of Eq. 9 in this iteration."""

    lambda_kl: Float[Array, ""]
    lambda_aux: Float[Array, ""]
    lambda_awr: Float[Array, ""]


def weights_left(env_steps: int, flat: Mapping[str, Any]) -> float:
    """Factor of all weights of Eq. 9 after `env_steps`: linear from 1 to 0 at the first of both ends of the decay.

    Args:
        flat: The run's settings by name (`config.flatten`); an end that an earlier version did not know is none.
    """
    steps, limit = flat["steps"], flat.get("lambda_decay_steps")
    shares = flat.get("lambda_decay"), None if limit is None else limit / steps
    end = min((share for share in shares if share is not None), default=None)
    return 1.0 if end is None else max(0.0, 1 - min(1.0, env_steps / steps) / end)


def regained_std(flat: Mapping[str, Any]) -> float:
    """Least standard deviation that the policy goes on with after the weights of Eq. 9; 0 leaves it what it is.

    `std_after` times the share of the weights' time that `lambda_decay_steps` cut off: a run that is long beside what
    it was guided for has to explore again, and one that was guided for all of `lambda_decay` has not.
    """
    limit = flat["lambda_decay_steps"]
    if limit is None:
        return 0.0
    return flat["std_after"] * max(0.0, 1 - limit / ((flat["lambda_decay"] or 1.0) * flat["steps"]))


class GatedProposals(eqx.Module):
    """Proposals with the gate that each has passed (1) or not (0)."""

    proposals: Proposals
    gate: Float[Array, " n"]


class Batch(NamedTuple):
    """D_on of the current iteration as the gate knows it."""

    first_id: Int[Array, ""]
    """state_id that its first row must have, from the learner's own count of iterations: an old batch has others."""
    raw_observations: Float[Array, "rows obs"]
    weights: Float[Array, " rows"]
    observations: Float[Array, "rows obs"]
    """The same as the policy sees them."""


def provenance(
    state_ids: Int[Array, " n"],
    raw_observations: Float[Array, "n obs"],
    batch: Batch,
    observations: Float[Array, "n obs"] | None = None,
) -> Float[Array, " n"]:
    """1 for every (state_id, state) that is a row of D_on with weight, else 0: id and state must both match, and where
    they are given also the normalised `observations`.
    """
    row = state_ids - batch.first_id
    inside = (row >= 0) & (row < batch.weights.shape[0])
    row = jnp.where(inside, row, 0)
    same_state = jnp.all(batch.raw_observations[row] == raw_observations, axis=-1)
    if observations is not None:  # normalised by another program than the batch, which may round otherwise
        same_state &= jnp.all(jnp.abs(batch.observations[row] - observations) < SAME_STATE, axis=-1)
    return (inside & same_state & (batch.weights[row] > 0)).astype(jnp.float32)


def admit(rows: Rows, batch: Batch) -> Rows:
    """`rows` with weight only where they are of D_on: what every actor gradient is computed from."""
    gate = provenance(rows.state_ids, rows.raw_observations, batch)
    return eqx.tree_at(lambda r: r.weights, rows, rows.weights * gate)


def admit_proposals(proposals: Proposals, batch: Batch) -> GatedProposals:
    """Proposals with the gate of their states, both as the prior saw them and as the policy does."""
    gate = provenance(proposals.state_ids, proposals.raw_observations, batch, proposals.observations)
    return GatedProposals(proposals, gate)


def proposal_terms(
    actor: Actor, gated: GatedProposals, weights: Weights, std_floor: float = 0.0
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """The last two terms of Eq. 9, to be minimised, as means over the gated states.

    lambda_KL E[KL(pi || proxy)] + lambda_aux E[-log pi(a | s)]. Proposals and proxy are numbers here: no gradient
    can reach the prior. A standard deviation of the policy at or below `std_floor` is a number too.
    """
    log_std = jnp.where(jnp.exp(actor.log_std) > std_floor, actor.log_std, jax.lax.stop_gradient(actor.log_std))
    proposals, gate = jax.lax.stop_gradient((gated.proposals, gated.gate))
    means = actor(proposals.observations)
    kl = gaussian_kl(means, log_std[None], proposals.proxy_mean, jnp.log(proposals.proxy_std))
    kl_loss = weighted_mean(kl, gate)
    repeated = jnp.broadcast_to(means[:, None, :], proposals.actions.shape)
    nll = -jnp.mean(log_prob(proposals.actions, repeated, log_std), axis=1)
    aux_loss = weighted_mean(nll, gate)
    loss = weights.lambda_kl * kl_loss + weights.lambda_aux * aux_loss
    return loss, {"kl_loss": kl_loss, "aux_loss": aux_loss}


def advantage_weighted_loss(actor: Actor, rows: Rows, temperature: float, weight_cap: float) -> Float[Array, ""]:
    """PPO + AWR/AWAC-aux (Table 3): E[-min(exp(A / tau), cap) log pi(a | s)] on the policy's own rows.

    Advantages are standardised over the rows, as in AWR (Peng et al., 2019).
    """
    standardised = normalise(rows.advantages, rows.weights)
    importance = jax.lax.stop_gradient(jnp.minimum(jnp.exp(standardised / temperature), weight_cap))
    means = actor(rows.observations)
    actions = jnp.where(rows.weights[:, None] > 0, rows.actions, jax.lax.stop_gradient(means))
    return -weighted_mean(importance * log_prob(actions, means, actor.log_std), rows.weights)


def added_terms(
    actor: Actor, rows: Rows, gated: GatedProposals | tuple[()], weights: Weights, *, config: ObjectiveConfig
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """All that a method adds to PPO's objective, to be minimised; without proposals (`()`) their terms are left out."""
    loss, metrics = jnp.zeros(()), {}
    if not isinstance(gated, tuple):
        loss, metrics = proposal_terms(actor, gated, weights, config.std_floor)
    if config.lambda_awr > 0:
        metrics["awr_loss"] = advantage_weighted_loss(actor, rows, config.awr_temperature, config.awr_weight_cap)
        loss = loss + weights.lambda_awr * metrics["awr_loss"]
    return loss, metrics


def added_gradient(
    actor: Actor, rows: Rows, gated: GatedProposals | tuple[()], weights: Weights, *, config: ObjectiveConfig
) -> tuple[Actor, dict[str, Float[Array, ""]]]:
    """Gradient of `added_terms` in the actor's parameters: what is added to PPO's."""
    return jax.grad(partial(added_terms, config=config), has_aux=True)(actor, rows, gated, weights)
