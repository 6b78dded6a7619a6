"""A film of a policy: one episode of the deterministic policy as an mp4, with or without a display."""

from __future__ import annotations

import os
import secrets
import sys
import warnings
from pathlib import Path
from typing import Any

from ppo_dap.errors import InputError
from ppo_dap.nets.policy import Policy
from ppo_dap.tasks.catalogue import make_gymnasium

FRAMES_PER_SECOND = 30
CAMERA = "track"
HOW = "set MUJOCO_GL to egl (needs libEGL) or osmesa (needs libOSMesa), or run where there is a display"


def require_video(path: str | Path) -> Path:
    """`path` if a film can be written there and the extra is installed; raises `InputError` before any work is done."""
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"video {path} must be an .mp4 file")
    if not path.parent.is_dir():
        raise InputError(f"video {path}: there is no folder {path.parent}")
    try:
        import imageio_ffmpeg  # noqa: F401 (asked for here, so that the error comes before the film)
    except ImportError:
        raise InputError("a video needs the extra `video`: pip install ppo-dap[video]") from None
    return path


def record_video(policy: Policy, task: str, path: str | Path, seed: int = 0) -> int:
    """Write one episode of `policy` on `task` to the .mp4 file `path`; returns its number of frames.

    Raises `InputError` where the task cannot be drawn, says so when there is no GL, and leaves no half of a film.
    """
    path = require_video(path)
    headless = sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if headless:
        os.environ.setdefault("MUJOCO_GL", "egl")
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.mp4")
    env = _make(task)
    try:
        observation, _ = env.reset(seed=seed)
        return _film(env, policy, observation, _first_frame(env, task), partial, path)
    finally:
        partial.unlink(missing_ok=True)
        env.close()


def _make(task: str) -> Any:
    """The task with a camera that follows the robot, where its model has one; Gymnasium's own stays where it began."""
    env = make_gymnasium(task, render_mode="rgb_array")
    model = getattr(env.unwrapped, "model", None)
    if type(model).__name__ != "MjModel":
        return env
    import mujoco as bindings

    mujoco: Any = bindings  # its stubs do not say what is in it

    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, CAMERA) < 0:
        return env
    env.close()
    return make_gymnasium(task, render_mode="rgb_array", camera_name=CAMERA)


def _first_frame(env: Any, task: str) -> Any:
    try:
        frame = env.render()
    except Exception as error:  # each backend of MuJoCo's has errors of its own, down to AttributeError
        text = " ".join(str(error).split()) or type(error).__name__
        backend = os.environ.get("MUJOCO_GL", "the default")
        raise InputError(f"task {task} cannot be drawn with MUJOCO_GL {backend} ({text}): {HOW}") from error
    if getattr(frame, "ndim", 0) != 3:
        raise InputError(f"task {task} draws no pictures: it must support render_mode rgb_array")
    return frame


def _film(env: Any, policy: Policy, observation: Any, frame: Any, partial: Path, path: Path) -> int:
    import imageio.v2 as imageio

    # In real time, but no more pictures a second than the eye needs: without a graphics card each takes a tenth of one.
    rate = env.metadata.get("render_fps", FRAMES_PER_SECOND)
    every = max(1, round(rate / FRAMES_PER_SECOND))
    frames, steps, ended = 0, 0, False
    # The default of macro_block_size would resize odd pictures with a warning; 2 is what the codec needs.
    with warnings.catch_warnings(), imageio.get_writer(partial, fps=rate / every, macro_block_size=2) as film:
        # JAX warns of every fork; imageio's child does nothing but become ffmpeg.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)
        while not ended:
            if steps % every == 0:
                film.append_data(frame if steps == 0 else env.render())  # type: ignore[attr-defined]
                frames += 1
            observation, _, terminated, truncated, _ = env.step(policy(observation))
            ended, steps = terminated or truncated, steps + 1
    os.replace(partial, path)
    return frames
