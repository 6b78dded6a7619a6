"""Training speed of skrl's PPO (its PyTorch side) on one MuJoCo task, on the CPU.

The first iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import time
from importlib.metadata import version

import gymnasium as gym
import skrl
import torch
from common import ENVS, ITERATION, ROLLOUT, arguments, report
from skrl.agents.torch import ExperimentCfg
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from torch import nn


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network of two hidden layers of 64 tanh units."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


class Policy(GaussianMixin, Model):
    """The actor: a diagonal Gaussian whose deviations do not depend on the observation."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = mlp(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs, role=""):
        """Return the mean action and, among the outputs, the log of the deviations."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The critic."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = mlp(self.num_observations, 1)

    def compute(self, inputs, role=""):
        """Return the value of each observation."""
        return self.net(inputs["observations"]), {}


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    args = arguments(__doc__)
    skrl.config.torch.device = "cpu"

    # A reset within the step: every step that is counted is then one of the simulator.
    options = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    envs = wrap_env(gym.make_vec(args.task, ENVS, "sync", vector_kwargs=options), "gymnasium", verbose=False)
    spaces = {"observation_space": envs.observation_space, "action_space": envs.action_space}
    cfg = PPO_CFG(
        rollouts=ROLLOUT,
        learning_epochs=10,
        mini_batches=ITERATION // 256,
        discount_factor=0.99,
        gae_lambda=0.95,
        learning_rate=3e-4,
        grad_norm_clip=0.5,
        ratio_clip=0.2,
        value_clip=0.0,
        entropy_loss_scale=0.0,
        value_loss_scale=0.5,
        time_limit_bootstrap=True,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": envs.observation_space},
        value_preprocessor=RunningStandardScaler,  # skrl's counterpart of reward normalisation
        value_preprocessor_kwargs={"size": 1},
        experiment=ExperimentCfg(write_interval=0, checkpoint_interval=0),
    )
    models = {"policy": Policy(**spaces), "value": Value(**spaces)}
    agent = PPO(models=models, memory=RandomMemory(memory_size=ROLLOUT, num_envs=ENVS), cfg=cfg, **spaces)
    quiet = {"headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    trainer = SequentialTrainer(env=envs, agents=agent, cfg=SequentialTrainerCfg(timesteps=ROLLOUT, **quiet))
    trainer.train()
    trainer.cfg.timesteps = args.steps // ENVS - ROLLOUT
    start = time.perf_counter()
    trainer.train()
    seconds, steps = time.perf_counter() - start, trainer.cfg.timesteps * ENVS

    report("skrl", version("skrl"), args.task, steps, seconds)


if __name__ == "__main__":
    main()
