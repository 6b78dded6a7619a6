"""Hostile tables: Parquet, CSV and LeRobot."""

import os

import pyarrow as pa

from logs.hostile_tools import cut, flip, maker, pick
from logs.tables_made import make_columns, write_csv, write_lerobot, write_parquet


@maker
def parquet_cut(folder, rng):
    return cut(write_parquet(folder / "a.parquet"), rng)


@maker
def parquet_flipped(folder, rng):
    return flip(write_parquet(folder / "a.parquet"), rng)


@maker
def parquet_odd_columns_loose(folder, rng):
    odd = [
        pa.array([[[1.0]]] * 12),
        pa.array([[1.0, 2.0]] * 11 + [[1.0]]),
        pa.array([[1.0, None]] * 12),
        pa.array([None] * 12),
        pa.array([{"a": 1}] * 12),
        pa.array([b"x"] * 12),
        pa.array(["x"] * 12),
        pa.array([[]] * 12, pa.list_(pa.float32())),
        pa.array([0] * 12, pa.timestamp("s")),
        pa.array([float("nan")] * 12),
        pa.array([2**63] * 12, pa.uint64()),
        pa.array([1] * 12, pa.decimal128(38, 10)).dictionary_encode(),
    ]
    name = pick(rng, ["obs_0", "act_1", "reward", "episode", "terminated", "step"])
    return write_parquet(folder / "a.parquet", **{name: pick(rng, odd)})


@maker
def parquet_missing_columns_loose(folder, rng):
    columns = make_columns()
    for name in rng.choice(list(columns), size=rng.integers(1, len(columns)), replace=False):
        del columns[str(name)]
    return write_parquet(folder / "a.parquet", columns)


@maker
def csv_ragged(folder, rng):
    lines = write_csv(folder / "a.csv").read_text().splitlines()
    number = rng.integers(len(lines))
    lines[number] += pick(rng, [",1", ",,,,", ',"', '"', ",\0", "x", ",nan", "\r1", ",1" * 10_000])
    (folder / "a.csv").write_text("\n".join(lines))
    return folder / "a.csv"


@maker
def csv_cells(folder, rng):
    lines = [line.split(",") for line in write_csv(folder / "a.csv").read_text().splitlines()]
    junk = ["", "nan", "inf", "1e999", "0x10", "one", "1,5", '"1"x', "=1+1", "-", "9" * 400, "\u0663", "x" * 10**6]
    lines[rng.integers(1, 13)][rng.integers(1, 9)] = pick(rng, junk)  # an episode may have any name
    (folder / "a.csv").write_text("\n".join(",".join(line) for line in lines))
    return folder / "a.csv"


@maker
def csv_junk(folder, rng):
    whole = write_csv(folder / "a.csv").read_bytes()
    first = whole.splitlines()[0]
    contents = [
        rng.bytes(2000),
        first,
        first + b"\n" + rng.bytes(2000),
        b"\n" * 1000,
        first + b"\n" + b"," * 2_000_000,
        first + b"\n" + b"1" * 2_000_000,
        whole.decode().encode("utf-16"),
        b"obs_0," * 100_000 + b"act_0\n",
        b'"' + whole,
        first + b"," + first + b"\n",
        whole[len(first) :],
        b"\0" * 10_000,
    ]
    (folder / "a.csv").write_bytes(pick(rng, contents))
    return folder / "a.csv"


def version(rng):
    return pick(rng, ["v2.1", "v3.0"])


@maker
def lerobot_info(folder, rng):
    odd = [
        {"data_path": "../../{episode_index}.parquet"},
        {"data_path": "/etc/{episode_chunk}"},
        {"data_path": "data/chunk-{episode_chunk.__class__.__init__.__globals__}"},
        {"data_path": ["data"]},
        {"data_path": "data/chunk-" + "{x:999999999d}"},
        {"codebase_version": ["v2.1"]},
        {"codebase_version": "v2." + "9" * 5000},
        {"total_frames": 10**30},
        {"total_frames": {}},
        {"features": 3, "chunks_size": -1, "total_episodes": 10**18},
    ]
    return write_lerobot(folder / "set", **{"version": version(rng), **pick(rng, odd)})


@maker
def lerobot_info_text(folder, rng):
    path = write_lerobot(folder / "set", version(rng))
    texts = [
        "",
        "[]",
        "{",
        "null",
        '"v2.1"',
        "[" * 100_000,
        '{"a":' * 5000,
        "\ufeff{}",
        "9" * 10_000,
        "\0",
        '{"a": NaN}',
    ]
    (path / "meta" / "info.json").write_text(pick(rng, texts))
    return path


@maker
def lerobot_data(folder, rng):
    path = write_lerobot(folder / "set", "v2.1")
    first = sorted(path.glob("data/*/*"))[rng.integers(3)]
    what = rng.integers(7)
    if what == 0:
        cut(first, rng)
    else:
        first.unlink()
    if what == 1:
        first.symlink_to("/dev/zero")
    if what == 2:
        os.mkfifo(first)
    if what == 3:
        first.mkdir()
    if what == 4:
        first.symlink_to(folder / "nowhere.parquet")
    if what == 5:
        first.symlink_to("/etc/passwd")
    if what == 6:
        first.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n")
    return path
