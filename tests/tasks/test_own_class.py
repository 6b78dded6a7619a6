"""A user's own environment by the import path of its class."""

import sys

import gymnasium
import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.tasks import describe, make_vector_env
from ppo_dap.tasks.catalogue import make_gymnasium

MODULE = '''
import gymnasium
import numpy as np

Box = gymnasium.spaces.Box


class Countdown(gymnasium.Env):
    """Observes how many steps are left of 3; truncated at 0, terminated by an action above 0.9."""

    observation_space, action_space = Box(0, 3, (1,)), Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        return np.array([self.left], np.float32), {}

    def step(self, action):
        self.left -= 1
        ends = bool(action[0] > 0.9)
        return np.array([self.left], np.float32), 1.5, ends, self.left == 0 and not ends, {}


class Needy(Countdown):
    def __init__(self, size):
        self.size = size


class Unbounded(Countdown):
    action_space = Box(-np.inf, np.inf, (1,))


class Choosing(Countdown):
    action_space = gymnasium.spaces.Discrete(2)


class Seeing(Countdown):
    observation_space = Box(0, 1, (8, 8))


class Spaceless(gymnasium.Env):
    pass


class Plain:
    pass


number = 5
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with the module `own_envs` in it and a broken one."""
    (tmp_path / "own_envs.py").write_text(MODULE)
    (tmp_path / "own_broken.py").write_text("import own_envs\nsize = missing_name\n")
    (tmp_path / "own_incomplete.py").write_text("import no_such_library\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in ("own_envs", "own_broken", "own_incomplete"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("folder")
def test_a_class_of_the_current_folder_is_described():
    spec = describe("own_envs:Countdown")
    assert (spec.task, spec.observation_size, spec.action_size) == ("own_envs:Countdown", 1, 1)
    assert (spec.backend, spec.gamma, spec.episode_length) == ("gymnasium", None, None)
    np.testing.assert_array_equal([spec.action_low, spec.action_high], [[-1], [1]])


@pytest.mark.usefixtures("folder")
def test_its_episodes_end_as_it_says_itself():
    env = make_vector_env("own_envs:Countdown", 2, 0)
    np.testing.assert_array_equal(env.reset(), [[3], [3]])
    steps = [env.step(np.array([[0.0], [last]], np.float32)) for last in (0, 1, 0, 0)]
    assert [s.terminated.tolist() for s in steps] == [[False] * 2, [False, True], [False] * 2, [False] * 2]
    assert [s.truncated.tolist() for s in steps] == [[False] * 2, [False] * 2, [True, False], [False] * 2]
    assert [s.next_observations[:, 0].tolist() for s in steps] == [[2, 2], [1, 1], [0, 2], [2, 1]]
    assert [s.observations[:, 0].tolist() for s in steps] == [[2, 2], [1, 3], [3, 2], [2, 1]]
    assert all(s.valid.all() and (s.rewards == 1.5).all() for s in steps)


@pytest.mark.usefixtures("folder")
def test_it_is_made_as_it_is():
    env = make_gymnasium("own_envs:Countdown")
    assert type(env) is sys.modules["own_envs"].Countdown


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("own_envz:Countdown", "own_envz cannot be imported: ModuleNotFoundError: No module named 'own_envz'"),
        ("own_envs.sub:Countdown", "own_envs.sub cannot be imported"),
        ("own_broken:Countdown", "own_broken cannot be imported: NameError: name 'missing_name'"),
        ("own_incomplete:Countdown", "No module named 'no_such_library'"),
        ("own_envs:Countdwn", "unknown class of own_envs 'Countdwn': did you mean 'Countdown'"),
        ("own_envs:Nothing", "known are Choosing, Countdown, Needy"),
        ("own_envs:Plain", "is the class Plain, not a class derived from gymnasium.Env"),
        ("own_envs:number", "is of type int, not a class"),
        ("own_envs:Needy", "cannot be made without arguments: TypeError.*'size'"),
        ("own_envs:Unbounded", "unbounded actions"),
        ("own_envs:Choosing", r"action space Discrete\(2\)"),
        ("own_envs:Seeing", "observation space Box"),
        ("own_envs:Spaceless", "observation space None"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(task, message):
    for make in (describe, lambda task: make_vector_env(task, 2, 0)):
        with pytest.raises(InputError, match=message) as caught:
            make(task)
        assert "\n" not in str(caught.value)


def test_gymnasiums_ids_with_a_module_still_work(folder):
    (folder / "own_broken.py").write_text(
        "import gymnasium, own_envs\ngymnasium.register('OwnCountdown-v0', own_envs.Countdown, max_episode_steps=2)\n"
    )
    sys.path.append(str(folder))
    try:
        env = make_vector_env("own_broken:OwnCountdown-v0", 1, 0)
        env.reset()
        assert [bool(env.step(np.zeros((1, 1), np.float32)).truncated[0]) for _ in range(3)] == [False, True, False]
    finally:
        gymnasium.registry.pop("OwnCountdown-v0", None)
