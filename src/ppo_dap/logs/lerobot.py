"""LeRobot datasets, versions 2 and 3: Parquet files in data/chunk-*/, of one episode each (v2) or of many (v3)."""

import itertools
import re
import warnings
from pathlib import Path

from ppo_dap.errors import InputError
from ppo_dap.logs.columns import Columns
from ppo_dap.logs.dataset import Logs, LogsWarning
from ppo_dap.logs.reading import assemble, read_json, reading
from ppo_dap.logs.sampling import Budget
from ppo_dap.logs.tables import parquet_pieces

INFO = "meta/info.json"
LEROBOT_COLUMNS = {"observations": "observation.state", "actions": "action"}
"""LeRobot's own names where a state is one vector; its other names are among `OPTIONAL` of the columns."""
MISSING_FILES = "must have Parquet files in data/chunk-*: was the dataset downloaded in full?"


def is_lerobot_folder(folder: Path) -> bool:
    """Whether `folder` is a LeRobot dataset."""
    return (folder / INFO).is_file()


def read_lerobot(folder: Path, columns: Columns | None, budget: Budget) -> Logs:
    """Read a LeRobot dataset's states and actions; its images, videos and language are left where they are.

    `next.done` ends an episode, as a change of `episode_index` does, but says nothing about why it ended.

    Warns with `LogsWarning` when rows are missing. Raises `InputError` in one line for other versions, files that are
    not where this reader looks, and damage.
    """
    with reading(folder):
        info = read_json(folder / INFO)
        version, place = info.get("codebase_version"), info.get("data_path", "data/chunk-")
        if not (isinstance(version, str) and re.fullmatch(r"v[23]\.\d+", version)):
            raise InputError(f"{INFO} has codebase_version {version!r}: must be v2.x or v3.x")
        if not (isinstance(place, str) and place.startswith("data/chunk-") and ".." not in place):
            raise InputError(f"{INFO} has data_path {place!r}: must begin with data/chunk-")
        files = sorted((folder / "data").glob("chunk-*/*.parquet"), key=_by_numbers)
        if not files:
            raise InputError(f"{folder / 'data'} has no files: {MISSING_FILES}")
        chosen = {**LEROBOT_COLUMNS, **(columns or {})}
        pieces = itertools.chain.from_iterable(parquet_pieces(file, chosen, warn=False) for file in files)
        logs = assemble(folder, pieces, budget)
        rows = logs.num_rows if logs.drawn is None else logs.drawn["of_rows"]
        if info.get("total_frames", rows) != rows:
            message = f"{INFO} says {info['total_frames']} frames, but {rows} are there"
            warnings.warn(f"{folder}: {message}: was the dataset downloaded in full?", LogsWarning, stacklevel=3)
        return logs


def _by_numbers(file: Path) -> list[tuple[int, str]]:
    """A key that puts file-1000 behind file-999."""
    parts = re.findall(r"\d+|\D+", f"{file.parent.name}/{file.name}")
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
