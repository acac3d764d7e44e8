"""Parquet files of a dataset, read in pieces of bounded size and checked against their schema.

A night that was published before a column was there has it as its declaration says: null, or what
it is in such nights.

Another program may have written the files. A few kilobytes can hold millions of equal rows, or one
long text millions of times, so neither a file's size nor its number of rows says how much it
unpacks to.
"""

from collections.abc import Collection, Iterable, Iterator
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from epipole.io.paths import line_of
from epipole.schemas.bridge import conform
from epipole.schemas.columns import TIME, values_before
from epipole.schemas.errors import DatasetError

ROWS_IN_PIECE = 1 << 17
# Of the texts of a piece, and of all rows that are kept of a table of an earlier night. Half an
# hour of 128 sensors that see 60 objects each second has 550 MB of views.
MAX_BYTES = 1 << 30
MAX_LISTED = 1 << 20  # values of a list column in a row group: a night's sentences on its sensors

Between = tuple[int | None, int | None]  # from here to before there [ns since 1970]; None: open


def read_pieces(
    file: Any, schema: pa.Schema, time: str | None = None, between_ns: Between = (None, None)
) -> Iterator[pa.Table]:
    """Yield the rows of a file, some at a time, in their order, as tables of a schema.

    Parameters
    ----------
    file
        A path, or an open file.
    schema
        Only its columns are read. One that the file does not have is null, or as declared.
    time
        A column by which rows are chosen; row groups of other times are not read.

    Raises
    ------
    OSError, ValueError, pyarrow.ArrowException
        Where the file is damaged, does not have this schema, or a piece is too large.
    """
    metadata = pq.read_metadata(file)
    stored = metadata.schema.to_arrow_schema()
    present = [name for name in schema.names if name in stored.names]
    added = _added(schema, present)
    for name in present:
        _check_type(stored.field(name), schema.field(name))
    texts = [name for name in present if schema.field(name).type == pa.string()]
    parquet = pq.ParquetFile(file, metadata=metadata, read_dictionary=texts)
    groups = _groups(parquet, time, between_ns)
    _check_lists(parquet, groups, [f.name for f in schema if pa.types.is_list(f.type)])
    for batch in parquet.iter_batches(ROWS_IN_PIECE, groups, columns=present) if groups else ():
        _check_texts(batch)
        rows = conform(schema, _completed(schema, batch, added))
        rows.validate(full=True)  # invalid UTF-8 would end in an error where it is shown
        yield rows if time is None else rows.filter(_chosen(rows[time], between_ns))


def _added(schema: pa.Schema, present: Collection[str]) -> dict[str, pa.Scalar]:
    """Return the columns that a file does not have, and what they are in it."""
    lacking = [field for field in schema if field.name not in present]
    values = values_before(schema)
    if gone := [field.name for field in lacking if field.name not in values]:
        raise ValueError(f"it has no column {', '.join(gone)}")
    return {field.name: pa.scalar(values[field.name], field.type) for field in lacking}


def _completed(schema: pa.Schema, batch: pa.RecordBatch, added: dict[str, pa.Scalar]) -> pa.Table:
    """Return the rows with the columns of this schema that were added since."""
    given = dict(zip(batch.schema.names, batch.columns, strict=True))
    more = {name: pa.repeat(value, batch.num_rows) for name, value in added.items()}
    return pa.table({name: (given | more)[name] for name in schema.names})


_KINDS = {
    "text": (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view),
    "times": (pa.types.is_timestamp,),
    "whole numbers": (pa.types.is_integer,),
    "numbers": (pa.types.is_floating,),
    "yes or no": (pa.types.is_boolean,),
    "lists": (pa.types.is_list, pa.types.is_large_list),
}


def _check_type(stored: pa.Field, field: pa.Field) -> None:
    """Raise where a column holds another kind of values; their width may differ."""
    found, wanted = _kind(stored.type), _kind(field.type)
    if found != wanted:
        raise ValueError(f"its column {field.name} has {found}, not {wanted}")


def _kind(values: pa.DataType) -> str:
    if pa.types.is_dictionary(values):
        values = values.value_type
    return next(
        (kind for kind, tests in _KINDS.items() if any(test(values) for test in tests)),
        f"values of type {values}",
    )


def unreadable(where: str, error: Exception) -> DatasetError:
    """Return the error of a table that cannot be read, which says what to do."""
    return DatasetError(
        f"{where}: cannot be read ({line_of(error)}); "
        "remove the folder of the night and run the night again"
    )


def within_bounds(pieces: Iterable[pa.Table], max_bytes: int) -> Iterator[pa.Table]:
    """Yield the pieces.

    Raises
    ------
    ValueError
        Where they are larger than this altogether.
    """
    total = 0
    for piece in pieces:
        total += piece.nbytes
        if total > max_bytes:
            raise ValueError(f"its rows unpack to more than {max_bytes >> 20:,} MiB")
        yield piece


def _groups(file: pq.ParquetFile, time: str | None, between_ns: Between) -> list[int]:
    """Return the row groups that may have rows of these times."""
    groups = [k for k in range(file.num_row_groups) if file.metadata.row_group(k).num_rows]
    at = -1 if time is None else file.schema_arrow.get_field_index(time)
    if at < 0 or file.schema_arrow.field(at).type != TIME:
        return groups
    first, end = between_ns
    kept = []
    for group in groups:
        statistics = file.metadata.row_group(group).column(at).statistics
        if statistics is not None and statistics.has_min_max:
            low, high = statistics.min_raw, statistics.max_raw
            if (end is not None and low >= end) or (first is not None and high < first):
                continue
        kept.append(group)
    return kept


def _check_lists(file: pq.ParquetFile, groups: Iterable[int], lists: list[str]) -> None:
    """Raise where a list column has too many values; a single row may hold any number."""
    for group in map(file.metadata.row_group, groups):
        for column in map(group.column, range(group.num_columns)):
            is_list = column.path_in_schema.partition(".")[0] in lists
            if is_list and column.num_values > MAX_LISTED:
                raise ValueError(f"column {column.path_in_schema} has {column.num_values:,} values")


def _check_texts(batch: pa.RecordBatch) -> None:
    """Raise where the texts of a batch would unpack to too many bytes."""
    for name, values in zip(batch.schema.names, batch.columns, strict=True):
        if pa.types.is_dictionary(values.type):
            lengths = pc.binary_length(values.dictionary).cast(pa.int64())
            if (pc.sum(lengths.take(values.indices)).as_py() or 0) > MAX_BYTES:
                raise ValueError(f"column {name} unpacks to more than {MAX_BYTES >> 20:,} MiB")


def _chosen(times: pa.ChunkedArray, between_ns: Between) -> pa.ChunkedArray:
    first, end = between_ns
    number = times.cast(pa.int64())
    chosen = pc.is_valid(number)
    if first is not None:
        chosen = pc.and_(chosen, pc.greater_equal(number, first))
    if end is not None:
        chosen = pc.and_(chosen, pc.less(number, end))
    return chosen
