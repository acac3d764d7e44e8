"""Sample sight lines: the lines of sight, and their objects, that the check of sensors needs."""

import zlib
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from epipole.schemas.arrays import Indices
from epipole.schemas.bridge import (
    array,
    conform,
    from_polars,
    nullable,
    stack,
    to_polars,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import POSITION, TANGENT_AXES, VELOCITY
from epipole.schemas.spans import DAY_NS
from epipole.schemas.work_tables import CLOCK_LINES, MOVING_OBJECTS, OBJECT_VIEWS
from epipole.tasks.algorithms.geometry.directions import apparent_positions
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.solve.positions import VELOCITY_WINDOW_S
from epipole.tasks.solve.view_groups import ObjectViews, ViewGroups


class LineSampling(NamedTuple):
    """Which lines of sight are kept: those of one in `one_in` objects, at epochs that are multiples
    of `every_ns` since midnight."""

    every_ns: int
    one_in: int = 1


def moving_objects(positions: pa.Table, every_ns: int) -> pa.Table:
    """Return MOVING_OBJECTS: the positions at epochs that are multiples of a time since
    midnight, with velocities from the positions near them."""
    rows = to_polars(positions).sort("object_id", "epoch")
    size = rows.group_by("object_id", maintain_order=True).len()["len"].to_numpy()
    offsets = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    time_ns = rows["epoch"].cast(pl.Int64).to_numpy()
    time_s = (time_ns - (time_ns.min() if len(time_ns) else 0)) / 1e9
    r_km = rows.select(POSITION).to_numpy()
    sigma_km = np.sqrt(
        rows.select(pl.sum_horizontal("cov_xx", "cov_yy", "cov_zz")).to_numpy()[:, 0]
    )
    v, _ = velocities(offsets, time_s, r_km, VELOCITY_WINDOW_S, sigma_km)
    light_ns = pl.col("epoch").cast(pl.Int64) - pl.col("time").cast(pl.Int64)
    rows = rows.with_columns(
        *[pl.Series(name, v[:, k]) for k, name in enumerate(VELOCITY)], light_s=light_ns / 1e9
    )
    kept = rows.filter(pl.Series(time_ns % DAY_NS % every_ns == 0, dtype=pl.Boolean))
    return from_polars(MOVING_OBJECTS, kept.select(MOVING_OBJECTS.names))


def object_views(views: ObjectViews, objects: pa.Table) -> pa.Table:
    """Return OBJECT_VIEWS: the views of objects at the epochs of MOVING_OBJECTS."""
    return conform(OBJECT_VIEWS, views.labels.take(_at_epochs(views, objects)))


def sample_sight_lines(groups: ViewGroups, objects: pa.Table, sampling: LineSampling) -> pa.Table:
    """Return CLOCK_LINES: views of objects at the epochs of MOVING_OBJECTS.

    If only some are kept, they are those of other objects at each epoch. So each sensor keeps lines
    at many epochs: all lines of a frame share the error of its attitude. Of an object at an epoch
    all lines are kept or none: a line that is left alone shows nothing.
    """
    rows = _at_epochs(groups.views, objects)
    rows = rows[_phase(groups, rows, sampling) == 0]
    object_id = groups.object_id[groups.group[rows]].tolist()
    seen = _view_columns(groups.views.take(rows)).with_columns(
        object_id=pl.Series(object_id, dtype=pl.String)
    )
    return pair_with_objects(seen, to_polars(objects), on=["epoch", "object_id"])


def _view_columns(views: ObjectViews) -> pl.DataFrame:
    """Return views as the columns of VIEWS that CLOCK_LINES has."""
    columns: dict[str, Any] = {
        **unstack("u{}", views.u),
        **unstack_covariance("cov_noise_{}_rad2", views.cov_noise, TANGENT_AXES),
        **unstack_covariance("cov_bias_{}_rad2", views.cov_bias, TANGENT_AXES),
        **unstack("{}_km", views.r_km),
        "position_sigma_km": views.sigma_km,
    }
    velocity = unstack("sensor_v{}_km_s", views.v_km_s)
    packed = pa.table(columns | {name: nullable(values) for name, values in velocity.items()})
    return to_polars(views.labels).hstack(to_polars(packed))


def _at_epochs(views: ObjectViews, objects: pa.Table) -> Indices:
    """Return the rows at the epochs of MOVING_OBJECTS."""
    return np.flatnonzero(np.isin(views.epoch_ns, np.unique(array(objects, "epoch"))))


def _phase(groups: ViewGroups, rows: Indices, sampling: LineSampling) -> Indices:
    """Return a number below `one_in` for each view, the same for all of an object at an epoch."""
    objects = _checksums(groups.object_id[groups.group[rows]])
    # As if at random: a long night is judged at every second epoch, or every eighth. Numbers that
    # count up would give the same objects there, and others never.
    epochs = _checksums(groups.views.epoch_ns[rows] // sampling.every_ns)
    return np.asarray((objects + epochs) % sampling.one_in)


def _checksums(values: npt.NDArray[Any]) -> Indices:
    """Return the CRC-32 of each value as a text."""
    distinct, which = np.unique(values, return_inverse=True)
    return np.array([zlib.crc32(str(value).encode()) for value in distinct], np.int64)[which]


def pair_with_objects(views: pl.DataFrame, objects: pl.DataFrame, on: list[str]) -> pa.Table:
    """Return CLOCK_LINES: each view with the objects that are equal in the columns `on`.

    The position of the object is the apparent one for the sensor of the row: where its light left.
    """
    rows = (
        views.rename({name: f"sensor_{name}" for name in POSITION})
        .drop_nulls([f"sensor_{name}" for name in VELOCITY])
        .join(objects, on=on, maintain_order="left")
    )
    x_km = apparent_positions(
        stack(rows, "{}_km"),
        stack(rows, "v{}_km_s"),
        rows["light_s"].to_numpy(),
        stack(rows, "sensor_{}_km"),
    )
    rows = rows.with_columns(pl.Series(name, x_km[:, k]) for k, name in enumerate(POSITION))
    return from_polars(CLOCK_LINES, rows.select(CLOCK_LINES.names))
