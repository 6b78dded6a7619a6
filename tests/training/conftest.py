import numpy as np
import pytest

import ppo_dap
from ppo_dap.logs import Logs

SMALL = {
    "num_envs": 4,
    "rollout_steps": 128,
    "minibatch_size": 32,
    "num_epochs": 2,
    "num_proposals": 3,
    "sampler_steps": 2,
    "eval_episodes": 2,
    "eval_every": 256,
    "checkpoint_every": 3,
    "tensorboard": False,
}
"""Options of a run whose iterations take milliseconds."""


@pytest.fixture(scope="session")
def small():
    return dict(SMALL)


@pytest.fixture(scope="session")
def hopper_logs():
    return ppo_dap.load_logs("hopper-medium").select(range(6))


@pytest.fixture(scope="session")
def hopper_prior(tmp_path_factory, hopper_logs: Logs):
    """File of a prior for Hopper-v5 that is small and hardly fitted."""
    path = tmp_path_factory.mktemp("prior") / "prior"
    ppo_dap.fit_prior(hopper_logs, width=16, max_steps=20, chunk_steps=20, batch_size=64).save(path)
    return path


@pytest.fixture
def rng():
    return np.random.default_rng(0)
