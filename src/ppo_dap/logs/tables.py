"""Tables of rows with an episode column, CSV and Parquet, read a piece at a time with pyarrow."""

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ppo_dap.errors import InputError
from ppo_dap.logs.columns import Columns, choose_columns
from ppo_dap.logs.dataset import Logs, LogsWarning
from ppo_dap.logs.reading import PIECE_BYTES, assemble, reading, refuse_large, require_file
from ppo_dap.logs.sampling import Budget, Rows

MOST_ROWS = 2**16  # in a piece
CSV_BLOCK = 2**19
"""Bytes of text at a time, and so the longest row; pyarrow reads 32 of these ahead."""
TRUE = ["1", "1.0", "true", "True", "TRUE", "1.000000000000000000e+00"]
FALSE = ["0", "0.0", "false", "False", "FALSE", "0.000000000000000000e+00"]
"""Flags in a CSV; the last is what numpy.savetxt makes of them."""
FLAGS = ("terminated", "truncated", "done")


@contextmanager
def arrow(path: Path) -> Iterator[Any]:
    """The module pyarrow, for reading the file `path`. Raises `InputError` without it, and for what it raises."""
    require_file(path)
    try:
        import pyarrow
        from pyarrow import ArrowException
    except ImportError:
        raise InputError(f"{path}: needs pyarrow: run `pip install ppo-dap[tables]`") from None
    with reading(path):
        try:
            yield pyarrow
        except ArrowException as error:
            if isinstance(error, MemoryError):
                raise
            raise ValueError(str(error)) from None


def read_csv(path: Path, columns: Columns | None, budget: Budget) -> Logs:
    """Read a CSV with a line of names. Raises `InputError` in one line for whatever cannot be read or used."""
    with reading(path):
        return assemble(path, csv_pieces(path, columns), budget)


def read_parquet(path: Path, columns: Columns | None, budget: Budget) -> Logs:
    """Read a Parquet file. Raises `InputError` in one line for whatever cannot be read or used."""
    with reading(path):
        return assemble(path, parquet_pieces(path, columns), budget)


def csv_pieces(path: Path, columns: Columns | None) -> Iterator[Rows]:
    """Pieces of a CSV, in order."""
    with arrow(path) as pa:
        from pyarrow import csv

        block = csv.ReadOptions(block_size=CSV_BLOCK, use_threads=False)
        with csv.open_csv(path, read_options=block) as file:
            stored = {_plain(name): name for name in reversed(file.schema.names)}
            names = [_plain(name) for name in file.schema.names]
        chosen, rest = choose_columns(names, columns)
        _warn_ignored(path, rest)
        # Without types, the first piece would say what the column holds in all others.
        types: dict[str, Any] = {}
        for role, found in chosen.items():
            own = {"episode": pa.string(), "step": None, "times": None, **dict.fromkeys(FLAGS, pa.bool_())}
            kind = own.get(role, pa.float64())
            types.update({stored[name]: kind for name in found if kind is not None})
        wanted = [stored[name] for found in chosen.values() for name in found]
        convert = csv.ConvertOptions(
            column_types=types, include_columns=wanted, true_values=TRUE, false_values=FALSE, strings_can_be_null=True
        )
        first_row = 0
        with csv.open_csv(path, read_options=block, convert_options=convert) as file:
            for batch in file:
                batch = batch.rename_columns([_plain(name) for name in batch.schema.names])
                yield from _piece(batch, chosen, first_row)
                first_row += batch.num_rows


def parquet_pieces(path: Path, columns: Columns | None, warn: bool = True) -> Iterator[Rows]:
    """Pieces of a Parquet file, in order. `warn`: say which columns are not used."""
    with arrow(path), _open_parquet(path) as file:
        chosen, rest = choose_columns(file.schema_arrow.names, columns)
        if warn:
            _warn_ignored(path, rest)
        first_row = 0
        for batch in _batches(file, [name for found in chosen.values() for name in found]):
            yield from _piece(batch, chosen, first_row)
            first_row += batch.num_rows
        if first_row != file.metadata.num_rows:
            raise InputError(f"declares {file.metadata.num_rows} rows but holds {first_row}: both must be equal")


def read_parquet_whole(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """The named columns of a small Parquet file, of those that it has."""
    with arrow(path) as pa, _open_parquet(path) as file:
        found = [name for name in file.schema_arrow.names if name in names]
        return _arrays(pa.Table.from_batches(_batches(file, found)), found)


def read_ipc(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """The named columns of a small file in Arrow's own format, of those that it has."""
    with arrow(path) as pa, pa.OSFile(str(path)) as stream, pa.ipc.open_file(stream) as file:
        found = [name for name in file.schema.names if name in names]
        batches = []
        for i in range(file.num_record_batches):
            batch = file.get_batch(i)
            batch.validate(full=True)  # lengths and offsets are as the file says, and it may say anything
            batches.append(batch.select(found))
        return _arrays(pa.Table.from_batches(batches, batches[0].schema), found)


@contextmanager
def _open_parquet(path: Path) -> Iterator[Any]:
    from pyarrow import parquet

    # A buffer lets a column of a row group be unpacked page by page, as a group may be the whole file.
    with parquet.ParquetFile(path, buffer_size=PIECE_BYTES // 4, page_checksum_verification=True) as file:
        metadata = file.metadata
        declared = sum(metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups))
        refuse_large("the table", max(declared, metadata.num_rows), path.stat().st_size)
        yield file


def _batches(file: Any, names: list[str]) -> Iterator[Any]:
    metadata = file.metadata
    declared = sum(metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups))
    rows = PIECE_BYTES * max(metadata.num_rows, 1) // max(declared, 1)
    for batch in file.iter_batches(min(max(rows, 1), MOST_ROWS), columns=names, use_threads=False):
        batch.validate(full=True)
        yield batch


def _plain(name: str) -> str:
    """A name of a CSV's first line without what surrounds it; numpy.savetxt puts `# ` before the first."""
    return name.strip().removeprefix("#").strip()


def _warn_ignored(path: Path, names: list[str]) -> None:
    if names:
        shown = ", ".join(name[:60] for name in names[:20]) + (" and more" if len(names) > 20 else "")
        warnings.warn(f"{path}: ignored columns {shown}: their names say no role", LogsWarning, stacklevel=2)


def _arrays(table: Any, names: list[str]) -> dict[str, np.ndarray]:
    return {name: column_array(table.column(name).combine_chunks(), name, 0) for name in names}


def _piece(batch: Any, chosen: dict[str, list[str]], first_row: int) -> Iterator[Rows]:
    """The batch's columns by role; nothing of a batch without rows."""
    if not batch.num_rows:
        return
    piece = {}
    for role, names in chosen.items():
        arrays = [column_array(batch.column(name), name, first_row, role) for name in names]
        if role in ("observations", "actions"):
            piece[role] = np.column_stack(arrays)
        elif arrays[0].ndim > 1:
            raise InputError(f"{names[0]} holds lists: must hold one value in a row")
        else:
            piece[role] = arrays[0]
    yield piece


def column_array(column: Any, name: str, first_row: int, role: str = "rewards") -> np.ndarray:
    """An arrow column as (rows,), or (rows, n) when it holds lists of n numbers each.

    Raises `InputError` for empty places, lists of different lengths, and what is no number (an episode's name may be a
    string, a time a date with a time).
    """
    import pyarrow as pa

    kind = column.type
    if pa.types.is_dictionary(kind):
        column = column.dictionary_decode()
        kind = column.type
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
        raise InputError(f"{name} is empty at row {row + first_row}: must have a value in every row")
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        values = column.flatten()
        lengths = np.unique(column.value_lengths().to_numpy(zero_copy_only=False))
        if len(lengths) > 1:
            raise InputError(f"{name} holds lists of {lengths[0]} to {lengths[-1]} numbers: must be equally long")
        array = column_array(values, name, first_row)
        if array.ndim > 1:
            raise InputError(f"{name} holds lists of lists: must hold lists of numbers")
        return array.reshape(len(column), -1)
    if pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    elif role == "times" and pa.types.is_timestamp(kind):
        whole = column.cast(pa.timestamp("ns", kind.tz)).cast(pa.int64())
        return whole.to_numpy(zero_copy_only=False).astype(np.float64) / 1e9
    elif role in ("step", "times") and pa.types.is_temporal(kind):
        raise InputError(f"{name} holds {kind}: must hold numbers, or for times a date with a time")
    is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
    if not (pa.types.is_primitive(column.type) and not pa.types.is_temporal(column.type)) and not (
        is_text and role == "episode"
    ):
        raise InputError(f"{name} holds {kind}: must hold numbers")
    array = column.to_numpy(zero_copy_only=False)
    if array.dtype.kind == "f" and role in ("episode", "step", "times") and not np.isfinite(array).all():
        raise InputError(f"{name} is not finite at row {int(np.flatnonzero(~np.isfinite(array))[0]) + first_row}")
    return array
