"""Damaged and hostile logs, each from a seed: `MAKERS[kind](folder, rng)` returns the path to load.

A kind whose name ends in `_loose` may load as other values: its maker wrote others, or its layout has no checksum, so
that nobody could tell. All others must be refused, be warned about, or load exactly.
"""

import functools
import io
import json
import os
import pickle
import shutil
import struct
import zipfile

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from logs.logs_made import LENGTHS, make_arrays, write_d4rl, write_npz
from logs.tables_made import make_columns, write_csv, write_lerobot, write_parquet

MAKERS = {}
ABSURD = (10**15, 2**62, 2**63 - 1, 2**31, 10**9)


def maker(function):
    MAKERS[function.__name__] = function
    return function


def pick(rng, options):
    return options[rng.integers(len(options))]


def cut(path, rng):
    content = path.read_bytes()
    path.write_bytes(content[: rng.integers(len(content))])
    return path


def flip(path, rng, spared=(), most=6):
    """Change a few bytes, but none within the spared (start, stop)."""
    content = bytearray(path.read_bytes())
    places = [p for p in range(len(content)) if not any(start <= p < stop for start, stop in spared)]
    for place in rng.choice(places, size=rng.integers(1, most + 1)):
        content[place] ^= 1 << rng.integers(8)
    path.write_bytes(content)
    return path


def npy(shape, data=b"", descr="<f4", order=False):
    header = f"{{'descr': {descr!r}, 'fortran_order': {order}, 'shape': {shape}}}"
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


def archive(path, members, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in members:
            file.writestr(name, content)
    return path


@maker
def npz_cut(folder, rng):
    return cut(write_npz(folder / "a.npz"), rng)


@maker
def npz_flipped(folder, rng):
    return flip(write_npz(folder / "a.npz"), rng)


@maker
def npz_absurd_shape(folder, rng):
    size = pick(rng, ABSURD)
    shapes = [(size, 3), (5, size), (-size, 3), (-5, -3), (size, 0), (size, size), (0, size), (size,) * 32]
    data = bytes(60) if rng.random() < 0.5 else b""
    order = bool(rng.integers(2))
    first = ("observations.npy", npy(pick(rng, shapes), data, order=order))
    return archive(folder / "a.npz", [first, ("actions.npy", npy((5, 1), bytes(20)))])


@maker
def npz_odd_dtype(folder, rng):
    kinds = ["|S0", "|V0", "<M8[ns]", "<c16", "<U1", "|O", "<f16", "|b1", [("a", "<f4")], ("<f4", (3,)), "junk", "", 3]
    first = ("observations.npy", npy(pick(rng, [(5, 3), (10**15, 3)]), bytes(60), pick(rng, kinds)))
    return archive(folder / "a.npz", [first, ("actions.npy", npy((5, 1), bytes(20)))])


class Payload:
    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return open, (str(self.canary), "w")


@maker
def npz_pickled(folder, rng):
    arrays = make_arrays()
    name = pick(rng, [*arrays, "task", "episode_id", "action_low"])
    payload = np.array([Payload(folder.parent / "canary")] * 12, dtype=object)
    content = {key: value for key, value in arrays.items() if key != name}
    with open(folder / "a.npz", "wb") as file:
        np.savez(file, **content, **{name: payload if rng.random() < 0.5 else payload[0]})
    return folder / "a.npz"


@maker
def npz_is_a_pickle(folder, rng):
    path = folder / pick(rng, ["a.npz", "a.hdf5", "a.parquet", "a.csv"])
    path.write_bytes(pickle.dumps(Payload(folder.parent / "canary")))
    return path


@maker
def npz_bomb(folder, rng):
    """Zeros that unpack to a thousand times the file, of the declared shape or of another one."""
    (folder / "a.npz").write_bytes(zeros(3 if rng.random() < 0.5 else 30))
    return folder / "a.npz"


@functools.cache
def zeros(columns, rows=8_000_000):
    first = ("observations.npy", npy((rows, columns), bytes(rows * 12)))
    content = io.BytesIO()
    archive(content, [first, ("actions.npy", npy((rows, 1), bytes(rows * 4)))])
    return content.getvalue()


@maker
def npz_names(folder, rng):
    name = pick(rng, ["../observations.npy", "/observations.npy", "a/b.npy", "..\\a.npy", "observations", "\n.npy", ""])
    members = [(f"{key}.npy", npy((5, 1), bytes(20))) for key in ("observations", "actions")]
    return archive(folder / "a.npz", [*members, (name or "x" * 60_000 + ".npy", npy((5,), bytes(20)))])


@maker
def npz_sizes_that_lie(folder, rng):
    """Sizes in the zip's own directory, which is read before anything else."""
    content = bytearray(write_npz(folder / "a.npz").read_bytes())
    start = content.find(b"PK\x01\x02")
    struct.pack_into("<I", content, start + pick(rng, [20, 24, 42]), int(rng.integers(2**32)))
    (folder / "a.npz").write_bytes(content)
    return folder / "a.npz"


def latest(path):
    """A D4RL file in the newest HDF5 format, whose headers have checksums; and where its data lie."""
    arrays = make_arrays()
    arrays["terminals"], arrays["timeouts"] = arrays.pop("terminated"), arrays.pop("truncated")
    with h5py.File(path, "w", libver="latest") as file:
        for name, value in arrays.items():
            file[name] = value
        return [(d.id.get_offset(), d.id.get_offset() + d.id.get_storage_size()) for d in file.values()]


@maker
def hdf5_cut(folder, rng):
    return cut(write_d4rl(folder / "a.hdf5"), rng)


@maker
def hdf5_flipped_loose(folder, rng):
    return flip(write_d4rl(folder / "a.hdf5"), rng)


@maker
def hdf5_flipped_headers(folder, rng):
    spared = latest(folder / "a.hdf5")
    return flip(folder / "a.hdf5", rng, spared)


@maker
def hdf5_links(folder, rng):
    other = write_d4rl(folder / "other.hdf5")
    links = [h5py.ExternalLink(other.name, "rewards"), h5py.SoftLink("/actions"), h5py.SoftLink("/nothing")]
    links += [h5py.ExternalLink("/dev/zero", "x"), h5py.SoftLink("/rewards")]
    return write_d4rl(folder / "a.hdf5", **{pick(rng, ["rewards", "observations", "timeouts"]): pick(rng, links)})


@maker
def hdf5_stored_elsewhere(folder, rng):
    (folder / "secret").write_bytes(bytes(1000))
    path = write_d4rl(folder / "a.hdf5", rewards=None)
    with h5py.File(path, "a") as file:
        if rng.random() < 0.5:
            file.create_dataset("rewards", (12,), "f4", external=[(str(folder / "secret"), 0, 48)])
        else:
            layout = h5py.VirtualLayout((12,), "f4")
            layout[:] = h5py.VirtualSource(write_d4rl(folder / "other.hdf5"), "rewards", (12,))
            file.create_virtual_dataset("rewards", layout)
    return path


@maker
def hdf5_absurd(folder, rng):
    """Chunked fill values: 10^15 rows that take no room."""
    path, rows = write_d4rl(folder / "a.hdf5", observations=None, actions=None), pick(rng, ABSURD[:4])
    with h5py.File(path, "a") as file:
        for name, columns in (("observations", 3), ("actions", 1)):
            packed = {"compression": "gzip"} if rng.random() < 0.5 else {}
            chunks = pick(rng, [(1024, columns), (2**28, columns)])
            file.create_dataset(name, (rows, columns), "f4", chunks=chunks, fillvalue=1.0, **packed)
    return path


@maker
def hdf5_odd_types(folder, rng):
    odd = [
        np.array(["text"] * 12, dtype=h5py.string_dtype()),
        np.zeros(12, [("a", "f4"), ("b", "i8")]),
        np.zeros((12, 2, 2)),
        np.zeros((0, 3)),
        np.zeros((12, 0)),
        np.zeros(12, complex),
        h5py.Empty("f4"),
        np.float64(3),
        np.full((12, 3), 1e300),
    ]
    return write_d4rl(folder / "a.hdf5", **{pick(rng, ["observations", "actions", "rewards"]): pick(rng, odd)})


@maker
def hdf5_groups(folder, rng):
    path = write_d4rl(folder / "a.hdf5", observations=None)
    with h5py.File(path, "a") as file:
        if rng.random() < 0.5:
            file["observations"] = file["/"]  # a circle
        else:
            file.create_group("/".join(["observations"] + ["x"] * 300))
    return path


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
    texts = ["", "[]", "{", "null", "3", deep if (deep := "[" * 100_000) else "", "\0", "9" * 10_000]
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


@maker
def not_a_file(folder, rng):
    path = folder / ("a" + pick(rng, [".npz", ".hdf5", ".h5", ".csv", ".parquet"]))
    what = rng.integers(5)
    if what == 0:
        os.mkfifo(path)
    if what == 1:
        path.mkdir()
    if what == 2:
        path.symlink_to("/dev/zero")
    if what == 3:
        path.symlink_to(path)
    if what == 4:
        path.touch()
    return path


@maker
def another_format(folder, rng):
    """A whole file under the name of another format."""
    made = [write_npz(folder / "1.npz"), write_d4rl(folder / "1.hdf5"), write_csv(folder / "1.csv")]
    made.append(write_parquet(folder / "1.parquet"))
    content = pick(rng, made).read_bytes()
    path = folder / ("a" + pick(rng, [".npz", ".hdf5", ".csv", ".parquet"]))
    path.write_bytes(content)
    return path
