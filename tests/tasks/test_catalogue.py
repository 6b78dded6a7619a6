import gymnasium
import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.tasks import describe, make_vector_env
from ppo_dap.tasks.catalogue import ENVPOOL_TASKS

Box = gymnasium.spaces.Box
SMALL = Box(-1, 1, (2,))


class Idle(gymnasium.Env):
    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.fixture
def register():
    """Registers a task with the given spaces and returns its id; forgotten after the test."""

    def add(observation_space, action_space):
        spaces = {"observation_space": observation_space, "action_space": action_space}
        gymnasium.register("IdleOfTests-v0", Idle, kwargs=spaces, disable_env_checker=True)
        return "IdleOfTests-v0"

    yield add
    gymnasium.registry.pop("IdleOfTests-v0", None)


@pytest.mark.parametrize(
    ("task", "backend"), [("Hopper-v5", "envpool"), ("HumanoidStandup-v5", "envpool"), ("Pendulum-v1", "gymnasium")]
)
@pytest.mark.usefixtures("without_video")
def test_a_task_has_the_spaces_of_gymnasium(task, backend):
    spec = describe(task)
    with gymnasium.make(task) as env:
        assert spec.observation_size == env.observation_space.shape[0]
        assert spec.action_size == env.action_space.shape[0]
        np.testing.assert_array_equal(spec.action_low, env.action_space.low)
        np.testing.assert_array_equal(spec.action_high, env.action_space.high)
    assert (spec.task, spec.backend) == (task, backend)


def test_bounds_need_not_be_symmetric(register):
    spec = describe(register(SMALL, Box(np.array([0.0, -3.0]), np.array([0.5, 1.0]), dtype=np.float64)))
    np.testing.assert_array_equal(spec.action_low, [0, -3])
    np.testing.assert_array_equal(spec.action_high, [0.5, 1])


def test_envpool_serves_every_task_that_is_listed():
    import envpool

    assert set(envpool.list_all_envs()) >= ENVPOOL_TASKS


def refused(task, message):
    for make in (describe, lambda task: make_vector_env(task, 1, 0)):
        with pytest.raises(InputError, match=message) as caught:
            make(task)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("Hoper-v5", "unknown task 'Hoper-v5': did you mean 'Hopper-v5'"),
        ("Pendulun-v1", "did you mean 'Pendulum-v1'"),
        ("nothing-like-it", "nothing-like-it"),
        ("CartPole-v1", "Discrete"),
        ("no_such_module:Env-v0", "no_such_module"),
    ],
)
def test_what_is_no_task_for_us_is_refused_in_one_line(task, message):
    refused(task, message)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "message"),
    [
        (SMALL, Box(-np.inf, np.inf, (2,)), "unbounded actions"),
        (SMALL, Box(np.array([-1, -1], np.float32), np.array([1, np.inf], np.float32)), "unbounded actions"),
        (SMALL, gymnasium.spaces.MultiBinary(2), "action space"),
        (SMALL, Box(-1, 1, (2, 2)), "action space"),
        (Box(0, 1, (2, 2)), SMALL, "observation space"),
        (gymnasium.spaces.Dict({"a": SMALL}), SMALL, "observation space"),
    ],
)
def test_spaces_that_are_no_bounded_boxes_are_refused(register, observation_space, action_space, message):
    refused(register(observation_space, action_space), message)


def test_unbounded_observations_are_fine(register):
    assert describe(register(Box(-np.inf, np.inf, (3,)), SMALL)).observation_size == 3
