"""A retrieval prior (2.3): the logged actions of the nearest logged states, found by an exact search.

Sizes: n states, k actions a state, act action dimensions, obs observation dimensions, c numbers of condition, rows kept
in memory. Nothing is trained and nothing is drawn: the same state always gets the same actions.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ppo_dap.errors import InputError
from ppo_dap.nets.adapters import Adapters
from ppo_dap.prior_config import RetrievalConfig
from ppo_dap.priors.network import Rows
from ppo_dap.priors.samplers import Field, Solver

BLOCK = 64
"""Rows of which a search first keeps the nearest one alone."""
CHUNK = 256 * BLOCK
"""Rows that are compared with all states at once, so that their distances stay in the processor's cache."""
CLIP = 10.0
"""Of whitened states, as in the other priors: beyond it nearness means nothing, and float32 loses what there is."""
FAR = 1e4
"""Where the rows lie that fill up the last chunk: beyond all others, which the clip keeps near."""
SMALLEST_VARIANCE = 1e-4
"""Of a direction of the covariance over that of the widest: narrower ones are rounding and do not count."""
HELD_OUT_ROWS = 512
HELD_OUT_NEIGHBOURS = 10


class Memory(eqx.Module):
    """Whitened states with the actions that were logged there.

    A key is a whitened state, its half squared norm and, with a condition, the weighted return and half its square: so
    the half squared distance to a query, less what is the query's alone, is one product with it.
    """

    keys: Float[Array, "chunks chunk key"]
    actions: Float[Array, "rows act"]
    observation_mean: Float[Array, " obs"]
    whitener: Float[Array, "obs obs"]
    config: RetrievalConfig = eqx.field(static=True)

    @staticmethod
    def build(
        train: Rows, held_out: Rows, config: RetrievalConfig, rng: np.random.Generator
    ) -> tuple[Memory, dict[str, Any]]:
        """A memory of `train`, or of `max_rows` of it. The summary's `validation_loss` is the mean squared distance of
        held-out actions from the mean of their neighbours'.
        """
        start = time.perf_counter()
        of_rows = train.actions.shape[0]
        picked = np.sort(rng.permutation(of_rows)[: config.max_rows])
        observations, condition, actions = (np.asarray(a)[picked] for a in train)
        mean, whitener = _whitening(observations, config)
        states = np.clip((observations - mean) @ whitener, -CLIP, CLIP)
        memory = Memory(
            keys=jnp.asarray(_keys(states, config.return_weight * condition[:, :1])),
            actions=jnp.asarray(actions),
            observation_mean=jnp.asarray(mean),
            whitener=jnp.asarray(whitener),
            config=config,
        )
        looked_at = rng.permutation(held_out.actions.shape[0])[:HELD_OUT_ROWS]
        observations, condition, actions = (a[looked_at] for a in held_out)
        near = _neighbours(memory, observations, condition, min(HELD_OUT_NEIGHBOURS, len(picked)))
        errors = jnp.sum(jnp.square(jnp.mean(near, axis=1) - actions), axis=-1)
        summary = {
            "rows": len(picked),
            "of_rows": of_rows,
            "steps": 0,
            "validation_loss": float(jnp.mean(errors)),
            "seconds": round(time.perf_counter() - start, 2),
        }
        return memory, summary

    @staticmethod
    def blank(config: RetrievalConfig, tensors: Mapping[str, np.ndarray]) -> Memory:
        """The shapes of a saved one; how many rows it has its actions alone say."""
        size, rows = tensors["probe_observations"].shape[1], len(tensors.get("network.actions", ()))

        def zeros() -> Memory:
            return Memory(
                keys=jnp.zeros((*_layout(rows), size + 1 + config.num_conditions)),
                actions=jnp.zeros((rows, tensors["action_low"].shape[0])),
                observation_mean=jnp.zeros(size),
                whitener=jnp.zeros((size, size)),
                config=config,
            )

        return jax.eval_shape(zeros)

    def noise_shape(self, solver: Solver, states: int, num: int) -> tuple[int, ...]:
        """No noise: what is left of its shape says how many actions there are to be."""
        return (states, num, 0)

    def sample(
        self,
        observations: Float[Array, "n obs"],
        condition: Float[Array, "n c"],
        noise: Float[Array, "n k 0"],
        solver: Solver,
        adapters: Adapters | None = None,
        drift: Field | None = None,
        displacement_cap: float | None = None,
    ) -> tuple[Float[Array, "n k act"], Float[Array, "n k"]]:
        """The actions of the k nearest rows, nearest first and no row twice; nothing guides them.

        Raises `InputError` where there are fewer than k rows.
        """
        states, num = noise.shape[:2]
        nearest = self.nearest(observations, condition, num)
        return self.actions[nearest], jnp.zeros((states, num), jnp.float32)

    def nearest(
        self, observations: Float[Array, "n obs"], condition: Float[Array, "n c"], num: int
    ) -> Int[Array, "n {num}"]:
        """The `num` nearest rows of each state, exactly (up to float32's rounding between rows equally near).

        The rows' blocks are told apart by their nearest row. The `num` nearest rows lie in the `num` nearest blocks:
        a row of any other block has a nearer one in each of these. So only they are looked at row by row.
        """
        if num > self.actions.shape[0]:
            raise InputError(f"{num} proposals a state asked of a retrieval prior with {self.actions.shape[0]} rows")
        shape = observations.shape
        states = jnp.clip((observations - jnp.broadcast_to(self.observation_mean, shape)) @ self.whitener, -CLIP, CLIP)
        ones = jnp.ones((shape[0], 1))
        # A return that is not known is left out of the distance.
        known = condition[:, 1:]
        returns = self.config.return_weight * condition[:, :1]
        query = jnp.concatenate([-states, ones, -known * returns, known], axis=1)

        def nearest_of_blocks(_, chunk):
            return None, jnp.min((query @ chunk.T).reshape(shape[0], -1, BLOCK), axis=-1)

        _, minima = jax.lax.scan(nearest_of_blocks, None, self.keys)
        minima = jnp.moveaxis(minima, 0, 1).reshape(shape[0], -1)
        _, blocks = jax.lax.top_k(-minima, min(num, minima.shape[1]))
        rows = self.keys.reshape(-1, BLOCK, self.keys.shape[-1])[blocks].reshape(shape[0], -1, self.keys.shape[-1])
        # From the differences themselves, which unlike the product keep their digits between rows that lie close.
        size = shape[1]
        distances = jnp.sum(jnp.square(rows[..., :size] - states[:, None]), axis=-1)
        apart = known[:, None] * jnp.square(rows[..., size + 1 : -1] - returns[:, None])
        _, places = jax.lax.top_k(-(distances + jnp.sum(apart, axis=-1)), num)
        return jnp.take_along_axis(blocks, places // BLOCK, axis=1) * BLOCK + places % BLOCK


@eqx.filter_jit
def _neighbours(memory, observations, condition, num):
    return memory.actions[memory.nearest(observations, condition, num)]


def _whitening(
    observations: Float[np.ndarray, "rows obs"], config: RetrievalConfig
) -> tuple[Float[np.ndarray, " obs"], Float[np.ndarray, "obs obs"]]:
    """Mean, and what turns a state less it (as a row) into one with spread 1; what never changes is left as it is."""
    wide = observations.astype(np.float64)
    mean, std = wide.mean(0), wide.std(0)
    spread = np.where(std > 1e-6, std, 1.0)
    if config.whitening == "columns":
        return mean.astype(np.float32), np.diag(1 / spread).astype(np.float32)
    standard = (wide - mean) / spread
    variances, directions = np.linalg.eigh(standard.T @ standard / len(standard))
    counts = variances > SMALLEST_VARIANCE * max(variances[-1], 1e-12)
    scales = np.where(counts, 1 / np.sqrt(np.where(counts, variances, 1.0)), 0.0)
    return mean.astype(np.float32), (directions * scales / spread[:, None]).astype(np.float32)


def _layout(rows: int) -> tuple[int, int]:
    """(chunks, chunk): few rows are one chunk of whole blocks."""
    chunk = min(CHUNK, max(-(-rows // BLOCK), 1) * BLOCK)
    return max(-(-rows // chunk), 1), chunk


def _keys(
    states: Float[np.ndarray, "rows obs"], returns: Float[np.ndarray, "rows returns"]
) -> Float[np.ndarray, "chunks chunk key"]:
    chunks, chunk = _layout(len(states))
    filled = np.full((chunks * chunk, states.shape[1]), FAR, np.float32)
    filled[: len(states)] = states
    weighted = np.zeros((chunks * chunk, returns.shape[1]), np.float32)
    weighted[: len(states)] = returns
    halves = np.sum(np.square(filled), axis=1, keepdims=True) / 2
    return np.concatenate([filled, halves, weighted, np.square(weighted) / 2], axis=1).reshape(chunks, chunk, -1)
