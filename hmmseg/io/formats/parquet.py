"""Parquet files, read column by column with pyarrow."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_ROWS, Table, check_unique, flat, is_wanted, make_table


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of a Parquet file."""
    with pq.ParquetFile(path) as file:
        if file.metadata.num_rows > MAX_ROWS:
            raise InputError(str(path), f"says it has {file.metadata.num_rows} rows", f"at most {MAX_ROWS}")
        names = file.schema_arrow.names
        check_unique(names, str(path))
        columns = to_columns(file.read(columns=[name for name in names if is_wanted(name, wanted)]))
    return make_table(str(path), columns, names, wanted)


def num_rows(path: Path) -> int:
    """Rows of a file."""
    with pq.ParquetFile(path) as file:
        return file.metadata.num_rows


def read_pieces(path: Path, wanted: Sequence[str] | None, rows: int) -> Iterator[Table]:
    """Tables of at most `rows` rows each, in order: a long file in bounded memory."""
    with pq.ParquetFile(path, pre_buffer=False) as file:  # buffering would hold the whole file
        names, first = file.schema_arrow.names, 1
        chosen = [name for name in names if is_wanted(name, wanted)]
        # One thread, as each has its own memory pool.
        for batch in file.iter_batches(batch_size=rows, columns=chosen, use_threads=False):
            columns = to_columns(pa.Table.from_batches([batch]))
            numbers = np.arange(first, first + batch.num_rows)
            first += batch.num_rows
            yield Table(str(path), tuple(names), columns, numbers)


def to_columns(table: pa.Table) -> dict[str, np.ndarray]:
    """Columns of an Arrow table; lists of equal length become `name[0]`, `name[1]`, ..."""
    return flat({name: _array(table.column(name)) for name in table.column_names})


def _array(column: pa.ChunkedArray) -> np.ndarray:
    kind = column.type
    if len(column) and column.num_chunks == 1 and not column.null_count and pa.types.is_float64(kind):
        numbers = column.chunk(0)  # without a copy: to_numpy imports pandas, some 50 MB
        return np.frombuffer(numbers.buffers()[1], np.float64, len(numbers), 8 * numbers.offset)
    if pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind):
        if column.null_count:
            return np.array(column.to_pylist(), dtype=object)
        joined = column.combine_chunks()
        values = joined.flatten().to_numpy(zero_copy_only=False)
        length = len(values) // len(joined) if len(joined) else 1
        lengths = np.diff(np.asarray(joined.offsets)) if hasattr(joined, "offsets") else np.array([length])
        if len(joined) and (lengths == length).all():
            return values.reshape(len(joined), length)
        ragged = np.empty(len(joined), dtype=object)
        ragged[:] = [str(entry) for entry in joined.to_pylist()]
        return ragged
    if pa.types.is_dictionary(kind):
        return _array(column.cast(kind.value_type))
    if pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    return column.to_numpy(zero_copy_only=False)
