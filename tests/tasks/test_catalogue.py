import gymnasium
import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.tasks import describe, make_vector_env
from ppo_dap.tasks.catalogue import CATALOGUE, ENVPOOL_TASKS, make_gymnasium
from ppo_dap.tasks.random_returns import random_returns

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
    ("task", "backend"),
    [("Hopper-v4", "envpool"), ("Pendulum-v1", "gymnasium")]
    + [(task, "mujoco" if task == "Striker-v2" else "envpool") for task in CATALOGUE],
)
@pytest.mark.usefixtures("without_video")
def test_a_task_has_the_spaces_of_gymnasium(task, backend):
    spec = describe(task)
    with make_gymnasium(task) as env:
        assert spec.observation_size == env.observation_space.shape[0]
        assert spec.action_size == env.action_space.shape[0]
        np.testing.assert_array_equal(spec.action_low, env.action_space.low)
        np.testing.assert_array_equal(spec.action_high, env.action_space.high)
    assert (spec.task, spec.backend) == (task, backend)


# The tasks of section 5.1.1, typed by hand, and of each: does an episode end early, as its documentation says?
PAPER = {
    "Ant": True,
    "HalfCheetah": False,
    "Hopper": True,
    "HumanoidStandup": False,
    "Pusher": False,
    "Striker": False,
    "Swimmer": False,
    "Walker2d": True,
}


def test_the_catalogue_has_the_papers_tasks():
    assert {task.partition("-")[0]: spec.terminates for task, spec in CATALOGUE.items()} == PAPER
    assert all(task == spec.task for task, spec in CATALOGUE.items())


@pytest.mark.parametrize("task", CATALOGUE)
@pytest.mark.usefixtures("without_video")
def test_episodes_are_as_long_as_the_catalogue_says(task):
    with make_gymnasium(task) as env:
        assert env.spec.max_episode_steps == CATALOGUE[task].episode_length


@pytest.mark.parametrize("task", [task for task in CATALOGUE if task != "Ant-v5"])
def test_an_episode_ends_as_the_catalogue_says(task):
    """Random actions in three copies for one episode: they fall where they can, and are truncated elsewhere."""
    spec, rng = describe(task), np.random.default_rng(0)
    env = make_vector_env(task, 3, 0)
    env.reset()
    terminated = truncated = 0
    for _ in range(spec.episode_length):
        step = env.step(rng.uniform(spec.action_low, spec.action_high, (3, spec.action_size)).astype(np.float32))
        terminated, truncated = terminated + step.terminated.sum(), truncated + step.truncated.sum()
    env.close()
    assert (terminated > 0) == spec.terminates
    assert truncated == (0 if spec.terminates else 3)


@pytest.mark.parametrize("task", ["Hopper-v5", "Pusher-v5", "Striker-v2", "Walker2d-v5"])
def test_random_returns_of_another_seed_agree(task):
    """Within four standard errors of the difference of two means of 20."""
    returns = random_returns(task, seed=1)
    assert abs(returns.mean() - CATALOGUE[task].random_return) < 4 * returns.std(ddof=1) * (2 / 20) ** 0.5


# Typed by hand from D4RL's infos.py: what its scores are scaled by.
D4RL = {"HalfCheetah-v5": 12135.0, "Hopper-v5": 3234.3, "Walker2d-v5": 4592.3, "Ant-v5": 3879.7}


def test_expert_returns_are_d4rls_or_none():
    assert {task: spec.expert_return for task, spec in CATALOGUE.items()} == dict.fromkeys(CATALOGUE) | D4RL


def test_a_task_of_the_catalogue_is_described_without_making_it(monkeypatch):
    import envpool

    def refuse(*arguments, **options):
        raise AssertionError("an environment was made")

    monkeypatch.setattr(envpool, "make_gymnasium", refuse)
    monkeypatch.setattr(gymnasium, "make", refuse)
    assert [describe(task) for task in CATALOGUE] == list(CATALOGUE.values())
    with pytest.raises(AssertionError, match="was made"):
        describe("Hopper-v4")


@pytest.mark.usefixtures("without_video")
def test_striker_goes_by_both_of_its_ids():
    assert describe("ppo_dap/Striker-v2") is describe("Striker-v2")
    first = [make_vector_env(task, 2, 3).reset() for task in ("ppo_dap/Striker-v2", "Striker-v2")]
    np.testing.assert_array_equal(*first)
    for task in ("ppo_dap/Striker-v2", "Striker-v2"):
        with make_gymnasium(task) as env:
            assert env.spec.id == "ppo_dap/Striker-v2"
    assert "ppo_dap/Striker-v2" in gymnasium.registry


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
        ("Striker-v3", "did you mean 'Striker-v2'"),
        ("nothing-like-it", "nothing-like-it.*known are Ant-v5"),
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
        (Box(0, 1, (0,)), SMALL, "observation space"),
        (SMALL, Box(0, 1, (0,)), "action space"),
        (gymnasium.spaces.Dict({"a": SMALL}), SMALL, "observation space"),
    ],
)
def test_spaces_that_are_no_bounded_boxes_are_refused(register, observation_space, action_space, message):
    refused(register(observation_space, action_space), message)


def test_unbounded_observations_are_fine(register):
    assert describe(register(Box(-np.inf, np.inf, (3,)), SMALL)).observation_size == 3
