"""Estimate clocks: each sensor's clock offset over the night, and frames put right by it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.work.files import read_part
from epipole.schemas.bridge import array, table
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.algorithms.sensor_faults.clock_offset import Lines, clock_offsets
from epipole.tasks.algorithms.sensor_faults.clock_search import Meetings, search_offset
from epipole.tasks.common.spans import Span

Array = npt.NDArray[np.float64]

VELOCITY_WINDOW_S = 30.0  # positions this near give an object's velocity
MOST_EPOCHS = 300  # more tell nothing new of a constant
MOST_PAIRS = 200_000  # of a view and an object: bounds the memory
KNOWN_S = 1.0  # a sigma above this says nothing of a clock
POSITION_COV = [f"cov_{ab}" for ab in ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")]
PLACE = ["x_km", "y_km", "z_km"]
VELOCITY = ["vx_km_s", "vy_km_s", "vz_km_s"]


class Clock(NamedTuple):
    """A sensor's clock: reported minus true time of its frames, and its 1-sigma error.

    `is_off`: the offset is real.
    """

    sensor_id: str
    offset_s: float
    sigma_s: float
    is_off: bool

    def __str__(self) -> str:
        """Return it as people read it."""
        side = "late" if self.offset_s > 0 else "early"
        return (
            f"the clock of {self.sensor_id} is {abs(self.offset_s):.3f} s {side} "
            f"(sigma {self.sigma_s:.3f} s)"
        )


@task(name="estimate clocks", cache_policy=NO_CACHE)
def estimate_clocks(solved: Path, spans: Sequence[Span]) -> list[Clock]:
    """Return the clocks that a night's lines of sight tell something of, by sensor.

    Parameters
    ----------
    solved
        Parts by `solve_span`, of these spans.
    """
    parts = []
    for span in spans:
        rows = _frame(read_part(solved / span.folder, "clock_views"))
        # Objects are numbered in each span anew.
        own = pl.format("{}/{}", pl.lit(span.folder), "object_id")
        parts.append(rows.with_columns(object_id=own))
    if not parts:
        return []
    rows = pl.concat(parts)
    epochs = rows["epoch"].unique().sort()
    kept = epochs[:: max(-(-len(epochs) // MOST_EPOCHS), 1)]
    return clocks_of(rows.filter(pl.col("epoch").is_in(kept.implode())))


def clocks_of(rows: pl.DataFrame) -> list[Clock]:
    """Return the clocks that views beside objects (`objects_views`) tell something of."""
    claimed = rows.filter(pl.col("claimed"))
    guess, found = {}, [claimed]
    for (name,), own in rows.group_by("sensor_id", maintain_order=True):
        match = _search(own.filter(~pl.col("claimed")))
        if match is not None:
            guess[str(name)], met = match
            found.append(met.join(claimed, on=["epoch", "object_id", "sensor_id"], how="anti"))
    rows = pl.concat(found).sort("epoch", "object_id", "sensor_id")
    if not len(rows):
        return []
    spread = (pl.col("cov_bias_11_rad2") + pl.col("cov_bias_22_rad2")) / 2
    bias = rows.group_by("sensor_id").agg(
        pl.col("position_sigma_km").max(), attitude_sigma_rad=spread.max().sqrt()
    ).sort("sensor_id")  # fmt: skip
    offsets = clock_offsets(
        _lines(rows, bias["sensor_id"]),
        bias["position_sigma_km"].to_numpy(),
        bias["attitude_sigma_rad"].to_numpy(),
        np.array([guess.get(name, 0.0) for name in bias["sensor_id"]]),
    )
    return [
        Clock(name, float(offset), float(sigma), bool(off))
        for name, offset, sigma, off in zip(bias["sensor_id"], *offsets, strict=True)
        if sigma < KNOWN_S
    ]


def objects_views(
    views: pa.Table,
    associations: pa.Table,
    positions: pa.Table,
    solutions: pa.Table,
    settings: Settings,
) -> pl.DataFrame:
    """Return views beside objects: those of each object, and all others beside all of them.

    `views` are all views, not only those of objects: a sensor whose clock is seconds off sees
    none of the objects where they are, and is held against those that the others found.

    Epochs that share detections would count twice: one in each width of the local motion is
    used, `MOST_EPOCHS` at most.
    """
    key = ["epoch", "sensor_id", "frame_number", "x_px", "y_px"]
    whose = _frame(associations).select([*key, "object_id"])
    objects = _with_velocities(_frame(positions))
    epochs = _apart(objects["epoch"].unique().sort(), 2 * settings.alignment.window_s)
    frames = _frame(solutions).select(["sensor_id", "frame_number", *VELOCITY])
    seen = (
        _frame(views)
        .rename({name: f"sensor_{name}" for name in PLACE})
        .filter(pl.col("epoch").is_in(epochs.implode()))
        .join(whose, on=key, how="left")
        .join(frames.rename({name: f"sensor_{name}" for name in VELOCITY}),
              on=["sensor_id", "frame_number"])
        .drop_nulls([f"sensor_{name}" for name in VELOCITY])
        .with_columns(claimed=pl.col("object_id").is_not_null())
    )  # fmt: skip
    of_objects = seen.filter(pl.col("claimed")).join(objects, on=["epoch", "object_id"])
    free = _thinned(seen.filter(~pl.col("claimed")).drop("object_id"), objects).join(
        objects, on="epoch"
    )
    return pl.concat([of_objects, free.select(of_objects.columns)]).sort(
        "sensor_id", "epoch", "tracklet_id", "object_id"
    )


def _thinned(free: pl.DataFrame, objects: pl.DataFrame) -> pl.DataFrame:
    """Return the views of so few epochs that beside all objects they are not too many."""
    n_objects = objects.group_by("epoch").agg(n=pl.len())
    pairs = free.select("epoch").join(n_objects, on="epoch")["n"].sum()
    epochs = free["epoch"].unique().sort()[:: max(-(-pairs // MOST_PAIRS), 1)]
    return free.filter(pl.col("epoch").is_in(epochs.implode()))


def _search(free: pl.DataFrame) -> tuple[float, pl.DataFrame] | None:
    """Return the offset that lets a sensor see the objects, and its views of them then."""
    if not len(free):
        return None
    match = search_offset(
        Meetings(
            tracklet=free["tracklet_id"].rank("dense").to_numpy().astype(np.int64),
            item=free["object_id"].rank("dense").to_numpy().astype(np.int64),
            u=free.select("ux", "uy", "uz").to_numpy(),
            cov=_covariance(free, "noise") + _covariance(free, "bias"),
            r_km=free.select([f"sensor_{name}" for name in PLACE]).to_numpy(),
            v_sensor_km_s=free.select([f"sensor_{name}" for name in VELOCITY]).to_numpy(),
            sigma_km=free["position_sigma_km"].to_numpy(),
            x_km=free.select(PLACE).to_numpy(),
            v_km_s=free.select(VELOCITY).to_numpy(),
            cov_km2=_stacked(free, POSITION_COV).reshape(-1, 3, 3),
        )
    )
    return None if match is None else (match.offset_s, free[match.row])


def _lines(rows: pl.DataFrame, sensors: pl.Series) -> Lines:
    """Return views of objects as lines of sight, the sensors numbered in order."""
    return Lines(
        group=rows.select(pl.struct("epoch", "object_id").rle_id()).to_series().to_numpy(),
        sensor=np.asarray(sensors.search_sorted(rows["sensor_id"]), np.int64),
        u=rows.select("ux", "uy", "uz").to_numpy(),
        cov=_covariance(rows, "noise"),
        x_km=rows.select(PLACE).to_numpy(),
        v_km_s=rows.select(VELOCITY).to_numpy(),
        r_km=rows.select([f"sensor_{name}" for name in PLACE]).to_numpy(),
        v_sensor_km_s=rows.select([f"sensor_{name}" for name in VELOCITY]).to_numpy(),
    )


def _covariance(rows: pl.DataFrame, which: str) -> Array:
    names = [f"cov_{which}_{ab}_rad2" for ab in ("11", "12", "12", "22")]
    return _stacked(rows, names).reshape(-1, 2, 2)


def _stacked(rows: pl.DataFrame, names: list[str]) -> Array:
    return np.stack([rows[name].to_numpy() for name in names], axis=1)


def _frame(rows: pa.Table) -> pl.DataFrame:
    frame = pl.from_arrow(rows)
    return frame if isinstance(frame, pl.DataFrame) else frame.to_frame()


def _apart(epochs: pl.Series, apart_s: float) -> pl.Series:
    """Return epochs that lie at least so far apart, evenly thinned where they are too many."""
    kept: list[int] = []
    time_ns = epochs.cast(pl.Int64).to_numpy()
    for k, t in enumerate(time_ns):
        if not kept or t - time_ns[kept[-1]] >= apart_s * 1e9:
            kept.append(k)
    return epochs[kept[:: max(-(-len(kept) // MOST_EPOCHS), 1)]]


def _with_velocities(positions: pl.DataFrame) -> pl.DataFrame:
    """Return the positions with the velocities that the neighbouring ones show."""
    positions = positions.sort("object_id", "epoch")
    size = positions.group_by("object_id", maintain_order=True).len()["len"].to_numpy()
    offsets = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    time_ns = positions["epoch"].cast(pl.Int64).to_numpy()
    time_s = (time_ns - (time_ns.min() if len(time_ns) else 0)) / 1e9
    v = velocities(offsets, time_s, positions.select(PLACE).to_numpy(), VELOCITY_WINDOW_S)
    columns = [pl.Series(name, v[:, k]) for k, name in enumerate(VELOCITY)]
    own = ["epoch", "object_id", *PLACE, *sorted(set(POSITION_COV))]
    return positions.select(own).with_columns(columns)


def added(before: list[Clock], now: list[Clock]) -> list[Clock]:
    """Return clocks as the logs have them: what was put right before, and what is left."""
    done = {clock.sensor_id: clock for clock in before if clock.is_off}
    out = [
        clock._replace(
            offset_s=clock.offset_s + done[clock.sensor_id].offset_s, is_off=True
        ) if clock.sensor_id in done else clock
        for clock in now
    ]  # fmt: skip
    left = {clock.sensor_id for clock in now}
    out += [clock for name, clock in done.items() if name not in left]
    return sorted(out)


def without_sensors(views: pa.Table, left_out: Sequence[str]) -> tuple[pa.Table, pa.Table]:
    """Return the views without those of sensors whose clocks are off, and a reject for each."""
    wrong = pc.is_in(views["sensor_id"], pa.array(list(left_out), pa.string()))
    found = pl.DataFrame(views.filter(wrong)).group_by("sensor_id").agg(
        time=pl.col("epoch").min(), count=pl.len()
    ).sort("sensor_id")  # fmt: skip
    n = len(found)
    rejects = {
        "source": pa.nulls(n, pa.string()),
        "offset": pa.nulls(n, pa.int64()),
        "sensor_id": found["sensor_id"].to_arrow(),
        "time": found["time"].to_arrow(),
        "stage": ["clocks"] * n,
        "reason": ["clock_off"] * n,
        "count": found["count"].cast(pl.Int64).to_arrow(),
    }
    return views.filter(pc.invert(wrong)), table(REJECTS, rejects)


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
