"""The bridge between Arrow tables and NumPy arrays, and the gate a table must pass."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.columns import TIME, upper_triangle


def table(schema: pa.Schema, columns: Mapping[str, Any]) -> pa.Table:
    """Return a table of this schema, or raise: what does not fit its schema cannot exist.

    Parameters
    ----------
    schema
        One of `epipole.schemas`.
    columns
        One entry a column: NumPy array, Arrow array or list. Times are int64 nanoseconds.

    Raises
    ------
    ValueError
        On a missing, unknown, mistyped or unevenly long column, or a null where the
        schema allows none.
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
            f"table {table_name}: column {field.name} has {values.null_count} nulls, none allowed"
        )
    return values


def conform(schema: pa.Schema, values: pa.Table) -> pa.Table:
    """Return the columns of `values` that `schema` names, checked against it.

    What the table's own metadata says beside the schema's is kept.
    """
    columns = {name: values.column(name) for name in schema.names if name in values.column_names}
    return _with_words_of([values], table(schema, columns))


def _with_words_of(tables: Iterable[pa.Table], made: pa.Table) -> pa.Table:
    words: dict[bytes, bytes] = {}
    for one in tables:
        words |= one.schema.metadata or {}
    return made.replace_schema_metadata(words | (made.schema.metadata or {}))


def empty(schema: pa.Schema) -> pa.Table:
    """Return a table of this schema with no rows."""
    return schema.empty_table()


def concat(schema: pa.Schema, tables: Iterable[pa.Table]) -> pa.Table:
    """Return the rows of all tables, in order; with none, a table with no rows.

    What the tables' own metadata says beside the schema's is kept.
    """
    tables = list(tables)
    rows = pa.concat_tables([empty(schema), *tables]).combine_chunks()
    return _with_words_of(tables, rows)


def table_name(schema: pa.Schema) -> str:
    """Return the name a schema was declared with."""
    return (schema.metadata or {}).get(b"table", b"?").decode()


def array(values: pa.Table, name: str) -> npt.NDArray[Any]:
    """Return a column as a NumPy array: times as int64 nanoseconds, null floats as NaN,
    strings as objects (null is None)."""
    column = values.column(name)
    if column.type == TIME:
        return column.cast(pa.int64()).to_numpy()
    return column.to_numpy()


def stack(values: pa.Table, pattern: str, names: str = "xyz") -> npt.NDArray[np.float64]:
    """Return the columns of a vector as one (n, len(names)) array."""
    out = np.empty((values.num_rows, len(names)))
    for i, a in enumerate(names):
        out[:, i] = array(values, pattern.format(a))
    return out


def unstack(
    pattern: str, vectors: npt.NDArray[Any], names: str = "xyz"
) -> dict[str, npt.NDArray[Any]]:
    """Return one column an axis of an (n, len(names)) array, named by the pattern."""
    return {pattern.format(a): vectors[:, i] for i, a in enumerate(names)}


def stack_covariance(values: pa.Table, pattern: str) -> npt.NDArray[np.float64]:
    """Return six upper-triangle columns as (n, 3, 3) symmetric matrices."""
    out = np.empty((values.num_rows, 3, 3))
    for a, b in upper_triangle("xyz"):
        i, j = "xyz".index(a), "xyz".index(b)
        out[:, i, j] = out[:, j, i] = array(values, pattern.format(a + b))
    return out


def unstack_covariance(pattern: str, matrices: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Return the six upper-triangle columns of (n, 3, 3) symmetric matrices."""
    return {
        pattern.format(a + b): matrices[:, "xyz".index(a), "xyz".index(b)]
        for a, b in upper_triangle("xyz")
    }


def nullable(values: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None = None) -> pa.Array:
    """Return an Arrow array that is null where not `valid` (default: where NaN)."""
    valid = np.isfinite(values) if valid is None else valid
    return pa.array(values, mask=~valid)


def lists(flat: npt.NDArray[Any], offsets: npt.NDArray[Any], kind: pa.DataType) -> pa.ListArray:
    """Return row i as the list ``flat[offsets[i]:offsets[i + 1]]``."""
    kind = pa.list_(pa.field("element", kind, nullable=False))
    return pa.ListArray.from_arrays(
        pa.array(offsets, pa.int32()), pa.array(flat, kind.value_type), type=kind
    )


def flatten(values: pa.Table, name: str) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
    """Return a list column as (flat values, (n + 1) offsets), the inverse of `lists`.

    Floating-point values come as float64, whatever the column holds.
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
