"""PPO-DAP in a PPO that is not ours: a tiny one in JAX on Pendulum-v1, with the logs of an old controller.

All it takes: fit a prior to the logs, ask the Guide for proposals once an iteration, add two terms to the loss (Eq. 9).
"""

import argparse

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.example_libraries.stax import Dense, Tanh, serial
from jax.scipy.stats.norm import logpdf
from scipy.signal import lfilter

import ppo_dap

ENVS, STEPS, MINIBATCH, EPOCHS = 16, 200, 64, 10  # an iteration: an episode each, cut off after 200 steps: V goes on
GAMMA, GAE_LAMBDA, CLIP, LAMBDA_KL, LAMBDA_AUX = 0.95, 0.95, 0.2, 5e-3, 1e-2
INIT, NET = serial(Dense(64), Tanh, Dense(64), Tanh, Dense(1))  # the policy's mean, and V
ADAM, ROWS, SCALE = optax.adam(1e-3), ENVS * STEPS, 100


def _old_controller(obs):  # pumps energy until the pendulum is up, and holds it there
    angle, speed = np.arctan2(obs[:, 1:2], obs[:, :1]), obs[:, 2:]
    pump, hold = speed * (15 - speed**2 / 2 - 15 * obs[:, :1]), -10 * angle - 2 * speed
    return np.clip(np.where(np.abs(angle) < 0.5, hold, pump), -2, 2)


def _play(envs, mean, std, rng):
    obs, rows = envs.reset(seed=int(rng.integers(2**31)))[0], []
    for _ in range(STEPS):
        action = np.asarray(mean(obs) + std * rng.normal(size=(ENVS, 1)), np.float32)
        following, reward, *_ = envs.step(np.clip(action, -2, 2))
        rows.append((obs, action, reward / SCALE, obs := following))
    return [np.swapaxes(np.asarray(x, np.float32), 0, 1) for x in zip(*rows, strict=True)]  # (envs, steps, ...)


@jax.jit
def _step(params, state, obs, action, old_log_prob, advantage, target, proposals):
    def loss(params):
        std, states = jnp.exp(params["log_std"]), proposals.raw_observations
        ratio = jnp.exp(logpdf(action, NET(params["pi"], obs), std).sum(-1) - old_log_prob)
        surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
        ppo = -surrogate.mean() + ((NET(params["v"], obs)[:, 0] - target) ** 2).mean()
        mean, mu, sd = NET(params["pi"], states), proposals.proxy_mean, proposals.proxy_std  # the two terms
        kl = (jnp.log(sd / std) + (std**2 + (mean - mu) ** 2) / (2 * sd**2) - 0.5).sum(-1)
        return ppo + LAMBDA_KL * kl.mean() - LAMBDA_AUX * logpdf(proposals.actions, mean[:, None], std).sum(-1).mean()

    updates, state = ADAM.update(jax.grad(loss)(params), state)
    return optax.apply_updates(params, updates), state


def main(iterations: int) -> None:
    """Train, and print the mean return of each iteration's episodes."""
    envs, rng, *keys = gym.make_vec("Pendulum-v1", ENVS), np.random.default_rng(0), *map(jax.random.key, (0, 1))
    obs, act = (x.reshape(ROWS, -1) for x in _play(envs, _old_controller, 0.3, rng)[:2])  # the logs
    logs = ppo_dap.Logs(obs, act.clip(-2, 2), episode_ends=np.arange(1, ROWS + 1) % STEPS == 0)
    prior = ppo_dap.fit_prior(logs, action_low=-2, action_high=2, width=64, max_steps=400)
    guide = ppo_dap.Guide(prior, total_iterations=iterations, minibatch_size=MINIBATCH)
    state = ADAM.init(params := {"pi": INIT(keys[0], (3,))[1], "v": INIT(keys[1], (3,))[1], "log_std": jnp.zeros(1)})
    for iteration in range(iterations):
        pi, std = jax.tree_util.Partial(NET, params["pi"]), np.exp(params["log_std"])
        obs, act, rewards, following = _play(envs, pi, std, rng)
        values, next_values = (np.asarray(NET(params["v"], x))[..., 0] for x in (obs, following))
        gae = lfilter([1], [1, -GAMMA * GAE_LAMBDA], (rewards + GAMMA * next_values - values)[:, ::-1])[:, ::-1]
        scaled, old = (gae - gae.mean()) / gae.std(), logpdf(act, pi(obs), std).sum(-1)
        columns = obs, act, old, scaled, gae + values, rewards, next_values
        *rows, r, v = (np.asarray(x, np.float32).reshape(ROWS, *x.shape[2:]) for x in columns)
        proposals = guide(observations=rows[0], actions=rows[1].clip(-2, 2), rewards=r, next_values=v, terminated=0 * r)
        for i in rng.permuted(np.tile(np.arange(ROWS), (EPOCHS, 1)), axis=1).reshape(-1, MINIBATCH):
            params, state = _step(params, state, *(x[i] for x in rows), proposals)
        print(f"iteration {iteration + 1}: return {rewards.sum(1).mean() * SCALE:.0f}", flush=True)


if __name__ == "__main__":
    (parser := argparse.ArgumentParser()).add_argument("--iterations", type=int, default=30)
    main(parser.parse_args().iterations)
