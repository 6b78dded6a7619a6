"""The same episodes as tables and as LeRobot datasets, in both versions of the layout."""

import csv
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from logs.logs_made import LENGTHS, make_arrays


def make_columns(arrays=None, lengths=LENGTHS):
    """One column a name, as a robot's own logger would write them."""
    arrays = arrays or make_arrays(lengths)
    columns = {f"obs_{i}": column for i, column in enumerate(arrays["observations"].T)}
    columns |= {f"act_{i}": column for i, column in enumerate(arrays["actions"].T)}
    columns |= {"reward": arrays["rewards"], "terminated": arrays["terminated"], "truncated": arrays["truncated"]}
    return {"episode": np.repeat(np.arange(len(lengths)), lengths), **columns}


def write_csv(path, columns=None, **changes):
    columns = {**(columns or make_columns()), **changes}
    columns = {name: column for name, column in columns.items() if column is not None}
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(list(column) for column in columns.values()), strict=True))
    return path


def write_parquet(path, columns=None, row_group_size=5, **changes):
    columns = {**(columns or make_columns()), **changes}
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    pq.write_table(table, path, row_group_size=row_group_size, write_page_checksum=True)
    return path


def write_lerobot(folder, version="v2.1", lengths=LENGTHS, scalars=False, **info):
    """A LeRobot dataset as its own writer lays it out: a file an episode (v2.1), or two files of several (v3.0)."""
    arrays = make_arrays(lengths)
    frames = np.concatenate([np.arange(length) for length in lengths])
    table = pa.table(
        {
            "observation.state": list(arrays["observations"]),
            "action": list(arrays["actions"][:, 0] if scalars else arrays["actions"]),
            "next.reward": arrays["rewards"],
            "next.done": arrays["terminated"] | arrays["truncated"],
            "timestamp": (frames / 10).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "index": np.arange(sum(lengths)),
            "task_index": np.zeros(sum(lengths), int),
        }
    )
    stops = np.cumsum(lengths)
    if version.startswith("v2"):
        name, cuts = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet", stops
    else:
        name, cuts = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", [stops[1], stops[-1]]
    start = 0
    for number, stop in enumerate(cuts):
        path = folder / name.format(episode_chunk=0, chunk_index=0, episode_index=number, file_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table.slice(start, stop - start), path)
        start = stop
    (folder / "meta").mkdir()
    described = {"codebase_version": version, "total_episodes": len(lengths), "total_frames": sum(lengths), "fps": 10}
    features = {"observation.state": {"dtype": "float32", "shape": [3]}, "action": {"dtype": "float32", "shape": [2]}}
    text = json.dumps({**described, "data_path": name, "features": features, **info})
    (folder / "meta" / "info.json").write_text(text)
    return folder
