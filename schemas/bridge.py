"""The bridge between Arrow tables, polars frames and NumPy arrays.

Arrow carries the tables, polars joins and groups them, NumPy computes. Every table is checked
against its schema when it is made.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.columns import TIME, upper_triangle


def table(schema: pa.Schema, columns: Mapping[str, Any]) -> pa.Table:
    """Return a table of this schema.

    Parameters
    ----------
    schema
        One of `epipole.schemas`.
    columns
        One entry per column: a NumPy array, an Arrow array or a list. Times are int64
        nanoseconds.

    Raises
    ------
    ValueError
        Where a column is missing, unknown, of the wrong type or longer than another, or has a
        null that the schema does not allow.
    """
    name = table_name(schema)
    missing = [n for n in schema.names if n not in columns]
    unknown = [n for n in columns if n not in schema.names]
    if missing or unknown:
        raise ValueError(f"table {name}: missing columns {missing}, unknown columns {unknown}")
    arrays = [_as_arrow(name, field, columns[field.name]) for field in schema]
    lengths = {field.name: len(a) for field, a in zip(schema, arrays, strict=True)}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"table {name}: columns differ in length: {lengths}")
    return pa.Table.from_arrays(arrays, schema=schema)


def _as_arrow(table_name: str, field: pa.Field, values: Any) -> pa.Array | pa.ChunkedArray:
    try:
        if not isinstance(values, pa.Array | pa.ChunkedArray):
            if isinstance(values, np.ndarray) and field.type == TIME:
                values = values.astype(np.int64)
            values = pa.array(values, type=field.type)
        elif values.type != field.type:
            values = values.cast(field.type)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
        raise ValueError(
            f"table {table_name}: column {field.name} is not {field.type}: {error}"
        ) from error
    if not field.nullable and values.null_count:
        raise ValueError(
            f"table {table_name}: column {field.name} has {values.null_count} nulls; "
            "it may have none"
        )
    return values


def conform(schema: pa.Schema, values: pa.Table) -> pa.Table:
    """Return the columns of `values` that `schema` names, checked against it.

    Metadata of the table that the schema does not have are kept.
    """
    columns = {name: values.column(name) for name in schema.names if name in values.column_names}
    return _with_metadata_of([values], table(schema, columns))


def _with_metadata_of(sources: Iterable[pa.Table], made: pa.Table) -> pa.Table:
    metadata: dict[bytes, bytes] = {}
    for source in sources:
        metadata |= source.schema.metadata or {}
    return made.replace_schema_metadata(metadata | (made.schema.metadata or {}))


def empty(schema: pa.Schema) -> pa.Table:
    """Return a table of this schema with no rows."""
    return schema.empty_table()


def concat(schema: pa.Schema, tables: Iterable[pa.Table]) -> pa.Table:
    """Return the rows of all tables, in order. Without tables it has no rows.

    Metadata of the tables that the schema does not have are kept.
    """
    tables = list(tables)
    if tables and tables[0].schema.equals(schema, check_metadata=True):
        checked = tables  # the others are compared to the first
    else:
        checked = [empty(schema), *tables]
    return _with_metadata_of(tables, pa.concat_tables(checked).combine_chunks())


def rows_with(rows: pa.Table, name: str, value: str | int) -> pa.Table:
    """Return the rows that have this value in a column.

    As `filter` with an expression, which takes a millisecond more.
    """
    return rows.filter(pc.equal(rows[name], value))


def table_name(schema: pa.Schema) -> str:
    """Return the name a schema was declared with."""
    return (schema.metadata or {}).get(b"table", b"?").decode()


def array(values: pa.Table, name: str) -> npt.NDArray[Any]:
    """Return a column as a NumPy array.

    Times are int64 nanoseconds, null floats NaN, strings objects (null becomes None).
    """
    column = values.column(name)
    if column.type != TIME:
        return column.to_numpy()
    if column.null_count:
        return column.cast(pa.int64()).to_numpy()
    return column.to_numpy().view(np.int64)  # a tenth of the time of a cast


def rows_of(values: pa.Table) -> list[dict[str, Any]]:
    """Return the rows of a small table as mappings; times are nanoseconds since 1970.

    Arrow itself refuses to return a time that is not a whole number of microseconds.
    """
    for k, field in enumerate(values.schema):
        if pa.types.is_timestamp(field.type):
            as_number = pa.field(field.name, pa.int64())
            values = values.set_column(k, as_number, values.column(k).cast(pa.int64()))
    return values.to_pylist()  # type: ignore[no-any-return]


def stack(values: pa.Table | pl.DataFrame, pattern: str, names: Sequence[str] = "xyz") -> Array:
    """Return the columns of a vector as one (n, len(names)) array, nulls as NaN.

    ``stack(positions, "{}_km")`` reads x_km, y_km and z_km.
    """
    out = np.empty((len(values), len(names)))
    for i, a in enumerate(names):
        out[:, i] = _floats(values, pattern.format(a))
    return out


def unstack(
    pattern: str, vectors: npt.NDArray[Any], names: Sequence[str] = "xyz"
) -> dict[str, npt.NDArray[Any]]:
    """Return one column per axis of an (n, len(names)) array: the inverse of `stack`."""
    return {pattern.format(a): vectors[:, i] for i, a in enumerate(names)}


def stack_covariance(
    values: pa.Table | pl.DataFrame, pattern: str, names: Sequence[str] = "xyz"
) -> Array:
    """Return the columns of an upper triangle as (n, k, k) symmetric matrices, nulls as NaN.

    ``stack_covariance(positions, "cov_{}")`` reads cov_xx, cov_xy, ... cov_zz. `names` are the k
    axes; `TANGENT_AXES` and `STATE_AXES` are the other ones in use.
    """
    out = np.empty((len(values), len(names), len(names)))
    for (a, b), (i, j) in _triangle(names):
        out[:, i, j] = out[:, j, i] = _floats(values, pattern.format(a + b))
    return out


def unstack_covariance(
    pattern: str, matrices: npt.NDArray[Any], names: Sequence[str] = "xyz"
) -> dict[str, npt.NDArray[Any]]:
    """Return the upper triangle of (n, k, k) matrices: the inverse of `stack_covariance`."""
    return {pattern.format(a + b): matrices[:, i, j] for (a, b), (i, j) in _triangle(names)}


def _triangle(names: Sequence[str]) -> Iterator[tuple[tuple[str, str], tuple[int, int]]]:
    """Yield the pairs of axes of an upper triangle, each with its row and column."""
    return zip(upper_triangle(names), zip(*np.triu_indices(len(names)), strict=True), strict=True)


def _floats(values: pa.Table | pl.DataFrame, name: str) -> Array:
    return array(values, name) if isinstance(values, pa.Table) else values[name].to_numpy()


def to_polars(rows: pa.Table) -> pl.DataFrame:
    """Return an Arrow table as a polars frame."""
    return pl.DataFrame(rows)


def from_polars(schema: pa.Schema, rows: pl.DataFrame) -> pa.Table:
    """Return the columns of a polars frame that `schema` names, checked as `table` does."""
    return table(schema, {n: rows[n].to_arrow() for n in schema.names if n in rows.columns})


def nullable(values: npt.NDArray[Any], valid: Flags | None = None) -> pa.Array:
    """Return an Arrow array that is null where not `valid` (default: where NaN)."""
    valid = np.isfinite(values) if valid is None else valid
    return pa.array(values, mask=~valid)


def flatten(values: pa.Table, name: str) -> tuple[npt.NDArray[Any], Integers]:
    """Return a list column as flat values and (n + 1) offsets.

    Row i is ``flat[offsets[i]:offsets[i + 1]]``.

    Values of a float32 column come as float64.
    """
    column = values.column(name).combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # an empty column stays chunked
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    offsets = column.offsets.to_numpy().astype(np.int64)
    flat = (
        column.values.to_numpy()[offsets[0] : offsets[-1]]
        if len(offsets)
        else column.values.to_numpy()
    )
    if flat.dtype == np.float32:
        flat = flat.astype(np.float64)
    return flat, offsets - offsets[0]
