"""Collect clock views: the views and objects of a span that the check of clocks needs."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.schemas.bridge import from_polars, stack, to_polars
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import CLOCK_VIEWS
from epipole.tasks.algorithms.geometry.light_time import apparent_places
from epipole.tasks.algorithms.orbits.object_motion import velocities

VELOCITY_WINDOW_S = 30.0  # positions within this time give an object's velocity
MOST_EPOCHS = 300  # more do not help: the offset is one constant
MOST_PAIRS = 200_000  # pairs of a view and an object: limits the memory
POSITION_COV = ["cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]
PLACE = ["x_km", "y_km", "z_km"]
VELOCITY = ["vx_km_s", "vy_km_s", "vz_km_s"]


def collect_clock_views(
    views: pa.Table,
    of_objects: pa.Table,
    associations: pa.Table,
    positions: pa.Table,
    settings: Settings,
) -> pa.Table:
    """Return CLOCK_VIEWS: each object with its views, and all other views with every object.

    `views` are all views, not only those of objects, and `of_objects` the corrected ones that
    positions were solved from. If a sensor's clock is seconds off, none of its views fits an
    object, so they are compared with the objects of the other sensors.

    Epochs nearer than twice the window of the local motion share detections. So only some epochs
    are used, `MOST_EPOCHS` at most.
    """
    key = ["epoch", "sensor_id", "frame_number", "x_px", "y_px"]
    claims = to_polars(associations).select([*key, "object_id"])
    objects = _with_velocities(to_polars(positions))
    epochs = _apart(objects["epoch"].unique().sort(), 2 * settings.alignment.window_s)
    corrected = to_polars(of_objects)
    seen = pl.concat([to_polars(views).join(corrected, on=key, how="anti"), corrected])
    with_sensors = (
        seen.rename({name: f"sensor_{name}" for name in PLACE})
        .filter(pl.col("epoch").is_in(epochs.implode()))
        .join(claims, on=key, how="left")
        .drop_nulls([f"sensor_{name}" for name in VELOCITY])
        .with_columns(claimed=pl.col("object_id").is_not_null())
    )  # fmt: skip
    claimed = with_sensors.filter(pl.col("claimed")).join(objects, on=["epoch", "object_id"])
    free = with_sensors.filter(~pl.col("claimed")).drop("object_id")
    free = _thinned(free, objects).join(objects, on="epoch")
    rows = _with_light_time(pl.concat([claimed, free.select(claimed.columns)])).sort(
        "sensor_id", "epoch", "tracklet_id", "object_id"
    )
    return from_polars(CLOCK_VIEWS, rows)


def _with_light_time(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows with each object where its light left for the sensor of the row."""
    x_km = apparent_places(
        stack(rows, "{}_km"),
        stack(rows, "v{}_km_s"),
        rows["light_s"].to_numpy(),
        stack(rows, "sensor_{}_km"),
    )
    return rows.with_columns(pl.Series(name, x_km[:, k]) for k, name in enumerate(PLACE))


def _thinned(free: pl.DataFrame, objects: pl.DataFrame) -> pl.DataFrame:
    """Return the views of fewer epochs, so that they make at most `MOST_PAIRS` with objects."""
    n_objects = objects.group_by("epoch").agg(n=pl.len())
    pairs = free.select("epoch").join(n_objects, on="epoch")["n"].sum()
    epochs = free["epoch"].unique().sort()[:: max(-(-pairs // MOST_PAIRS), 1)]
    return free.filter(pl.col("epoch").is_in(epochs.implode()))


def _apart(epochs: pl.Series, apart_s: float) -> pl.Series:
    """Return epochs that are at least so far apart, `MOST_EPOCHS` at most, evenly spread."""
    kept: list[int] = []
    time_ns = epochs.cast(pl.Int64).to_numpy()
    for k, t in enumerate(time_ns):
        if not kept or t - time_ns[kept[-1]] >= apart_s * 1e9:
            kept.append(k)
    return epochs[kept[:: max(-(-len(kept) // MOST_EPOCHS), 1)]]


def _with_velocities(positions: pl.DataFrame) -> pl.DataFrame:
    """Return the positions, with velocities from the positions near them in time.

    `light_s` is the light time from a position to its epoch.
    """
    positions = positions.sort("object_id", "epoch")
    size = positions.group_by("object_id", maintain_order=True).len()["len"].to_numpy()
    offsets = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    time_ns = positions["epoch"].cast(pl.Int64).to_numpy()
    time_s = (time_ns - (time_ns.min() if len(time_ns) else 0)) / 1e9
    v, _ = velocities(offsets, time_s, positions.select(PLACE).to_numpy(), VELOCITY_WINDOW_S)
    columns = [pl.Series(name, v[:, k]) for k, name in enumerate(VELOCITY)]
    light_ns = pl.col("epoch").cast(pl.Int64) - pl.col("time").cast(pl.Int64)
    return positions.select(
        "epoch", "object_id", *PLACE, *POSITION_COV, light_s=light_ns / 1e9
    ).with_columns(columns)
