"""Hostile `.hdf5` files in D4RL's layout."""

import h5py
import numpy as np

from logs.hostile_tools import ABSURD, cut, flip, maker, pick
from logs.logs_made import make_arrays, write_d4rl


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
