"""The Q head's one-step TD fit (4.4): a stage of its own, with its own optimizer, after PPO's update."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from ppo_dap.config import QConfig
from ppo_dap.nets.critic import Critic, QFunction, q_features
from ppo_dap.ppo.surrogate import weighted_mean
from ppo_dap.ppo.update import deal

ADAM: Any = optax.scale_by_adam(eps=1e-5)


class QData(eqx.Module):
    """Rows of D_on as Q's regression sees them; actions are scaled and clipped: what the environment executed."""

    observations: Float[Array, "rows obs"]
    actions: Float[Array, "rows act"]
    targets: Float[Array, " rows"]
    weights: Float[Array, " rows"]


def q_loss(q: QFunction, critic: Critic | None, rows: QData, shared: bool) -> Float[Array, ""]:
    """Mean squared error of Q(s, a) against its target, r + gamma (1 - terminated) V(s') in the paper; of all heads."""
    features = q_features(critic, q, rows.observations, shared)
    values = [head(features, rows.actions[:, None, :])[:, 0] for head in q.heads]
    return jnp.asarray(sum(weighted_mean(jnp.square(v - rows.targets), rows.weights) for v in values))


def rank_correlation(
    x: Float[Array, " rows"], y: Float[Array, " rows"], weights: Float[Array, " rows"]
) -> Float[Array, ""]:
    """Spearman's rho (5.7) over the rows with weight; 0 where one of the two does not vary."""

    def ranks(values):
        values = jnp.where(weights > 0, values, jnp.inf)
        # Equal values share the mean of their places: in the rows' order, Q that does not vary would rank by time.
        below, up_to = (jnp.searchsorted(jnp.sort(values), values, side=side) for side in ("left", "right"))
        return 0.5 * (below + up_to - 1).astype(jnp.float32)

    kept = (weights > 0).astype(jnp.float32)
    a, b = (kept * (r - weighted_mean(r, kept)) for r in (ranks(x), ranks(y)))
    return jnp.sum(a * b) / jnp.maximum(jnp.sqrt(jnp.sum(a * a) * jnp.sum(b * b)), 1e-8)


def trainable(q: QFunction, critic: Critic | None, config: QConfig) -> tuple:
    """What Q's gradient may move: Q, and with `q_trunk = "shared"` the value trunk as well."""
    return (q, critic.trunk) if critic is not None and config.q_trunk == "shared" else (q,)


def fit_q(
    q: QFunction,
    critic: Critic | None,
    optimizer: optax.OptState,
    rows: QData,
    orders: Int[Array, "epochs rows"],
    *,
    minibatch_size: int,
    config: QConfig,
) -> tuple[QFunction, Critic | None, optax.OptState, Float[Array, ""]]:
    """A pass over D_on in each of `orders`. The critic comes back as it was, except its trunk when it is shared."""
    num_minibatches = rows.targets.shape[0] // minibatch_size
    shared = config.q_trunk == "shared"

    def with_trunk(params):
        return eqx.tree_at(lambda c: c.trunk, critic, params[1]) if len(params) > 1 else critic

    def step(carry, batch):
        params, optimizer = carry
        loss, gradient = jax.value_and_grad(lambda p: q_loss(p[0], with_trunk(p), batch, shared))(params)
        updates, optimizer = ADAM.update(gradient, optimizer)
        params = jax.tree.map(lambda p, u: p - config.q_learning_rate * u, params, updates)
        return (params, optimizer), loss

    def epoch(carry, order):
        return jax.lax.scan(step, carry, deal(rows, order, num_minibatches))

    start = (trainable(q, critic, config), optimizer)
    (params, optimizer), losses = jax.lax.scan(epoch, start, orders)
    return params[0], with_trunk(params), optimizer, jnp.mean(losses)
