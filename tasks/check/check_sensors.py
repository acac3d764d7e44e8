"""Check sensors: each sensor's clock, ephemeris and attitude over the night."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import SolvedParts, ViewedParts
from epipole.schemas.bridge import array, concat, stack, stack_covariance, to_polars
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.rejects import Reason
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import CLOCK_LINES, OBJECT_VIEWS, VIEWS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.sensor_faults.clock_search import CandidatePairs, search_offset
from epipole.tasks.algorithms.sensor_faults.fault_judgement import (
    ATTITUDE,
    CLOCK,
    DISAGREES,
    EPHEMERIS,
    SOUND,
    Lines,
)
from epipole.tasks.algorithms.sensor_faults.suspects import judge_many_sensors
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.sample_sight_lines import meetings

Array = npt.NDArray[np.float64]

MAX_EPOCHS = 300  # more do not help: the offset is one constant
MAX_LINES = 30_000  # of sight to objects, of all sensors together
MAX_PAIRS = 100_000  # of a view and an object, of one sensor
KEY = ["epoch", "object_id", "sensor_id"]
KNOWN_S = 1.0  # with a larger sigma a clock counts as unknown


# The reasons for which a sensor is left out, by its fault.
REASONS = {
    CLOCK: Reason.CLOCK_OFF,
    EPHEMERIS: Reason.EPHEMERIS_OFF,
    ATTITUDE: Reason.ATTITUDE_OFF,
    DISAGREES: Reason.DISAGREES,
}


class SensorVerdict(NamedTuple):
    """What the check says of a sensor.

    `offset_s` is the clock offset, reported minus true time, with its 1-sigma error `sigma_s`.
    `cause` is the fault that is sure, '' for a sound sensor; `size` and `size_sigma` are those of
    a wrong ephemeris [km] or attitude [rad].
    """

    sensor_id: str
    offset_s: float
    sigma_s: float
    cause: str = SOUND
    size: float = 0.0
    size_sigma: float = 0.0

    @property
    def is_late(self) -> bool:
        """Whether the clock is surely wrong, late or early."""
        return self.cause == CLOCK

    @property
    def is_faulty(self) -> bool:
        """Whether any fault is sure."""
        return self.cause != SOUND

    def __str__(self) -> str:
        """Return the verdict as a sentence."""
        if self.cause == EPHEMERIS:
            return (
                f"the ephemeris of {self.sensor_id} is {self.size:.3f} km off "
                f"(sigma {self.size_sigma:.3f} km)"
            )
        if self.cause == ATTITUDE:
            return (
                f"the attitude of {self.sensor_id} is {self.size / ARCSEC:.1f} arcsec off "
                f"(sigma {self.size_sigma / ARCSEC:.1f} arcsec)"
            )
        if self.cause == DISAGREES:
            return f"{self.sensor_id} disagrees with the other sensors; its fault is not clear"
        side = "late" if self.offset_s > 0 else "early"
        return (
            f"the clock of {self.sensor_id} is {abs(self.offset_s):.3f} s {side} "
            f"(sigma {self.sigma_s:.3f} s)"
        )


@stage_task(Stage.CHECK, "sensors")
def check_sensors(
    solved: SolvedParts, viewed: ViewedParts, sensors: Sequence[Sensor], spans: Sequence[Span]
) -> list[SensorVerdict]:
    """Return the verdicts on the sensors that the lines of sight of the night determine.

    Parameters
    ----------
    solved
        The parts of `solve` of these spans.
    viewed
        The parts of the views of the sensors.
    """
    epochs = _epochs(solved, spans)
    if not len(epochs):
        return []
    lines, objects = (_of_objects(solved, spans, name, epochs) for name in ("lines", "objects"))
    claims = _at(solved, spans, "object_views", epochs).partition_by("sensor_id", as_dict=True)
    nothing = pl.DataFrame(OBJECT_VIEWS.empty_table())
    first_guess, of_objects = {}, [lines]
    for number, name in sensors:
        own = claims.get((name,), nothing)
        match = _search(_others(viewed[number], spans, own, objects))
        if match is not None:
            first_guess[name], matched = match
            of_objects.append(matched.join(lines, on=KEY, how="anti"))
    return verdicts_of(pl.concat(of_objects), first_guess)


def _epochs(solved: SolvedParts, spans: Sequence[Span]) -> pl.Series:
    """Return some of the epochs with lines of sight, evenly spread."""
    columns = [CLOCK_LINES.empty_table().select(["epoch"])]
    columns += [rows for span in spans for rows in solved.read(span, "lines", ["epoch"])]
    per_epoch = to_polars(pa.concat_tables(columns)).group_by("epoch").len().sort("epoch")
    fewer = max(len(per_epoch) / MAX_EPOCHS, per_epoch["len"].sum() / MAX_LINES)
    return per_epoch["epoch"][:: max(math.ceil(fewer), 1)]


def _at(solved: SolvedParts, spans: Sequence[Span], name: str, epochs: pl.Series) -> pl.DataFrame:
    """Return a table's rows at some epochs, with the span that each is of."""
    return pl.concat(
        to_polars(rows)
        .filter(pl.col("epoch").is_in(epochs.implode()))
        .with_columns(span=pl.lit(span.folder))
        for span in spans
        for rows in solved.read(span, name)
    )


def _of_objects(
    solved: SolvedParts, spans: Sequence[Span], name: str, epochs: pl.Series
) -> pl.DataFrame:
    """Return a table's rows at some epochs; the ids of objects, which are those of the span, are
    made ids of the night."""
    rows = _at(solved, spans, name, epochs)
    return rows.with_columns(object_id=pl.format("{}/{}", "span", "object_id")).drop("span")


def _others(
    viewed: Parts, spans: Sequence[Span], own: pl.DataFrame, objects: pl.DataFrame
) -> pl.DataFrame:
    """Return the views of a sensor that are of no object, each with every object of its epoch.

    If a sensor's clock is seconds off, none of its views fits an object. A sensor with most of its
    views on objects has none that are to be searched.

    Parameters
    ----------
    own
        OBJECT_VIEWS of the sensor.
    """
    epochs = objects["epoch"].unique().sort()
    tables = [viewed.read(span, "views") for span in spans if viewed.holds(span)]
    wanted = epochs.cast(pl.Int64).to_numpy()
    at = [np.flatnonzero(np.isin(array(rows, "epoch"), wanted)) for rows in tables]
    if 2 * len(own) >= sum(map(len, at)):
        return pl.DataFrame(CLOCK_LINES.empty_table())
    views = concat(VIEWS, [rows.take(k) for rows, k in zip(tables, at, strict=True)])
    free = to_polars(views).join(own, on=["epoch", "tracklet_id"], how="anti")
    n_objects = objects.group_by("epoch").agg(n=pl.len())
    pairs = free.select("epoch").join(n_objects, on="epoch")["n"].sum()
    fewer = epochs[:: max(-(-pairs // MAX_PAIRS), 1)]
    return to_polars(
        meetings(free.filter(pl.col("epoch").is_in(fewer.implode())), objects, on=["epoch"])
    )


def verdicts_of(
    rows: pl.DataFrame, first_guess: Mapping[str, float] | None = None
) -> list[SensorVerdict]:
    """Return the verdicts that CLOCK_LINES determine, by sensor.

    `first_guess` are clock offsets that were found, by sensor [s].
    """
    guess = first_guess or {}
    rows = rows.sort("epoch", "object_id", "sensor_id")
    if not len(rows):
        return []
    # A few tracklets may be blends throughout: no error of the attitude.
    spread = (pl.col("cov_bias_11_rad2") + pl.col("cov_bias_22_rad2")) / 2
    bias = rows.group_by("sensor_id").agg(
        pl.col("position_sigma_km").max(), attitude_sigma_rad=spread.quantile(0.9).sqrt()
    ).sort("sensor_id")  # fmt: skip
    judged = judge_many_sensors(
        _lines(rows, bias["sensor_id"]),
        bias["position_sigma_km"].to_numpy(),
        bias["attitude_sigma_rad"].to_numpy(),
        np.array([guess.get(name, 0.0) for name in bias["sensor_id"]]),
    )
    verdicts = [
        SensorVerdict(name, float(offset), float(sigma), cause, float(size), float(size_sigma))
        for name, offset, sigma, cause, size, size_sigma in zip(
            bias["sensor_id"], *judged, strict=True
        )
    ]
    return [one for one in verdicts if one.sigma_s < KNOWN_S or one.is_faulty]


def _search(free: pl.DataFrame) -> tuple[float, pl.DataFrame] | None:
    """Return the offset at which a sensor's views fit objects, and these views."""
    if not len(free):
        return None
    match = search_offset(
        CandidatePairs(
            tracklet=free["tracklet_id"].rank("dense").to_numpy().astype(np.int64),
            object=free["object_id"].rank("dense").to_numpy().astype(np.int64),
            u=stack(free, "u{}"),
            cov=_direction_cov(free, "noise") + _direction_cov(free, "bias"),
            r_km=stack(free, "sensor_{}_km"),
            v_sensor_km_s=stack(free, "sensor_v{}_km_s"),
            sigma_km=free["position_sigma_km"].to_numpy(),
            x_km=stack(free, "{}_km"),
            v_km_s=stack(free, "v{}_km_s"),
            cov_km2=stack_covariance(free, "cov_{}"),
        )
    )
    return None if match is None else (match.offset_s, free[match.row])


def _lines(rows: pl.DataFrame, sensors: pl.Series) -> Lines:
    """Return views of objects as lines of sight; sensors are numbered in the given order."""
    return Lines(
        group=rows.select(pl.struct("epoch", "object_id").rle_id()).to_series().to_numpy(),
        sensor=np.asarray(sensors.search_sorted(rows["sensor_id"]), np.int64),
        u=stack(rows, "u{}"),
        cov=_direction_cov(rows, "noise"),
        x_km=stack(rows, "{}_km"),
        v_km_s=stack(rows, "v{}_km_s"),
        r_km=stack(rows, "sensor_{}_km"),
        v_sensor_km_s=stack(rows, "sensor_v{}_km_s"),
    )


def _direction_cov(rows: pl.DataFrame, which: str) -> Array:
    return stack_covariance(rows, f"cov_{which}_{{}}_rad2", TANGENT_AXES)


def as_in_the_logs(
    before: Sequence[SensorVerdict], now: Sequence[SensorVerdict]
) -> list[SensorVerdict]:
    """Return the verdicts with the clock offsets of the logs: corrections so far and the rest."""
    corrected = {verdict.sensor_id: verdict for verdict in before if verdict.is_late}
    total = [
        verdict._replace(
            offset_s=verdict.offset_s + corrected[verdict.sensor_id].offset_s,
            cause=verdict.cause or CLOCK,
        )
        if verdict.sensor_id in corrected
        else verdict
        for verdict in now
    ]
    judged = {verdict.sensor_id for verdict in now}
    total += [verdict for name, verdict in corrected.items() if name not in judged]
    return sorted(total)
