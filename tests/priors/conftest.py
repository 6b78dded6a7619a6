import functools
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for `truths`

from truths import TwoModes

from ppo_dap.logs import Logs
from ppo_dap.prior_config import PRIOR_CONFIGS
from ppo_dap.priors.fit import Rows, fit_prior, train_network
from ppo_dap.priors.kinds import NETWORKS

FIT = {"batch_size": 256, "max_steps": 1500, "chunk_steps": 250, "ema_decay": 0.99}
SMALL = {
    "diffusion": {**FIT, "width": 64},
    "behaviour": {**FIT, "width": 32, "max_steps": 1000},
    "flow": {**FIT, "width": 32, "state_width": 32, "learning_rate": 5e-3},
    "vae": {**FIT, "width": 64, "max_steps": 1000, "learning_rate": 3e-3},
}
"""Options of a fit that takes seconds, a kind each."""


def two_mode_logs(rows=20_000):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (rows, 2))
    actions = TwoModes().sample(states, 1, rng)[:, 0]
    # The environment's units: the first dimension in [-2, 2], the second in [0, 1].
    units = actions * np.array([2.0, 0.5]) + np.array([0.0, 0.5])
    ends = np.arange(1, rows + 1) % 100 == 0
    bounds = {"action_low": np.array([-2.0, 0.0]), "action_high": np.array([2.0, 1.0])}
    return Logs(observations=states, actions=units, episode_ends=ends, task="Toy-v0", **bounds)


@pytest.fixture(scope="session")
def logs():
    return two_mode_logs()


@pytest.fixture(scope="session")
def small():
    return SMALL


@pytest.fixture(scope="session")
def fitted(logs):
    """The prior of a kind, fitted to `logs` once."""
    return functools.cache(lambda kind: fit_prior(logs, kind, seed=3, **SMALL[kind]))


@pytest.fixture(scope="session")
def prior(fitted):
    return fitted("diffusion")


@pytest.fixture(params=list(SMALL))
def every_prior(request, fitted):
    return fitted(request.param)


@pytest.fixture(params=list(SMALL))
def labelled(request):
    """A network of each kind, fitted to actions near -0.5 under the label -1 and near 0.5 under the label 1."""
    rng = np.random.default_rng(1)
    label = rng.choice([-1.0, 1.0], (8000, 1))
    actions = 0.5 * label + 0.1 * rng.standard_normal((8000, 1))
    condition = np.concatenate([label, np.ones_like(label)], axis=1)
    rows = Rows(*(jnp.asarray(a, jnp.float32) for a in (rng.standard_normal((8000, 2)), condition, actions)))
    options = {**SMALL[request.param], "width": 32, "max_steps": 600, "chunk_steps": 200}
    config = PRIOR_CONFIGS[request.param](**options, condition_on="return")
    held_out = Rows(*(a[7000:] for a in rows))
    return train_network(NETWORKS[request.param], Rows(*(a[:7000] for a in rows)), held_out, config, 0)[0]
