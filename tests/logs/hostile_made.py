"""All makers of damaged and hostile logs, and those of no one layout."""

import os

from logs import hostile_hdf5, hostile_minari, hostile_npz, hostile_tables  # noqa: F401 (each adds its makers to MAKERS)
from logs.hostile_tools import MAKERS, maker, pick  # noqa: F401 (MAKERS is what this file is for)
from logs.logs_made import write_d4rl, write_npz
from logs.tables_made import write_csv, write_parquet


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
