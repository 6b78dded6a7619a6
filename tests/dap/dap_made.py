"""A world small enough to trace and run in seconds: networks of width 8, 64 rows, K = 3."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from ppo_dap.config import make
from ppo_dap.dap.audit import Probe
from ppo_dap.dap.objective import Weights
from ppo_dap.nets.critic import QFunction, QHead
from ppo_dap.nets.mlp import Linear
from ppo_dap.ppo.rollout import Rollout
from ppo_dap.ppo.update import Normaliser, Settings
from ppo_dap.prior_config import DiffusionConfig
from ppo_dap.priors.diffusion import Denoiser
from ppo_dap.training import algorithm
from ppo_dap.training.algorithm import Frozen, Schedule, create_learner
from ppo_dap.training.draws import draw, num_parts

OBS, ACT, TIME, ENVS = 3, 2, 16, 4
ROWS = TIME * ENVS
DIFFUSION = DiffusionConfig(width=8, depth=2)
NORMALISER = Normaliser(jnp.zeros(OBS), jnp.ones(OBS))
REWARD_STD = jnp.ones(())
_SMALL = {
    "num_envs": ENVS, "rollout_steps": ROWS, "minibatch_size": 16, "num_epochs": 2, "hidden_size": 8,
    "q_hidden_size": 8, "num_proposals": 3, "sampler_steps": 2, "pet_minibatch_size": 16, "adapter_rank": 2,
    "proposal_fraction": 0.25,
}  # fmt: skip


def small_config(**options):
    return make("paper", **{**_SMALL, **options})


def filled(create, seed, scale=0.5):
    """The module that `create(rng)` makes, with random numbers of spread `scale`: nothing to compile."""
    shapes, rng = jax.eval_shape(lambda: create(np.random.default_rng(0))), np.random.default_rng(seed)
    return jax.tree.map(lambda s: jnp.asarray(scale * rng.standard_normal(s.shape), jnp.float32), shapes)


@functools.cache
def small_denoiser():
    moments = jnp.zeros(OBS), jnp.ones(OBS), jnp.asarray(0.5)
    fresh = filled(lambda rng: Denoiser.create(rng, DIFFUSION, *moments, ACT), 5, 0.2)
    return changed(fresh, observation_mean=moments[0], observation_std=moments[1], sigma_data=moments[2])


def small_frozen():
    rng = np.random.default_rng(6)
    rows = rng.standard_normal((16, OBS)), rng.uniform(-1, 1, (16, ACT))
    return Frozen(small_denoiser(), jnp.zeros(0), Probe(*(jnp.asarray(r, jnp.float32) for r in rows)))


def learner_of(config, guided=True):
    return create_learner((OBS, ACT), config, small_denoiser() if guided else None)


def rollout_of(actor, iteration=0):
    """What a Collector would collect in `iteration`: an eighth of the rows is masked, some steps end an episode."""
    rng = np.random.default_rng(100 + iteration)
    grid = (TIME, ENVS)
    observations, successors = rng.standard_normal((2, *grid, OBS)).astype(np.float32)
    means = np.asarray(actor(jnp.asarray(observations.reshape(ROWS, OBS)))).reshape(*grid, ACT)
    std = np.exp(np.asarray(actor.log_std))
    actions = means + std * rng.standard_normal(means.shape).astype(np.float32)
    ended = rng.random(grid)
    arrays = dict(
        state_ids=(np.arange(ROWS, dtype=np.int32) + ROWS * iteration).reshape(grid),
        observations=observations,
        next_observations=successors,
        actions=actions,
        log_probs=norm.logpdf(actions, means, std).sum(-1).astype(np.float32),
        means=means,
        rewards=rng.standard_normal(grid).astype(np.float32),
        terminated=ended < 0.1,
        truncated=ended > 0.9,
        valid=rng.permutation(ROWS).reshape(grid) >= ROWS // 8,
    )
    return Rollout(**{name: jnp.asarray(array) for name, array in arrays.items()})


def parts_of(rollout, config):
    """The rollout in the parts that a run would collect it in."""
    count = num_parts(config)
    split = jax.tree.map(lambda x: x.reshape(count, -1, *x.shape[1:]), rollout)
    return [jax.tree.map(lambda x, i=i: x[i], split) for i in range(count)]


def iterated(iterate, learner, frozen, rollout, schedule, stages, config, iteration=0):
    """One iteration of `iterate` on a rollout as above, with the random numbers that a run would draw for it."""
    draws = draw(config, iteration, None if frozen is None else frozen.prior)
    parts = parts_of(rollout, config)
    return iterate(learner, frozen, parts, NORMALISER, lambda: REWARD_STD, schedule, draws, stages)


def schedule_of(iteration=0, lambda_kl=0.05, lambda_aux=0.1, guided=True, pet_steps=2):
    numbers = [jnp.asarray(x, jnp.float32) for x in (3e-3, jnp.inf, lambda_kl, lambda_aux, 0.7)]
    weights = Weights(*numbers[2:4], jnp.zeros(())) if guided else ()
    settings = Settings(*numbers[:2], jnp.asarray(guided), weights)
    return Schedule(jnp.asarray(iteration * ROWS, jnp.int32), settings, numbers[4], jnp.asarray(pet_steps, jnp.int32))


def with_fault(fault):
    """`iterate` in which `fault(name, stage, arguments, seen, frozen)` runs each stage and may tamper with it.

    `seen` maps the names of the stages that ran before to their last (arguments, result).
    """

    def faulty(learner, frozen, rollout, normaliser, reward_std, schedule, draws, stages, run=None):
        seen = {"stages": stages}
        names = {id(stage): name for name, stage in vars(stages).items()}

        def between(_, stage, *arguments):
            name = names[id(stage)]
            result = fault(name, stage, arguments, seen, frozen)
            seen[name] = arguments, result
            return result

        return algorithm.iterate(learner, frozen, rollout, normaliser, reward_std, schedule, draws, stages, between)

    return faulty


def changed(node, **values):
    """A copy of a module with some fields replaced."""
    names = list(values)
    return eqx.tree_at(lambda n: [getattr(n, name) for name in names], node, list(values.values()))


def slope_q(slope, width=8, scale=1.0):
    """Q(s, a) = scale * tanh(slope . a), whatever the state's features are."""
    head = QHead(
        Linear(jnp.zeros((1, width)), jnp.zeros(1)),
        Linear(jnp.asarray([slope], jnp.float32), jnp.zeros(1)),
        Linear(jnp.asarray([[scale]], jnp.float32), jnp.zeros(1)),
    )
    return QFunction(None, (head,))


def bits(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def logged(rows, probe):
    """`rows` whose first 16 are rows of the logs, under ids of D_on."""
    n = len(probe.actions)
    observations = rows.raw_observations.at[:n].set(probe.raw_observations)
    actions = rows.actions.at[:n].set(probe.actions)
    return changed(rows, raw_observations=observations, observations=observations, actions=actions)


def replaced(arguments, position, value):
    return *arguments[:position], value, *arguments[position + 1 :]


def tamper(stage_name, edit):
    """A fault that edits the arguments of one stage: `edit(arguments, seen, frozen)` returns the new ones."""

    def fault(name, stage, arguments, seen, frozen):
        return stage(*(edit(arguments, seen, frozen) if name == stage_name else arguments))

    return fault


def logged_rows_for(position):
    return lambda arguments, seen, frozen: replaced(arguments, position, logged(arguments[position], frozen.probe))


def violated(claims):
    return {claim.statement for claim in claims if not claim.holds}
