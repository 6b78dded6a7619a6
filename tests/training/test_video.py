"""Films of a policy, with no display."""

import os
import re
import subprocess
import sys

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest

from ppo_dap.cli import main
from ppo_dap.errors import InputError
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks import describe
from ppo_dap.training.video import record_video


def tumbling(task):
    """A policy that always does the same, and so falls soon."""
    spec = describe(task)
    observations, actions = spec.observation_size, spec.action_size
    return Policy(
        (np.zeros((actions, observations), np.float32),),
        (np.full(actions, 0.8, np.float32),),
        np.zeros(actions, np.float32),
        np.zeros(observations, np.float32),
        np.ones(observations, np.float32),
        10.0,
        spec.action_low,
        spec.action_high,
        task,
    )


def film(tmp_path, task):
    """Frames said to be written, and what a decoder finds; skips where nothing can be drawn at all."""
    policy = tumbling(task)
    try:
        frames = record_video(policy, task, tmp_path / "film.mp4", seed=3)
    except InputError as error:
        pytest.skip(str(error))
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "film.mp4"), "-f", "rawvideo", "-pix_fmt", "rgb24"]
    done = subprocess.run([*decode, "-"], capture_output=True)
    about = done.stderr.decode()
    width, height = map(int, re.search(r", (\d+)x(\d+)", about).groups())
    rate = float(re.search(r"([\d.]+) fps", about)[1])
    return frames, rate, np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3).astype(int)


def test_a_film_shows_the_episode_in_real_time(tmp_path):
    frames, rate, pictures = film(tmp_path, "Hopper-v5")
    env, steps, ended = gymnasium.make("Hopper-v5"), 0, False
    env.reset(seed=3)
    while not ended:
        _, _, terminated, truncated, _ = env.step(np.full(3, 0.8, np.float32))
        steps, ended = steps + 1, terminated or truncated
    assert frames == len(pictures) == -(-steps // 4)  # 125 steps a second, of which every fourth is shown
    assert rate == pytest.approx(31.25)
    first, last = pictures[0], pictures[-1]
    assert np.abs(first - last).mean() > 1
    # The hopper is the only thing that is brown: the camera has it in view to the end.
    for picture in (first, last):
        assert ((picture[..., 0] - picture[..., 2]) > 40).sum() > 200
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_where_nothing_can_be_drawn_it_is_said(tmp_path):
    """MUJOCO_GL is read when mujoco is imported, so in a process of its own; glfw needs a display."""
    code = f"""
import sys
sys.path.insert(0, {str(os.path.dirname(__file__))!r})
from test_video import tumbling
from ppo_dap.errors import InputError
from ppo_dap.training.video import record_video
try:
    record_video(tumbling("Hopper-v5"), "Hopper-v5", {str(tmp_path / "film.mp4")!r})
except InputError as error:
    print("SAID", error)
"""
    env = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=env | {"MUJOCO_GL": "glfw"}, capture_output=True, text=True
    )
    assert done.stdout.startswith("SAID task Hopper-v5 cannot be drawn with MUJOCO_GL glfw"), done.stderr[-500:]
    assert "set MUJOCO_GL to egl" in done.stdout
    assert done.stdout.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_task_that_draws_nothing_is_refused(tmp_path):
    with pytest.raises(InputError, match="Taxi-v3"):
        record_video(tumbling("Hopper-v5"), "Taxi-v3", tmp_path / "film.mp4")


@pytest.mark.parametrize(("name", "message"), [("film.avi", "must be an .mp4"), ("no/film.mp4", "there is no folder")])
def test_a_film_that_cannot_be_written_is_refused_before_the_work(name, message, tmp_path, capsys, run_folder):
    assert main(["evaluate", str(run_folder), "--video", str(tmp_path / name)]) == 2
    out = capsys.readouterr()
    assert message in out.err
    assert not out.out


def test_without_the_extra_it_says_which(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"pip install ppo-dap\[video\]"):
        record_video(tumbling("Hopper-v5"), "Hopper-v5", tmp_path / "film.mp4")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory, small):
    import ppo_dap

    out = tmp_path_factory.mktemp("run") / "run"
    ppo_dap.train("Pendulum-v1", "ppo", out=out, steps=130, progress=False, **small)
    return out
