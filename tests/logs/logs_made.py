"""The same small episodes in every layout, for the tests of ppo_dap.logs."""

import json
import warnings

import h5py
import numpy as np
import pytest

from ppo_dap.errors import InputError
from ppo_dap.logs import Logs, load_logs

LENGTHS = (4, 3, 5)
DROP = "drop"


def make_arrays(lengths=LENGTHS, observation_size=3, action_size=2, seed=0):
    """Hand-made episodes: the first ends by termination, every other one by a timeout."""
    rng = np.random.default_rng(seed)
    rows = sum(lengths)
    ends = np.zeros(rows, bool)
    ends[np.cumsum(lengths) - 1] = True
    terminated = np.zeros(rows, bool)
    terminated[lengths[0] - 1] = True
    return {
        "observations": rng.normal(size=(rows, observation_size)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, action_size)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "terminated": terminated,
        "truncated": ends & ~terminated,
    }


def make_logs(lengths=LENGTHS, **changes):
    arrays = make_arrays(lengths)
    ends = arrays["terminated"] | arrays.pop("truncated")
    return Logs(**{**arrays, "episode_ends": ends, **changes})


def write_npz(path, **changes):
    np.savez(path, **{key: value for key, value in {**make_arrays(), **changes}.items() if value is not None})
    return path


def write_d4rl(path, **changes):
    arrays = make_arrays()
    arrays["terminals"], arrays["timeouts"] = arrays.pop("terminated"), arrays.pop("truncated")
    with h5py.File(path, "w") as file:
        for key, value in {**arrays, **changes}.items():
            if value is not None:
                file[key] = value
    return path


def write_minari(root, monkeypatch, dataset_id="hand/made-v0", data_format="hdf5", lengths=LENGTHS):
    """The same episodes, written by the official library; returns the dataset's folder."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    import gymnasium as gym
    import minari
    from minari.data_collector import EpisodeBuffer

    arrays, buffers, start = make_arrays(lengths), [], 0
    for number, length in enumerate(lengths):
        rows = slice(start, start + length)
        last = np.full((1, 3), 99.0, np.float32)  # the final observation, which no action follows
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=list(np.concatenate([arrays["observations"][rows], last])),
                actions=list(arrays["actions"][rows]),
                rewards=list(arrays["rewards"][rows]),
                terminations=list(arrays["terminated"][rows]),
                truncations=list(arrays["truncated"][rows]),
            )
        )
        start += length
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # minari warns about each optional field that is not given
        minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            observation_space=gym.spaces.Box(-np.inf, np.inf, (3,), np.float32),
            action_space=gym.spaces.Box(-1, 2, (2,), np.float32),
            data_format=data_format,
        )
    return root / dataset_id


def edit_metadata(folder, **changes):
    path = folder / "data" / "metadata.json"
    metadata = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in metadata.items() if value is not DROP}))


def fails(source, match, **options):
    """`load_logs` must raise one line that matches; returns the line."""
    with pytest.raises(InputError, match=match) as caught:
        load_logs(source, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def level(report, name):
    return next(line for line in report.lines if line.name == name).level


def message(report, name):
    return next(line for line in report.lines if line.name == name).message


def pendulums(num_episodes=30, length=60, seed=0):
    """Three driven pendulums, semi-implicit Euler, reset near rest: D4RL arrays with every timeout marked."""
    rng = np.random.default_rng(seed)
    arrays = {"observations": [], "actions": [], "timeouts": []}
    for _ in range(num_episodes):
        angle, speed = rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3)
        for t in range(length):
            action = np.clip(np.sin(0.2 * t + np.arange(3)) + 0.3 * rng.normal(size=3), -1, 1)
            arrays["observations"].append(np.concatenate([angle, speed]))
            arrays["actions"].append(action)
            arrays["timeouts"].append(t == length - 1)
            for _ in range(5):
                speed = speed + 0.01 * (20 * action - 9.8 * np.sin(angle) - 0.1 * speed)
                angle = angle + 0.01 * speed
    return {name: np.array(values) for name, values in arrays.items()}
