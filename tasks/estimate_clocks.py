"""Estimate clocks: each sensor's clock offset over the night, and frames put right by it."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.schemas.bridge import array, table
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.clock_offset import Lines, clock_offsets
from epipole.tasks.algorithms.object_motion import velocities

Array = npt.NDArray[np.float64]

VELOCITY_WINDOW_S = 30.0  # positions this near give an object's velocity
SURE_SIGMA = 5.0  # an offset this far from zero is real
KNOWN_S = 1.0  # a sigma above this says nothing of a clock
PLACE = ["x_km", "y_km", "z_km"]
VELOCITY = ["vx_km_s", "vy_km_s", "vz_km_s"]


class Clock(NamedTuple):
    """A sensor's clock: reported minus true time of its frames, and its 1-sigma error."""

    sensor_id: str
    offset_s: float
    sigma_s: float

    @property
    def is_off(self) -> bool:
        """Whether the offset is real."""
        return abs(self.offset_s) > SURE_SIGMA * self.sigma_s

    def __str__(self) -> str:
        """Return it as people read it."""
        side = "late" if self.offset_s > 0 else "early"
        return (
            f"the clock of {self.sensor_id} is {abs(self.offset_s):.3f} s {side} "
            f"(sigma {self.sigma_s:.3f} s)"
        )


@task(name="estimate clocks", cache_policy=NO_CACHE)
def estimate_clocks(
    views: pa.Table,
    associations: pa.Table,
    positions: pa.Table,
    solutions: pa.Table,
    settings: Settings,
) -> list[Clock]:
    """Return the clocks that the lines of sight tell something of, by sensor.

    Epochs that share detections would count twice: one in each width of the local motion is
    used. Only views that the positions used take part.
    """
    lines, bias = _used_views(views, associations, positions, solutions, settings)
    if not len(bias):
        return []
    offset_s, sigma_s = clock_offsets(
        lines, bias["position_sigma_km"].to_numpy(), bias["attitude_sigma_rad"].to_numpy()
    )
    return [
        Clock(name, float(offset), float(sigma))
        for name, offset, sigma in zip(bias["sensor_id"], offset_s, sigma_s, strict=True)
        if sigma < KNOWN_S
    ]


def _used_views(
    views: pa.Table,
    associations: pa.Table,
    positions: pa.Table,
    solutions: pa.Table,
    settings: Settings,
) -> tuple[Lines, pl.DataFrame]:
    """Return the used views as lines of sight, and a row a sensor with its biases."""
    key = ["epoch", "sensor_id", "frame_number", "x_px", "y_px"]
    claimed = _frame(associations).filter("used").select([*key, "object_id"])
    objects = _with_velocities(_frame(positions))
    epochs = _apart(objects["epoch"].unique().sort(), 2 * settings.alignment.window_s)
    frames = _frame(solutions).select(["sensor_id", "frame_number", *VELOCITY])
    rows = (
        _frame(views)
        .rename({name: f"sensor_{name}" for name in PLACE})
        .filter(pl.col("epoch").is_in(epochs.implode()))
        .join(claimed, on=key)
        .join(objects, on=["epoch", "object_id"])
        .join(frames, on=["sensor_id", "frame_number"], suffix="_sensor")
        .drop_nulls([f"{name}_sensor" for name in VELOCITY])
        .sort("epoch", "object_id", "sensor_id")
    )
    spread = (pl.col("cov_bias_11_rad2") + pl.col("cov_bias_22_rad2")) / 2
    bias = rows.group_by("sensor_id").agg(
        pl.col("position_sigma_km").max(), attitude_sigma_rad=spread.max().sqrt()
    ).sort("sensor_id")  # fmt: skip
    sensor: Any = bias["sensor_id"].search_sorted(rows["sensor_id"]) if len(rows) else []
    lines = Lines(
        group=rows.select(pl.struct("epoch", "object_id").rle_id()).to_series().to_numpy(),
        sensor=np.asarray(sensor, np.int64),
        u=rows.select("ux", "uy", "uz").to_numpy(),
        cov=np.stack([rows[f"cov_noise_{ab}_rad2"].to_numpy() for ab in ("11", "12", "12", "22")],
                     axis=1).reshape(-1, 2, 2),
        x_km=rows.select(PLACE).to_numpy(),
        v_km_s=rows.select(VELOCITY).to_numpy(),
        r_km=rows.select([f"sensor_{name}" for name in PLACE]).to_numpy(),
        v_sensor_km_s=rows.select([f"{name}_sensor" for name in VELOCITY]).to_numpy(),
    )  # fmt: skip
    return lines, bias


def _frame(rows: pa.Table) -> pl.DataFrame:
    frame = pl.from_arrow(rows)
    return frame if isinstance(frame, pl.DataFrame) else frame.to_frame()


def _apart(epochs: pl.Series, apart_s: float) -> pl.Series:
    """Return epochs that lie at least so far apart."""
    kept: list[int] = []
    time_ns = epochs.cast(pl.Int64).to_numpy()
    for k, t in enumerate(time_ns):
        if not kept or t - time_ns[kept[-1]] >= apart_s * 1e9:
            kept.append(k)
    return epochs[kept]


def _with_velocities(positions: pl.DataFrame) -> pl.DataFrame:
    """Return the positions with the velocities that the neighbouring ones show."""
    positions = positions.sort("object_id", "epoch")
    size = positions.group_by("object_id", maintain_order=True).len()["len"].to_numpy()
    offsets = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    time_ns = positions["epoch"].cast(pl.Int64).to_numpy()
    time_s = (time_ns - (time_ns.min() if len(time_ns) else 0)) / 1e9
    v = velocities(offsets, time_s, positions.select(PLACE).to_numpy(), VELOCITY_WINDOW_S)
    columns = [pl.Series(name, v[:, k]) for k, name in enumerate(VELOCITY)]
    return positions.select(["epoch", "object_id", *PLACE]).with_columns(columns)


def set_clocks(rows: pa.Table, clocks: list[Clock]) -> pa.Table:
    """Return rows of frames at their true times, where a clock is surely off."""
    late_ns = {clock.sensor_id: round(clock.offset_s * 1e9) for clock in clocks if clock.is_off}
    late = np.array([late_ns.get(s, 0) for s in rows["sensor_id"].to_pylist()], np.int64)
    at = rows.schema.get_field_index("time")
    field = rows.schema.field(at)
    return rows.set_column(at, field, pa.array(array(rows, "time") - late).cast(field.type))


def set_places(solutions: pa.Table, places: pa.Table) -> pa.Table:
    """Return the solutions with where their sensors were, from a row of `places` a frame."""
    by_frame = ["sensor_id", "frame_number"]
    names = [*PLACE, *VELOCITY, "position_sigma_km"]
    right = _frame(places).select([*by_frame, *names])
    moved = _frame(solutions).select(by_frame).join(
        right, on=by_frame, how="left", maintain_order="left"
    )  # fmt: skip
    columns = {name: solutions[name] for name in solutions.column_names}
    return table(SOLUTIONS, columns | {name: moved[name].to_arrow() for name in names})
