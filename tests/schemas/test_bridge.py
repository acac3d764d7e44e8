"""Vectors and covariances cross the bridge both ways, from Arrow and from polars."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest

from epipole.schemas.bridge import (
    array,
    concat,
    conform,
    empty,
    flatten,
    from_polars,
    nullable,
    rows_of,
    stack,
    stack_covariance,
    table,
    to_polars,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import (
    STATE_AXES,
    TANGENT_AXES,
    TIME,
    axes,
    column,
    covariance,
    schema,
    time_column,
)

SENSOR_STATES_AT_FRAMES = schema(
    "places",
    "One row per place.",
    [
        time_column(),
        *axes("{}_km", unit="km", frame="GCRF", null=True, doc="Place"),
        *covariance("cov_{}", unit="km^2", frame="GCRF", doc="Its covariance."),
    ],
)
NS = 1_554_091_200_000_000_123  # a nanosecond is kept


def symmetric(n, k):
    half = np.arange(n * k * k, dtype=float).reshape(n, k, k)
    return half + half.transpose(0, 2, 1)


def places(n=3):
    vectors = np.arange(3.0 * n).reshape(n, 3)
    columns = unstack("{}_km", vectors) | unstack_covariance("cov_{}", symmetric(n, 3))
    return table(SENSOR_STATES_AT_FRAMES, columns | {"time": NS + np.arange(n)}), vectors


@pytest.mark.parametrize("carried", [lambda rows: rows, to_polars])
@pytest.mark.parametrize("n", [0, 1, 3])
def test_vectors_and_covariances_come_back_as_they_went(carried, n):
    rows, vectors = places(n)
    np.testing.assert_array_equal(stack(carried(rows), "{}_km"), vectors)
    np.testing.assert_array_equal(stack_covariance(carried(rows), "cov_{}"), symmetric(n, 3))


@pytest.mark.parametrize("axes", ["xyz", TANGENT_AXES, STATE_AXES])
def test_a_covariance_has_the_columns_of_its_upper_triangle(axes):
    matrices = symmetric(2, len(axes))
    columns = unstack_covariance("cov_{}_rad2", matrices, axes)
    assert len(columns) == len(axes) * (len(axes) + 1) // 2
    for i, a in enumerate(axes):
        for j, b in enumerate(axes[i:], i):
            np.testing.assert_array_equal(columns[f"cov_{a}{b}_rad2"], matrices[:, i, j])
    rows = pa.table(columns)
    np.testing.assert_array_equal(stack_covariance(rows, "cov_{}_rad2", axes), matrices)


def test_arrays_from_arrow_and_from_polars_have_the_same_layout():
    rows, _ = places()
    for values in (rows, to_polars(rows)):
        assert stack(values, "{}_km").flags.c_contiguous
        assert stack_covariance(values, "cov_{}").flags.c_contiguous


@pytest.mark.parametrize("carried", [lambda rows: rows, to_polars])
def test_null_components_are_nan(carried):
    rows, vectors = places()
    missing = nullable(vectors[:, 1], np.array([True, False, True]))
    rows = rows.set_column(2, SENSOR_STATES_AT_FRAMES.field("y_km"), missing)
    there = stack(carried(rows), "{}_km")
    assert np.isnan(there[1, 1])
    assert np.isfinite(there).sum() == there.size - 1


def test_a_table_comes_back_from_polars_with_its_schema_and_its_nanoseconds():
    rows, _ = places()
    frame = to_polars(rows).with_columns(other=pl.lit(1))
    back = from_polars(SENSOR_STATES_AT_FRAMES, frame)
    assert back.schema.equals(SENSOR_STATES_AT_FRAMES, check_metadata=True)
    assert back.equals(rows)
    assert array(back, "time").tolist() == [NS, NS + 1, NS + 2]


def test_a_frame_without_a_column_or_with_a_null_is_refused():
    frame = to_polars(places()[0])
    with pytest.raises(ValueError, match=r"table places: missing columns \['x_km'\]"):
        from_polars(SENSOR_STATES_AT_FRAMES, frame.drop("x_km"))
    null = frame.with_columns(cov_xy=pl.lit(None, pl.Float64))
    with pytest.raises(ValueError, match="column cov_xy has 3 nulls; it may have none"):
        from_polars(SENSOR_STATES_AT_FRAMES, null)


def test_a_table_of_unknown_mistyped_or_uneven_columns_is_refused():
    marks = schema("marks", "One row per mark.", [column("n", pa.int64(), doc="Number."),
                                                  column("at", TIME, doc="When.")])  # fmt: skip
    with pytest.raises(ValueError, match=r"unknown columns \['m'\]"):
        table(marks, {"n": [1], "at": [NS], "m": [1]})
    with pytest.raises(ValueError, match="column n is not int64"):
        table(marks, {"n": ["one"], "at": [NS]})
    with pytest.raises(ValueError, match="columns differ in length"):
        table(marks, {"n": [1, 2], "at": [NS]})


def test_metadata_beside_the_schemas_are_kept():
    rows, _ = places()
    labelled = rows.replace_schema_metadata({"catalogue": "hipparcos", "table": "other"})
    for kept in (
        conform(SENSOR_STATES_AT_FRAMES, labelled),
        concat(SENSOR_STATES_AT_FRAMES, [labelled]),
    ):
        assert kept.schema.metadata[b"catalogue"] == b"hipparcos"
        assert kept.schema.metadata[b"table"] == b"places"
    assert concat(SENSOR_STATES_AT_FRAMES, []).equals(empty(SENSOR_STATES_AT_FRAMES))


def test_lists_come_back_flat():
    rows = pa.table({"x_px": pa.array([[1.0, 2.0], [], [3.0]], pa.list_(pa.float32()))})
    values, offsets = flatten(rows.slice(1), "x_px")
    assert values.tolist() == [3.0]
    assert values.dtype == np.float64
    assert offsets.tolist() == [0, 0, 1]


def test_rows_of_a_table_keep_the_nanoseconds_of_its_times():
    (row,) = rows_of(table(schema("times", "Times.", [time_column()]), {"time": [NS]}))
    assert row == {"time": NS}
