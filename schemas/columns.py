"""Building blocks of Arrow schemas: a column with its unit, frame and meaning."""

import json
from collections.abc import Iterable, Sequence
from typing import Any

import pyarrow as pa

TIME = pa.timestamp("ns", tz="UTC")

STATE_AXES = ("x", "y", "z", "vx", "vy", "vz")  # of a position and velocity
POSITION = ["x_km", "y_km", "z_km"]  # of an object
VELOCITY = ["vx_km_s", "vy_km_s", "vz_km_s"]
ELEMENTS = ("a_km", "e", "i_deg", "raan_deg", "argp_deg", "mean_anomaly_deg")  # osculating
OPTICS_AXES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # numbers of a camera
ATTRIBUTABLE_AXES = ("ra", "dec", "vra", "vdec")  # of a direction (ra times cos dec) and its rate
SHARED_AXES = ("dx", "dy", "dz", "x", "y", "z")  # of a sensor's direction and position error
TANGENT_AXES = ("1", "2")  # of the plane at right angles to a direction


def column(
    name: str,
    kind: pa.DataType,
    *,
    doc: str,
    unit: str = "",
    frame: str = "",
    null: bool = False,
    before: bool | float | list[str] | None = None,
) -> pa.Field:
    """Return a field with its unit, frame and meaning as metadata.

    With `null` the column may have nulls; `doc` then says what a null means. A column that is added
    without nulls says by `before` what it is in nights that were published before it was there.
    """
    said = "" if before is None else json.dumps(before)
    metadata = {"doc": doc, "unit": unit, "frame": frame, "before": said}
    return pa.field(
        name,
        kind,
        nullable=null,
        metadata={key: value for key, value in metadata.items() if value},
    )


def values_before(schema: pa.Schema) -> dict[str, Any]:
    """Return the columns that a night published before they were there may lack, and what they are
    in it; None is null."""
    said = {field.name: (field.metadata or {}).get(b"before", b"null") for field in schema}
    values = {name: json.loads(value) for name, value in said.items()}
    return {
        n: value for n, value in values.items() if value is not None or schema.field(n).nullable
    }


def time_column(
    name: str = "time", *, doc: str = "Mid-exposure time, UTC.", null: bool = False
) -> pa.Field:
    """Return a UTC time column in integer nanoseconds."""
    return column(name, TIME, unit="ns", doc=doc, null=null)


def id_column(name: str, *, doc: str, null: bool = False) -> pa.Field:
    """Return a column of strings that identify something."""
    return column(name, pa.string(), doc=doc, null=null)


def axes(
    pattern: str, *, unit: str, frame: str, doc: str, null: bool = False, names: str = "xyz"
) -> list[pa.Field]:
    """Return one float64 column per axis: ``axes("{}_km")`` gives x_km, y_km, z_km.

    Three columns, not a list: a filter on them is three times faster, and each axis has Parquet
    statistics.
    """
    return [
        column(
            pattern.format(a), pa.float64(), unit=unit, frame=frame, doc=f"{doc} ({a})", null=null
        )
        for a in names
    ]


def upper_triangle(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of axes of a symmetric matrix's upper triangle, row by row."""
    return [(a, b) for i, a in enumerate(names) for b in names[i:]]


def covariance(
    pattern: str,
    *,
    unit: str,
    doc: str,
    frame: str = "",
    null: bool = False,
    names: Sequence[str] = "xyz",
) -> list[pa.Field]:
    """Return the columns of a covariance's upper triangle: ``covariance("cov_{}")`` gives cov_xx,
    cov_xy, ... cov_zz."""
    return [
        column(pattern.format(a + b), pa.float64(), unit=unit, frame=frame, doc=doc, null=null)
        for a, b in upper_triangle(names)
    ]


def rate_unit(quantity: str, a: str, b: str) -> str:
    """Return the unit of a covariance of a quantity and its rates; axes of rates begin with v."""
    return f"{quantity}^2" + ("", "/s", "/s^2")[a.startswith("v") + b.startswith("v")]


def schema(name: str, doc: str, fields: Iterable[pa.Field], version: str = "1") -> pa.Schema:
    """Return a table's schema with its name, meaning and version in the metadata.

    `version` is raised when a column is renamed or its unit changes.
    """
    return pa.schema(list(fields), metadata={"table": name, "doc": doc, "version": version})
