"""The method in a PPO that is not ours: a tiny one in JAX, on Pendulum-v1, with logs of an old controller.

What PPO-DAP adds is in the lines marked DAP: fit a prior to the logs, ask `ppo_dap.Guide` for proposals once an
iteration, and add two terms to the policy's loss on the proposals' states. Ratios and advantages stay PPO's alone.
Run it with `--plain` to see the same PPO without them.
"""

import argparse

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax

import ppo_dap

ENVS, STEPS, MINIBATCH, EPOCHS = 16, 200, 64, 10  # an iteration is one episode (200 steps) of each environment
GAMMA, GAE_LAMBDA, CLIP, LAMBDA_KL, LAMBDA_AUX = 0.95, 0.95, 0.2, 5e-3, 1e-2
ADAM = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))

def old_controller(obs, rng=np.random.default_rng(0)):
    """Pumps energy until the pendulum is up, holds it there, and is noisy."""
    angle, speed = np.arctan2(obs[:, 1], obs[:, 0]), obs[:, 2]
    pump = speed * (15 - speed**2 / 2 - 15 * obs[:, 0])
    torque = np.where(np.abs(angle) < 0.5, -10 * angle - 2 * speed, pump)
    return (np.clip(torque, -2, 2) + rng.normal(0, 0.4, ENVS))[:, None]

def play(envs, act, seed):
    obs, rows = envs.reset(seed=seed)[0], []
    for _ in range(STEPS):
        action = np.asarray(act(obs), np.float32)
        following, reward, *_ = envs.step(np.clip(action, -2, 2))
        rows.append((obs, action, reward / 10, following))
        obs = following
    return [np.swapaxes(np.asarray(x, np.float32), 0, 1) for x in zip(*rows, strict=True)]  # (envs, steps, ...)

def init(key, sizes):
    keys = jax.random.split(key, len(sizes) - 1)
    return [(jax.random.normal(k, (m, n)) / m**0.5, jnp.zeros(n)) for k, m, n in zip(keys, sizes, sizes[1:])]

def net(layers, obs):
    x = obs / jnp.array([1.0, 1.0, 8.0])
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    return x @ layers[-1][0] + layers[-1][1]
