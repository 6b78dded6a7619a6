"""Training speed of CleanRL's PPO on one MuJoCo task, on the CPU.

CleanRL is files to copy, not a package: this is the structure of its continuous-action PPO, written anew. The first
iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import time

import gymnasium as gym
import numpy as np
import torch
from common import ENVS, ITERATION, ROLLOUT, arguments, report
from torch import nn
from torch.distributions import Normal

EPOCHS, MINIBATCH, GAMMA, LAMBDA, CLIP = 10, 256, 0.99, 0.95, 0.2


def make_env(task: str) -> gym.Env:
    """Return one environment with CleanRL's wrappers: each environment keeps its own running moments."""
    env = gym.wrappers.NormalizeObservation(gym.wrappers.ClipAction(gym.make(task)))
    env = gym.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10), env.observation_space)
    env = gym.wrappers.NormalizeReward(env, gamma=GAMMA)
    return gym.wrappers.TransformReward(env, lambda reward: float(np.clip(reward, -10, 10)))


def mlp(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network of two hidden layers of 64 tanh units, with orthogonal weights."""
    layers = [nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)]
    for layer, scale in zip(layers, [2**0.5, 2**0.5, gain], strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


def train(task: str, iterations: int) -> float:
    """Train, and return the seconds that all iterations but the first took."""
    mode = gym.vector.AutoresetMode.SAME_STEP  # that of the gymnasium which CleanRL was written for
    envs = gym.vector.SyncVectorEnv([lambda: make_env(task)] * ENVS, autoreset_mode=mode)
    obs_size, act_size = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor, critic = mlp(obs_size, act_size, 0.01), mlp(obs_size, 1, 1.0)
    params = [log_std := nn.Parameter(torch.zeros(act_size)), *actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(params, lr=3e-4, eps=1e-5)

    obs, actions = torch.zeros(ROLLOUT, ENVS, obs_size), torch.zeros(ROLLOUT, ENVS, act_size)
    log_probs, rewards, dones, values = (torch.zeros(ROLLOUT, ENVS) for _ in range(4))
    next_obs, next_done = torch.Tensor(envs.reset()[0]), torch.zeros(ENVS)

    for iteration in range(iterations):
        if iteration <= 1:
            start = time.perf_counter()
        for t in range(ROLLOUT):
            obs[t], dones[t] = next_obs, next_done
            with torch.no_grad():
                policy = Normal(actor(next_obs), log_std.exp())
                actions[t] = policy.sample()
                log_probs[t], values[t] = policy.log_prob(actions[t]).sum(1), critic(next_obs).flatten()
            observation, reward, terminated, truncated, _ = envs.step(actions[t].numpy())
            rewards[t] = torch.tensor(reward)
            next_obs, next_done = torch.Tensor(observation), torch.Tensor(terminated | truncated)

        with torch.no_grad():
            advantages, advantage, next_value = torch.zeros(ROLLOUT, ENVS), 0.0, critic(next_obs).flatten()
            for t in reversed(range(ROLLOUT)):
                alive = 1 - (next_done if t == ROLLOUT - 1 else dones[t + 1])
                delta = rewards[t] + GAMMA * next_value * alive - values[t]
                advantages[t] = advantage = delta + GAMMA * LAMBDA * alive * advantage
                next_value = values[t]
        data = [x.flatten(0, 1) for x in (obs, actions, log_probs, advantages, advantages + values)]

        for _ in range(EPOCHS):
            for rows in np.random.permutation(ITERATION).reshape(-1, MINIBATCH):
                batch_obs, batch_actions, batch_log_probs, adv, returns = (x[rows] for x in data)
                policy = Normal(actor(batch_obs), log_std.exp())
                ratio = (policy.log_prob(batch_actions).sum(1) - batch_log_probs).exp()
                adv = (adv - adv.mean()) / (adv.std() + 1e-8)
                policy_loss = torch.max(-adv * ratio, -adv * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
                value_loss = (critic(batch_obs).flatten() - returns).pow(2).mean()
                optimizer.zero_grad()
                (policy_loss + 0.5 * value_loss).backward()
                nn.utils.clip_grad_norm_(params, 0.5)
                optimizer.step()
    return time.perf_counter() - start


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    args = arguments(__doc__)

    seconds, steps = train(args.task, args.steps // ITERATION), args.steps - ITERATION

    report("cleanrl", f"anew, torch {torch.__version__}", args.task, steps, seconds)


if __name__ == "__main__":
    main()
