"""Training speed of Tianshou's PPO on one MuJoCo task, on the CPU.

The first iteration (collect and update) is a warm-up outside the clock; the rest of ``--steps`` is timed.
"""

import time
from importlib.metadata import version

import torch
from common import ENVS, ITERATION, arguments, report
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import VectorEnvNormObs
from tianshou.highlevel.env import EnvFactoryRegistered, EnvMode, EnvPoolFactory, VectorEnvType
from tianshou.trainer import OnPolicyTrainer, OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Distribution, Independent, Normal


def gaussian(loc_scale: tuple[torch.Tensor, torch.Tensor]) -> Distribution:
    """Return the policy's distribution: a diagonal Gaussian."""
    return Independent(Normal(*loc_scale), 1)


def main() -> None:
    """Train, and print the measurement as one JSON line."""
    args = arguments(__doc__, ("--dummy", "DummyVectorEnv in place of envpool"))

    # Tianshou's envpool integration works here, through its own EnvPoolFactory, and costs no more than DummyVectorEnv.
    # (The "envpool" extra of Tianshou 2.0 still asks for envpool below 0.9; envpool 1.2 is what this was tried with.)
    factory = EnvFactoryRegistered(
        task=args.task,
        venv_type=VectorEnvType.DUMMY,
        envpool_factory=None if args.dummy else EnvPoolFactory(),
    )
    venv = factory.create_venv(ENVS, EnvMode.TRAINING)
    env = factory.create_env(EnvMode.TRAINING)
    observation_shape, action_space = env.observation_space.shape, env.action_space
    envs = VectorEnvNormObs(venv)

    def body() -> Net:
        return Net(state_shape=observation_shape, hidden_sizes=[64, 64], activation=torch.nn.Tanh)

    actor = ContinuousActorProbabilistic(preprocess_net=body(), action_shape=action_space.shape, unbounded=True)
    policy = ProbabilisticActorPolicy(actor=actor, dist_fn=gaussian, action_space=action_space)
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(preprocess_net=body()),
        optim=AdamOptimizerFactory(lr=3e-4),
        eps_clip=0.2,
        advantage_normalization=True,  # over each minibatch
        vf_coef=0.5,
        ent_coef=0.0,
        max_grad_norm=0.5,
        gae_lambda=0.95,
        gamma=0.99,
        return_scaling=True,  # Tianshou's counterpart of reward normalisation: it has no wrapper for that
    )
    collector = Collector(algorithm, envs, VectorReplayBuffer(ITERATION, ENVS))
    params = OnPolicyTrainerParams(
        training_collector=collector,
        max_epochs=args.steps // ITERATION,
        epoch_num_steps=ITERATION,
        collection_step_num_env_steps=ITERATION,
        update_step_num_repetitions=10,
        batch_size=256,
        verbose=False,
        show_progress=False,
    )

    trainer = OnPolicyTrainer(algorithm, params)
    trainer.reset()
    trainer.execute_epoch()
    steps_before = collector.collect_step
    start = time.perf_counter()
    for _ in range(params.max_epochs - 1):
        trainer.execute_epoch()
    seconds = time.perf_counter() - start
    steps = collector.collect_step - steps_before

    report("tianshou", version("tianshou"), args.task, steps, seconds)


if __name__ == "__main__":
    main()
