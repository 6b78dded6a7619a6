"""`Guide`: the method for any other PPO, through arrays alone."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from ppo_dap import config as configs
from ppo_dap.dap.adaptation import PETDraws, is_tuned, steps_until
from ppo_dap.dap.guidance import beta_schedule
from ppo_dap.dap.guide import (
    GuideState,
    OnPolicy,
    Visited,
    adapt_prior,
    create_guide,
    gate_proposals,
    learn_q,
    make_proposals,
    num_proposal_states,
)
from ppo_dap.dap.objective import Batch
from ppo_dap.dap.proposals import ProposalDraws, Proposals
from ppo_dap.errors import InputError
from ppo_dap.methods import METHODS, resolve
from ppo_dap.nets.normalizer import RunningMoments
from ppo_dap.nets.policy import scale_actions
from ppo_dap.ppo.update import draw_orders
from ppo_dap.priors import Prior, load_prior

_WITHOUT_OUR_PPO = {
    "q_target": "td", "q_calibration": "none", "guidance_gate": False, "mode_seeking": 0.0, "std_floor": 0.0,
    "std_after": 0.0, "warm_start": "none", "q_warm_start": False,
}  # fmt: skip
"""What needs the advantages, the policy or the logs. A Guide is given none, and uses a preset that has it without."""


class Guide:
    """Value-guided proposals of a prior for a PPO in any framework.

    Call it once an iteration with the on-policy batch. It fits its own Q to the batch (one-step TD), adapts the prior
    to it (PET), and returns `Proposals` on a random subset of the batch's states: arrays, so no gradient can pass. Add
    `lambda_kl * KL(pi || N(proxy_mean, proxy_std)) + lambda_aux * mean(-log pi(actions))` to the policy's loss on those
    states (Eq. 9), and nothing to ratios or advantages. Everything is in environment units.
    """

    def __init__(self, prior: Prior | str | Path, *, total_iterations: int, preset: str = "paper", **options: Any):
        """`prior`, or its file; `total_iterations` of the run, for the annealing of beta; `options` are fields of
        `Config` by name.

        Q has a trunk of its own here, since this PPO's value network is not ours to read. What a preset has of the
        policy is left out, since that is not ours either: `mode_seeking`, `guidance_gate`, `std_floor`,
        `std_after`, and `initial_std`, for which `prior.spread()` has the number.
        """
        if not isinstance(total_iterations, int) or total_iterations < 1:
            raise InputError(f"total_iterations must be a whole number above 0, not {total_iterations!r}")
        prior = prior if isinstance(prior, Prior) else load_prior(prior)
        given = options | {"q_trunk": "separate"}
        for name, right in _WITHOUT_OUR_PPO.items():
            if given.get(name, right) != right:
                raise InputError(f"{name} {given[name]!r} needs this package's own PPO: a Guide has {right!r}")
        given |= _WITHOUT_OUR_PPO
        self.config = resolve(METHODS["ppo-dap"], configs.make(preset, **given), given, prior.kind)
        self.prior, self.iteration, self._total = prior, 0, total_iterations
        self._condition = jnp.asarray(prior.condition(self.config.proposals.prior_return))
        self._moments = RunningMoments.create(prior.observation_size)
        self._rewards = RunningMoments.create(1)
        rng = np.random.default_rng(self.config.run.seed)
        sizes = (prior.observation_size, prior.action_size)
        self._state = create_guide(rng, None, sizes, self.config, prior.network)
        self._propose = jax.jit(partial(make_proposals, config=self.config))
        self._gate = jax.jit(gate_proposals)
        self._learn_q = jax.jit(partial(learn_q, config=self.config))
        self._adapt = jax.jit(partial(adapt_prior, config=self.config))
        self.metrics: dict[str, float] = {}
        """Of the last call: ess, spr, q_loss, pet_loss, pet_spr, adapter_norm and others."""

    def __call__(
        self,
        *,
        observations: ArrayLike,
        actions: ArrayLike,
        rewards: ArrayLike,
        next_values: ArrayLike,
        terminated: ArrayLike,
        valid: ArrayLike | None = None,
    ) -> Proposals:
        """Proposals for one on-policy batch of n rows.

        observations (n, obs) raw; actions (n, act) as executed; rewards (n,); next_values (n,): this PPO's V at the
        true next observations, in the rewards' units; terminated (n,) bool, False at truncations; valid (n,) bool,
        False for rows in which no transition happened. `state_ids` of the result count the rows of this batch.

        Raises `InputError` for arrays of other shapes or with NaN.
        """
        rows, batch = self._rows(observations, actions, rewards, next_values, terminated, valid)
        progress = self.iteration / self._total
        updates = self.config.ppo.num_epochs * len(rows.weights) // self.config.ppo.minibatch_size
        rng = np.random.default_rng([self.config.run.seed, self.iteration])
        n, proposals = len(rows.weights), self.config.proposals
        beta = beta_schedule(progress, self.config.proposals.beta_max, self.config.proposals.beta_anneal)
        network, state = self.prior.network, self._state
        draws = ProposalDraws.make(rng, n, num_proposal_states(n, 1, self.config), network, proposals)
        visited = Visited(rows.state_ids, rows.raw_observations, rows.observations, rows.weights)
        proposer = state.proposer(network, self._condition, None, None)
        proposed = self._propose(proposer, visited, jnp.asarray(beta, jnp.float32), draws)
        gated, spread, of_proposals = self._gate(state, [proposed], batch)
        learned = self._learn_q(state, None, None, rows, draw_orders(rng, self.config.q.q_epochs, n))
        adapters, optimizer, adapted = state.adapters, state.pet_optimizer, {}
        if adapters is not None and is_tuned(network, self.config.adaptation):
            frequency = self.config.adaptation.pet_frequency
            due = [steps_until(i, frequency, updates) for i in (self.iteration, self.iteration + 1)]
            pet = PETDraws.make(rng, network, updates, self.config.adaptation)
            adapters, optimizer, adapted = self._adapt(
                state, network, rows, batch, jnp.asarray(due[1] - due[0], jnp.int32), pet
            )
        self._state = GuideState(learned.q, learned.optimizer, spread, learned.q_rank, None, None, adapters, optimizer)
        self._moments = self._moments.update(np.asarray(rows.raw_observations)[np.asarray(rows.weights) > 0])
        self.iteration += 1
        self.metrics = {name: float(v) for name, v in (of_proposals | learned.metrics | adapted).items()}
        # Rows in which no transition happened can fill up the subset; nobody else would know them from the others.
        kept = np.flatnonzero(np.asarray(gated.gate))
        return self._in_environment_units(jax.tree.map(lambda x: x[kept], gated.proposals))

    def _rows(self, observations, actions, rewards, next_values, terminated, valid) -> tuple[OnPolicy, Batch]:
        prior, ppo = self.prior, self.config.ppo
        observations = _checked("observations", observations, (None, prior.observation_size))
        n = len(observations)
        if n < ppo.minibatch_size:
            raise InputError(f"a batch of {n} rows is smaller than minibatch_size {ppo.minibatch_size}")
        if n % ppo.minibatch_size:
            raise InputError(f"a batch of {n} rows must be a multiple of minibatch_size {ppo.minibatch_size}")
        actions = _checked("actions", actions, (n, prior.action_size))
        rewards, next_values = _checked("rewards", rewards, (n,)), _checked("next_values", next_values, (n,))
        ended = _flags("terminated", terminated, n) > 0
        weights = np.ones(n, np.float32) if valid is None else _flags("valid", valid, n)
        # Q's targets are scaled to spread 1, as PPO's scaled rewards would make them: guidance strengths mean the same.
        targets = rewards + ppo.gamma * np.where(ended, 0.0, next_values)
        self._rewards = self._rewards.update(targets[weights > 0][:, None])
        normalised = np.clip((observations - self._moments.mean) / self._moments.std, -10.0, 10.0)
        scaled = scale_actions(actions, prior.action_low, prior.action_high)
        ids = jnp.arange(n, dtype=jnp.int32)
        rows = OnPolicy(
            ids,
            jnp.asarray(observations),
            jnp.asarray(normalised, jnp.float32),
            jnp.asarray(np.clip(scaled, -1.0, 1.0), jnp.float32),
            jnp.asarray(targets / float(self._rewards.std[0]), jnp.float32),
            jnp.asarray(weights),
        )
        return rows, Batch(ids[0], rows.raw_observations, rows.weights, rows.observations)

    def _in_environment_units(self, proposals: Proposals) -> Proposals:
        half = jnp.asarray((self.prior.action_high - self.prior.action_low) / 2)
        centre = jnp.asarray((self.prior.action_high + self.prior.action_low) / 2)
        mean, std, actions = proposals.proxy_mean, proposals.proxy_std, proposals.actions
        return Proposals(
            proposals.state_ids,
            proposals.raw_observations,
            proposals.raw_observations,
            actions * half[None, None] + centre[None, None],
            mean * half[None] + centre[None],
            std * half[None],
        )


def _checked(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as float32 of the given shape (None: any), or an `InputError` that says what is wrong with it."""
    wanted = str(tuple("n" if want is None else want for want in shape)).replace("'", "")
    try:
        array = np.asarray(value, dtype=np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{name} is a {type(value).__name__}, should be numbers of shape {wanted}") from None
    if array.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
    ):
        raise InputError(f"{name} has shape {array.shape}, should have {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} has NaN or infinite entries")
    return array


def _flags(name: str, value: ArrayLike, n: int) -> np.ndarray:
    """`value` as n numbers that are 0 or 1."""
    array = _checked(name, value, (n,))
    if (wrong := array[(array != 0) & (array != 1)]).size:
        raise InputError(f"{name} has {wrong[0]:g}, should be False or True in every row")
    return array
