import pytest

from dap.dap_made import learner_of, small_config, small_frozen
from ppo_dap.training.algorithm import Stages


@pytest.fixture(scope="session")
def config():
    return small_config()


@pytest.fixture(scope="session")
def frozen():
    return small_frozen()


@pytest.fixture(scope="session")
def learner(config):
    return learner_of(config)


@pytest.fixture(scope="session")
def stages(config):
    """Compiled once; a test that patches what a stage is made of builds its own."""
    return Stages(config, guided=True)
