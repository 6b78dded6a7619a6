"""Hostile Minari folders."""

import json
import os
import shutil

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from logs.hostile_tools import cut, flip, maker, pick
from logs.logs_made import LENGTHS, make_arrays


def minari_hdf5(folder, metadata=None):
    """Minari's own layout, by hand: its library takes seconds to import."""
    data = folder / "set" / "data"
    data.mkdir(parents=True)
    arrays, stops = make_arrays(), np.cumsum(LENGTHS)
    with h5py.File(data / "main_data.hdf5", "w") as file:
        for number, (stop, length) in enumerate(zip(stops, LENGTHS, strict=True)):
            rows = slice(stop - length, stop)
            group = file.create_group(f"episode_{number}")
            group["observations"] = np.concatenate([arrays["observations"][rows], np.zeros((1, 3), np.float32)])
            group["terminations"], group["truncations"] = arrays["terminated"][rows], arrays["truncated"][rows]
            group["actions"], group["rewards"] = arrays["actions"][rows], arrays["rewards"][rows]
    (data / "metadata.json").write_text(json.dumps({"data_format": "hdf5", **(metadata or {})}))
    return folder / "set"


def minari_arrow(folder, layout="arrow"):
    data = folder / "set" / "data"
    arrays, start = make_arrays(), 0
    for number, length in enumerate(LENGTHS):
        (data / str(number)).mkdir(parents=True)
        rows = np.minimum(np.arange(start, start + length + 1), start + length - 1)
        table = pa.table(
            {
                "observations": pa.FixedSizeListArray.from_arrays(arrays["observations"][rows].reshape(-1), 3),
                "actions": pa.FixedSizeListArray.from_arrays(arrays["actions"][rows].reshape(-1), 2),
                "rewards": arrays["rewards"][rows],
                "terminations": arrays["terminated"][rows],
                "truncations": arrays["truncated"][rows],
            }
        )
        if layout == "arrow":
            with pa.ipc.new_file(data / str(number) / "part-0.arrow", table.schema) as file:
                file.write_table(table)
        else:
            pq.write_table(table, data / str(number) / "part-0.parquet", write_page_checksum=True)
        start += length
    (data / "metadata.json").write_text(json.dumps({"data_format": layout}))
    return folder / "set"


@maker
def minari_metadata(folder, rng):
    deep = '{"a":' * 5000 + "1" + "}" * 5000
    box = {"type": "Box", "low": [-1, -1], "high": [1, 1], "shape": [2], "dtype": "float32"}
    odd = [
        {"action_space": json.dumps({**box, "low": "x"})},
        {"action_space": json.dumps({**box, "low": [0] * 10**5})},
        {"action_space": json.dumps({**box, "shape": 2})},
        {"action_space": json.dumps({**box, "shape": [10**15]})},
        {"action_space": json.dumps({**box, "low": [float("nan"), 0]})},
        {"action_space": json.dumps([box])},
        {"action_space": 3},
        {"observation_space": deep},
        {
            "env_spec": json.dumps(
                {"id": "Pendulum-v1", "entry_point": "os:system", "kwargs": {"command": "touch canary"}}
            )
        },
        {"env_spec": json.dumps(["Hopper-v5"])},
        {"env_spec": json.dumps({"id": ["a"]})},
        {"env_spec": json.dumps({"id": " "})},
        {"data_format": "../../x"},
        {"data_format": ["arrow"]},
        {"data_format": "parquet"},
    ]
    return minari_hdf5(folder, pick(rng, odd))


@maker
def minari_metadata_text(folder, rng):
    path = minari_hdf5(folder)
    texts = ["", "[]", "{", "null", "3", "[" * 100_000, "\0", "9" * 10_000]
    (path / "data" / "metadata.json").write_text(pick(rng, texts))
    return path


@maker
def minari_data(folder, rng):
    path = minari_hdf5(folder)
    main = path / "data" / "main_data.hdf5"
    what = rng.integers(6)
    if what < 3:
        with h5py.File(main, "a") as file:
            del file["episode_1"]
            shutil.copy(main, folder / "other.hdf5")
            links = [h5py.ExternalLink("../../other.hdf5", "episode_0"), h5py.SoftLink("/episode_0"), file["/"]]
            file["episode_1"] = links[what]
        return path
    main.unlink()
    if what == 3:
        os.mkfifo(main)
    if what == 4:
        main.symlink_to("/dev/zero")
    if what == 5:
        main.mkdir()
    return path


@maker
def minari_arrow_flipped_loose(folder, rng):
    path = minari_arrow(folder)
    flip(path / "data" / str(rng.integers(3)) / "part-0.arrow", rng)
    return path


@maker
def minari_arrow_cut(folder, rng):
    path = minari_arrow(folder)
    cut(path / "data" / str(rng.integers(3)) / "part-0.arrow", rng)
    return path


@maker
def minari_parquet_flipped(folder, rng):
    path = minari_arrow(folder, "parquet")
    flip(path / "data" / str(rng.integers(3)) / "part-0.parquet", rng)
    return path
