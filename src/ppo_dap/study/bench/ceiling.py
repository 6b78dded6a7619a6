"""The two ceilings of the benchmark, each a process of its own that prints one number.

`python -m ppo_dap.study.bench.ceiling env TASK POLICY STEPS`: steps per second of the environments alone.
`python -m ppo_dap.study.bench.ceiling sampler PRIOR`: time of the sampler's matrix products alone, over the sampler's.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.training.manifest import prepare_jax

NUM_ENVS, STATES, PROPOSALS, REPEATS = 8, 51, 10, 25


def env_ceiling(task: str, policy_file: Path, steps: int) -> float:
    """Steps per second of the backend's own `step`, with the actions that a trained policy took from the same start.

    Contacts cost more than flailing. The core is chosen as in training.
    """
    from ppo_dap.nets.policy import load_policy
    from ppo_dap.tasks import make_vector_env
    from ppo_dap.training.cores import pinned

    policy, rng = load_policy(policy_file), np.random.default_rng(0)
    with pinned(True):
        env = make_vector_env(task, NUM_ENVS, seed=0)
        observations, actions = env.reset(), []
        for _ in range(steps // NUM_ENVS):
            noise = np.exp(policy.log_std) * rng.standard_normal((NUM_ENVS, len(policy.log_std)), dtype=np.float32)
            actions.append(policy.unscale(policy.mean(observations) + noise))
            observations = env.step(actions[-1]).observations
        env.close()
        env = make_vector_env(task, NUM_ENVS, seed=0)
        env.reset()
        backend: Any = env
        start = time.perf_counter()
        for action in actions:
            backend.env.step(action)
        seconds = time.perf_counter() - start
        env.close()
    return len(actions) * NUM_ENVS / seconds


def sampler_of_gemm(prior_file: Path) -> float:
    """Median time of the bare products of a sampler call (a part of a rollout, K = 10), over that of the call."""
    import jax
    import jax.numpy as jnp

    from ppo_dap.priors import load_prior
    from ppo_dap.priors.samplers import Solver

    prior = load_prior(prior_file)
    denoiser, config = prior.network, prior.config
    solver, rng = Solver("ancestral", 20), np.random.default_rng(0)

    def numbers(*shape: int) -> jax.Array:
        return jnp.asarray(rng.standard_normal(shape, dtype=np.float32))

    observations, condition = numbers(STATES, prior.observation_size), numbers(STATES, config.num_conditions)
    noise = numbers(*denoiser.noise_shape(solver, STATES, PROPOSALS))
    sample = jax.jit(lambda denoiser, o, noise: denoiser.sample(o, condition, noise, solver)[0])
    weights = [layer.weight.T for layer in (denoiser.action_in, *denoiser.hidden, denoiser.out)]
    inputs = [numbers(STATES * PROPOSALS, weight.shape[0]) for weight in weights]

    @jax.jit
    def products(inputs, weights):
        def step(_, carry):
            changed, _ = carry  # else the products would be the same in every step, and computed once
            results = [x @ (weight + changed) for x, weight in zip(inputs, weights, strict=True)]
            return 1e-12 * sum(result[0, 0] for result in results), results

        start = jnp.zeros(()), [x @ weight for x, weight in zip(inputs, weights, strict=True)]
        return jax.lax.fori_loop(0, solver.num_steps, step, start)

    pairs = []
    for _ in range(REPEATS):  # taking turns: the machine's speed wanders
        pairs.append((_seconds(products, inputs, weights), _seconds(sample, denoiser, observations, noise)))
    return statistics.median(bare / whole for bare, whole in pairs[2:])


def _seconds(function: Callable[..., Any], *arguments: Any) -> float:
    import jax

    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


if __name__ == "__main__":
    prepare_jax()
    if sys.argv[1] == "env":
        print(env_ceiling(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4])))
    else:
        print(sampler_of_gemm(Path(sys.argv[2])))
