"""Hostile `.npz` files."""

import functools
import io
import pickle
import struct
import zipfile

import numpy as np

from logs.hostile_tools import ABSURD, Payload, cut, flip, maker, pick
from logs.logs_made import make_arrays, write_npz


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
