"""Striker-v2 against its definition: figures typed by hand, rewards added up from recorded positions."""

import os
import subprocess
import sys
import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy import stats

from ppo_dap.tasks.catalogue import make_gymnasium

pytestmark = pytest.mark.usefixtures("without_video")

# Lower the arm to the ball, then swing it: found by random search.
LOWER, SWING = [0, 0.9, 0.3, -0.8, -0.8, -0.9, 0.2], [1.4, 1.7, -2.4, 0.7, 0.5, -1.3, 3.0]
STRIKE = np.array([LOWER] * 7 + [SWING] * 93, np.float32)
LIMITS = [(-2.2854, 1.714602), (-0.5236, 1.3963), (-1.5, 1.7), (-2.3213, 0), (-1.5, 1.5), (-1.094, 0), (-1.5, 1.5)]


@pytest.fixture
def env():
    with make_gymnasium("Striker-v2") as made:
        yield made


def play(env, actions, seed=0):
    """Observations before each step and after the last, rewards, flags and infos of one episode."""
    observations, steps = [env.reset(seed=seed)[0]], []
    for action in actions:
        observation, *step = env.step(action)
        observations.append(observation)
        steps.append(step)
    rewards, terminated, truncated, infos = zip(*steps, strict=True)
    return np.array(observations), np.array(rewards), np.array(terminated), np.array(truncated), infos


def test_spaces(env):
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (23,), np.float64)
    assert env.action_space == gymnasium.spaces.Box(-3, 3, (7,), np.float32)
    assert env.unwrapped.dt == pytest.approx(0.05)


def test_gymnasiums_own_checker_finds_nothing(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    known = ("symmetric and normalized", "value is -infinity", "value is infinity")  # as Pusher-v5 has them
    assert [str(w.message) for w in seen if not any(text in str(w.message) for text in known)] == []


def test_the_observation_is_joints_velocities_tip_ball_and_goal(env):
    env.reset(seed=0)
    data = env.unwrapped.data
    position, velocity = data.qpos.copy(), data.qvel.copy()
    position[:9] = [0.1, 0.2, 0.3, -0.4, 0.5, -0.6, 0.7, 0.8, 0.9]
    velocity[:] = np.arange(15) / 10
    env.unwrapped.set_state(position, velocity)
    observation = env.unwrapped._observation()
    np.testing.assert_array_equal(observation[:7], position[:7])
    np.testing.assert_array_equal(observation[7:14], velocity[:7])
    np.testing.assert_allclose(observation[17:20], [0.9, 0.8, -0.27], atol=1e-12)  # the slide along y comes first
    np.testing.assert_allclose(observation[20:], position[9:12], atol=1e-12)
    paddle = data.geom("paddle").xpos  # a body of one geom has its centre of mass there
    np.testing.assert_allclose(observation[14:17], paddle, atol=1e-12)
    np.testing.assert_allclose(env.unwrapped.get_body_com("tips_arm"), paddle, atol=1e-12)


def test_the_stretched_arm_reaches_as_far_as_its_links(env):
    """Base at (0, -0.6, 0); shoulder 0.1, upper arm 0.4, forearm 0.321, paddle 0.017 along x."""
    env.reset(seed=0)
    env.unwrapped.set_state(env.unwrapped.init_qpos, np.zeros(15))
    np.testing.assert_allclose(env.unwrapped._observation()[14:17], [0.838, -0.6, 0], atol=1e-12)


def expected_rewards(observations, actions):
    """The definition, written out step by step; also the steps before which the tip had come near."""
    least, strike, rewards, struck = np.inf, None, [], []
    for observation, action in zip(observations, actions, strict=False):
        tip, ball, goal = observation[14:17], observation[17:20], observation[20:23]
        least = min(least, np.linalg.norm(ball - goal))
        if strike is None and np.linalg.norm(ball - tip) < 0.1:
            strike = tip
        near = -np.linalg.norm(ball - (tip if strike is None else strike))
        rewards.append((3 * -least + 0.1 * -np.sum(action.astype(float) ** 2) + 0.5 * near, -least))
        struck.append(strike is not None)
    return np.array(rewards), np.array(struck)


def test_rewards_of_a_strike_are_what_the_definition_gives(env):
    observations, rewards, _, _, infos = play(env, STRIKE)
    expected, struck = expected_rewards(observations, STRIKE)
    assert 10 < struck.argmax() < 60  # not struck at first, struck later
    np.testing.assert_allclose(rewards, expected[:, 0], rtol=1e-12)
    np.testing.assert_allclose([info["reward_dist"] for info in infos], expected[:, 1], rtol=1e-12)
    np.testing.assert_allclose([info["reward_ctrl"] for info in infos], -np.square(STRIKE.astype(float)).sum(1))
    ball, goal, tip = observations[:-1, 17:20], observations[:-1, 20:23], observations[:-1, 14:17]
    assert np.ptp(expected[:, 1]) > 0.1  # the ball came nearer to the goal
    # Planted: the present distance instead of the least, or the present tip instead of where it struck, would show.
    assert np.abs(np.linalg.norm(ball - goal, axis=1) + expected[:, 1]).max() > 0.1
    away = np.linalg.norm(ball - tip, axis=1) - np.linalg.norm(ball - tip[struck.argmax()], axis=1)
    assert np.abs(away[struck]).max() > 0.1


def test_the_memory_of_an_episode_ends_with_it(env):
    first = play(env, STRIKE)
    again = play(env, STRIKE)
    np.testing.assert_array_equal(first[1], again[1])


def test_actions_beyond_the_motors_cost_what_was_asked_for(env):
    env.reset(seed=0)
    _, _, _, _, info = env.unwrapped.step(np.full(7, 10.0))
    assert info["reward_ctrl"] == -700
    np.testing.assert_array_equal(env.unwrapped.data.actuator_force, [3.0] * 7)


def test_the_ball_rests_until_it_is_struck_and_then_moves(env):
    observations, *_ = play(env, STRIKE)
    ball, tip = observations[:, 17:19], observations[:, 14:17]
    near = np.linalg.norm(observations[:, 17:20] - tip, axis=1) < 0.15
    untouched = ball[: near.argmax()]
    assert len(untouched) > 5
    np.testing.assert_allclose(untouched, [[0.5, -0.175]] * len(untouched), atol=1e-9)
    assert np.linalg.norm(ball[-1] - ball[0]) > 0.5
    idle, *_ = play(env, np.zeros((100, 7), np.float32))
    np.testing.assert_allclose(idle[-1, 17:19], [0.5, -0.175], atol=1e-9)


def roll(env, position, velocity, steps=100, walls=True):
    """Path of the ball seen from the cup, (steps, 3): the cup at `position` opens towards -y, the ball is at its usual
    start with `velocity`, the arm is left alone."""
    base, model = env.unwrapped, env.unwrapped.model
    env.reset(seed=0)
    for name in ("wall_ahead", "wall_left", "wall_right"):
        model.geom(name).conaffinity = int(walls)
    state, speeds = base.data.qpos.copy(), np.zeros(15)
    state[9:12], state[12:] = [*position, -0.323], [1, 0, 0, 0]
    speeds[7:9] = velocity[::-1]
    base.set_state(state, speeds)
    return np.array([base.step(np.zeros(7))[0][17:20] for _ in range(steps)]) - base.data.body("goal").xpos


@pytest.mark.parametrize("aside", [-0.04, 0.0, 0.04])
def test_the_cup_catches_the_ball_and_keeps_it(env, aside):
    path = roll(env, (0.5 + aside, 0.4), (0, 1.6))
    distance = np.linalg.norm(path[:, :2], axis=1)
    entered = int((distance < 0.06).argmax())
    assert 5 < entered < 50
    assert distance[entered:].max() < 0.09  # the coaster's radius is 0.08
    assert path[:, 1].max() < 0.03  # the wall ahead stands at 0.075, the ball's radius is 0.05
    assert roll(env, (0.5 + aside, 0.4), (0, 1.6), walls=False)[-1, 1] > 0.1  # planted: without walls it rolls on


def test_the_cup_stays_where_it_is_until_it_is_hit(env):
    observations, *_ = play(env, np.zeros((100, 7), np.float32))
    np.testing.assert_allclose(observations[:, 20:], observations[[0] * 101, 20:], atol=1e-9)
    np.testing.assert_allclose(observations[:, 22], -0.323, atol=1e-9)


def test_an_untouched_ball_rolls_out_as_its_damping_says(env):
    """m v' = -0.5 v with m the sphere's mass (300 kg/m^3) and the armature 0.1: it rolls v m / 0.5 far."""
    path = roll(env, (0.15, 1.0), (0.3, -1.0), steps=400)
    mass = 300 * 4 / 3 * np.pi * 0.05**3 + 0.1
    reached = path[-1, :2] + [0.15, 1.0]
    np.testing.assert_allclose(reached, np.array([0.5, -0.175]) + np.array([0.3, -1.0]) * mass / 0.5, atol=0.01)


def test_reset_distribution(env):
    starts = []
    for seed in range(400):
        env.reset(seed=seed)
        starts.append((env.unwrapped.data.qpos.copy(), env.unwrapped.data.qvel.copy()))
    positions, velocities = (np.array(column) for column in zip(*starts, strict=True))
    np.testing.assert_array_equal(positions[:, :7], 0)
    np.testing.assert_array_equal(positions[:, 7:9], [[-0.175, 0.5]] * 400)
    goals = positions[:, 9:11]
    assert stats.kstest(goals[:, 0], stats.uniform(0.15, 0.55).cdf).pvalue > 0.01
    assert stats.kstest(goals[:, 1], stats.uniform(0.1, 0.9).cdf).pvalue > 0.01
    assert abs(stats.pearsonr(*goals.T).statistic) < 0.15
    assert np.linalg.norm(goals - [0.5, -0.175], axis=1).min() > 0.17
    np.testing.assert_array_equal(positions[:, 11], -0.323)
    turn = -np.arctan((0.5 - goals[:, 0]) / (-0.175 - goals[:, 1] + 1e-8)) / 3.14
    np.testing.assert_allclose(positions[:, 15], turn, rtol=1e-12)
    np.testing.assert_array_equal(positions[:, 12:15], [[1, 0, 0]] * 400)
    assert stats.kstest(velocities[:, :7].ravel(), stats.uniform(-0.1, 0.2).cdf).pvalue > 0.01
    np.testing.assert_array_equal(velocities[:, 7:], 0)


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("sign", [-1, 1])
def test_joints_stop_at_their_limits(env, joint, sign):
    """Limits are soft: a motor's whole torque may press a joint 0.1 rad beyond."""
    env.reset(seed=0)
    action = np.zeros(7, np.float32)
    action[joint] = 3 * sign
    angles = np.array([env.unwrapped.step(action)[0][joint] for _ in range(150)])
    low, high = LIMITS[joint]
    assert low - 0.1 < angles.min() <= angles.max() < high + 0.1
    assert abs(angles[-1] - (high if sign > 0 else low)) < 0.1


def test_the_arm_is_pushers(env):
    """Body for body, but for the hand."""
    folder = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets", "pusher.xml")
    ours, pusher = env.unwrapped.model, mujoco.MjModel.from_xml_path(folder)
    links = [
        f"r_{link}_link" for link in ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "upper_arm", "elbow_flex")
    ]
    links += ["r_forearm_roll_link", "r_forearm_link", "r_wrist_flex_link"]
    for link in links:
        for quantity in ("pos", "quat", "mass", "inertia", "ipos"):
            mine, theirs = (getattr(model.body(link), quantity) for model in (ours, pusher))
            np.testing.assert_allclose(mine, theirs, atol=1e-12, err_msg=f"{quantity} of {link}")
    for joint in range(7):
        mine, theirs = ours.joint(joint), pusher.joint(joint)
        assert mine.name == theirs.name
        for quantity in ("axis", "pos", "range", "damping", "armature", "limited", "stiffness", "frictionloss"):
            np.testing.assert_array_equal(getattr(mine, quantity), getattr(theirs, quantity))
        np.testing.assert_array_equal(mine.range, LIMITS[joint])


def test_the_model_is_as_defined(env):
    model = env.unwrapped.model
    assert (model.opt.timestep, model.opt.iterations, env.unwrapped.frame_skip) == (0.01, 20, 5)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert not model.opt.gravity.any()
    np.testing.assert_array_equal(model.dof_damping, [1, 1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.5, 0.5, *[0] * 6])
    np.testing.assert_array_equal(model.dof_armature[:9], [0.04] * 7 + [0.1, 0.1])
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-3, 3]] * 7)
    for name, size in {
        "paddle": (0.003, 0.12, 0.05),
        "wr": (0.02, 0.1, 0),
        "ball": (0.05, 0, 0),
        "wall_left": (0.032, 0.001, 0.04),
    }.items():
        np.testing.assert_allclose(model.geom(name).size, size)
    np.testing.assert_array_equal(model.geom_margin, 0.002)
    np.testing.assert_array_equal(model.geom_condim, 1)
    assert not model.geom_friction.any()
    collide = {name: (g.contype[0], g.conaffinity[0]) for g in map(model.geom, range(model.ngeom)) if (name := g.name)}
    collide = {name: masks for name, masks in collide.items() if any(masks)}
    walls = dict.fromkeys(("wall_ahead", "wall_left", "wall_right"), (0, 1))
    assert collide == walls | {"table": (0, 1), "paddle": (1, 1), "wr": (1, 1), "ball": (1, 0)}
    assert model.body("coaster").mass[0] == pytest.approx(1e6 * np.pi * 0.08**2 * 0.002)


def test_the_paddle_does_not_pass_through_the_table(env):
    env.reset(seed=0)
    down = np.array([0, 3, 0, 0, 0, 0, 0], np.float32)
    lowest = min(env.unwrapped.step(down)[0][16] for _ in range(100))
    assert -0.33 < lowest < -0.2
    env.reset(seed=0)
    env.unwrapped.model.geom("table").conaffinity = 0
    assert min(env.unwrapped.step(down)[0][16] for _ in range(100)) < -0.4  # planted: without the table


def test_an_episode_is_truncated_after_100_steps_and_never_terminates(env):
    _, _, terminated, truncated, _ = play(env, STRIKE)
    np.testing.assert_array_equal(np.flatnonzero(truncated), [99])
    assert not terminated.any()


def test_one_seed_gives_the_same_bits_and_another_seed_others(env):
    first = play(env, STRIKE, seed=5)
    with make_gymnasium("ppo_dap/Striker-v2") as other:
        again, different = play(other, STRIKE, seed=5), play(other, STRIKE, seed=6)
    for one, two in zip(first[:2], again[:2], strict=True):
        assert one.tobytes() == two.tobytes()
    assert not np.array_equal(first[0], different[0])


def test_human_mode_draws_every_step():
    drawn = []

    class Renderer:
        def render(self, mode):
            drawn.append(mode)

        def close(self):
            pass

    with make_gymnasium("Striker-v2", render_mode="human") as env:
        env.unwrapped.mujoco_renderer = Renderer()
        env.reset(seed=0)
        env.step(STRIKE[0])
    assert drawn == ["human"] * 2


RENDER = """
import mujoco
try:
    context = mujoco.GLContext(8, 8)
    context.make_current()
    context.free()
except Exception as error:
    print("no backend:", type(error).__name__, error)
    raise SystemExit
from ppo_dap.tasks.catalogue import make_gymnasium
env = make_gymnasium("Striker-v2", render_mode="rgb_array")
env.reset(seed=0)
image = env.render()
camera = env.unwrapped.mujoco_renderer._get_viewer("rgb_array").cam
print(*image.shape, image.dtype, image.std() > 5, camera.distance)
env.close()
"""


def test_rendering_gives_an_image_from_distance_4():
    reasons = []
    for backend in ("egl", "osmesa"):
        environment = os.environ | {"MUJOCO_GL": backend}
        done = subprocess.run([sys.executable, "-c", RENDER], env=environment, capture_output=True, text=True)
        lines = done.stdout.splitlines() or [f"no backend: exit {done.returncode}, {done.stderr[-300:]}"]
        if not lines[-1].startswith("no backend"):
            assert lines[-1] == "480 480 3 uint8 True 4.0", done.stderr
            return
        reasons.append(f"{backend}: {lines[-1]}")
    pytest.skip("; ".join(reasons))
