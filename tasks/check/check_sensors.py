"""Check sensors: each sensor's clock, ephemeris and attitude over the night."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import SensorFault, SolvedParts, ViewedParts
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, concat, stack, stack_covariance, to_polars
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.rejects import Reason
from epipole.schemas.spans import DAY_NS, Sensor, Span
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
    Doubt,
    Lines,
)
from epipole.tasks.algorithms.sensor_faults.suspects import judge_many_sensors
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.sample_sight_lines import pair_with_objects

MAX_EPOCHS = 300  # more do not help: the offset is constant
MAX_LINES = 30_000  # lines of sight to objects, of all sensors together
MAX_PAIRS = 100_000  # pairs of a view and an object, per sensor
KEY = ["epoch", "object_id", "sensor_id"]
# Minimum number of objects of a sensor that others see too. With three, two of five sensors that
# were wrong, by 1.1 km and 0.34 s, were not judged: positions were 1.5 times as wrong as stated.
MIN_OBJECTS = 2
MAX_KNOWN_SIGMA_S = 1.0  # a clock with a larger sigma is unknown
# Speed of low satellites: a wrong clock shifts a sensor and its objects by this times its offset.
SPEED_KM_S = 7.6
# Angular rate of low satellites. An error along the orbit, or of a body's axes, turns with it. If a
# constant bias in inertial axes is taken off, this rate times the time, times its size, is left.
TURN_RAD_S = 1.1e-3
# Maximum errors with which a sensor at fault takes part: with larger ones, its lines of sight meet
# any others.
MAX_ADDED_KM, MAX_ADDED_RAD = 10.0, 600 * ARCSEC


# The reasons for which a sensor is left out, by its fault.
REASONS = {
    CLOCK: Reason.CLOCK_OFF,
    EPHEMERIS: Reason.EPHEMERIS_OFF,
    ATTITUDE: Reason.ATTITUDE_OFF,
    DISAGREES: Reason.DISAGREES,
}


class SensorVerdict(NamedTuple):
    """The clock offset of a sensor, and its fault.

    `offset_s` is the offset [s], reported minus true time, `sigma_s` its 1-sigma error. `cause` is
    the declared fault, '' for a sound sensor. `size` and `size_sigma` are the size of a wrong
    ephemeris [km] or attitude [rad] and its 1-sigma error; `bias` and `bias_sigma` are those of
    `JudgedSensors`. The offset of a clock that is `corrected` was taken off.
    """

    sensor_id: str
    offset_s: float
    sigma_s: float
    cause: str = SOUND
    size: float = 0.0
    size_sigma: float = 0.0
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias_sigma: float = 0.0
    corrected: bool = False

    @property
    def has_wrong_clock(self) -> bool:
        """Whether the clock is declared wrong, late or early."""
        return self.cause == CLOCK

    @property
    def is_still_wrong(self) -> bool:
        """Whether the clock is wrong and stays so: times are as the log has them."""
        return self.has_wrong_clock and not self.corrected

    @property
    def is_faulty(self) -> bool:
        """Whether a fault is declared."""
        return self.cause != SOUND

    def fault(self) -> SensorFault | None:
        """Return the fault with which the sensor takes part.

        Its error per axis is the fault's size over sqrt(2): two axes across a line of sight count.
        A wrong clock moves each line differently, so no bias is taken off. None if the fault is of
        unknown kind, too large, or corrected.
        """
        if self.corrected:
            return None
        size = math.hypot(self.size, self.bias_sigma) / math.sqrt(2.0)
        moved_km = SPEED_KM_S * math.hypot(self.offset_s, self.sigma_s)
        if self.cause == EPHEMERIS and size < MAX_ADDED_KM:
            return SensorFault(self.sensor_id, km=size, bias_km=self.bias, left_km=self.bias_sigma)
        if self.cause == ATTITUDE and size < MAX_ADDED_RAD:
            return SensorFault(
                self.sensor_id, rad=size, bias_rad=self.bias, left_rad=self.bias_sigma
            )
        if self.cause == CLOCK and moved_km < MAX_ADDED_KM:
            return SensorFault(self.sensor_id, km=moved_km, left_km=moved_km)
        return None

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


class JudgedSights(NamedTuple):
    """The verdicts on those sensors that a night's lines of sight can judge.

    `doubt` is about faults that cannot be assigned to a sensor.
    """

    verdicts: list[SensorVerdict]
    doubt: Doubt = Doubt()


@stage_task(Stage.CHECK, "sensors")
def check_sensors(
    solved: SolvedParts, viewed: ViewedParts, sensors: Sequence[Sensor], spans: Sequence[Span]
) -> JudgedSights:
    """Return the verdicts on those sensors that the night's lines of sight can judge.

    Parameters
    ----------
    solved
        The parts of stage `solve`.
    viewed
        The parts with the views of each sensor.
    """
    epochs = _epochs(solved, spans)
    if not len(epochs):
        return JudgedSights([])
    lines, objects = (
        _with_ids_of_night(solved, spans, name, epochs) for name in ("lines", "objects")
    )
    views_of_objects = _rows_at(solved, spans, "object_views", epochs).partition_by(
        "sensor_id", as_dict=True
    )
    nothing = pl.DataFrame(OBJECT_VIEWS.empty_table())
    first_guess, of_objects = {}, [lines]
    for sensor in sensors:
        name = sensor.sensor_id
        assigned = views_of_objects.get((name,), nothing)
        match = _search_clock(_candidate_pairs(viewed[sensor.number], spans, assigned, objects))
        if match is not None:
            first_guess[name], matched = match
            of_objects.append(matched.join(lines, on=KEY, how="anti"))
    return sensor_verdicts(pl.concat(of_objects), first_guess)


def _epochs(solved: SolvedParts, spans: Sequence[Span]) -> pl.Series:
    """Return evenly spread epochs with lines of sight, within `MAX_EPOCHS` and `MAX_LINES`."""
    columns = [CLOCK_LINES.empty_table().select(["epoch"])]
    columns += [rows for span in spans for rows in solved.read(span, "lines", ["epoch"])]
    per_epoch = to_polars(pa.concat_tables(columns)).group_by("epoch").len().sort("epoch")
    stride = max(len(per_epoch) / MAX_EPOCHS, per_epoch["len"].sum() / MAX_LINES)
    return per_epoch["epoch"][:: max(math.ceil(stride), 1)]


def _rows_at(
    solved: SolvedParts, spans: Sequence[Span], name: str, epochs: pl.Series
) -> pl.DataFrame:
    """Return a table's rows at some epochs, with their span."""
    return pl.concat(
        to_polars(rows)
        .filter(pl.col("epoch").is_in(epochs.implode()))
        .with_columns(span=pl.lit(span.folder))
        for span in spans
        for rows in solved.read(span, name)
    )


def _with_ids_of_night(
    solved: SolvedParts, spans: Sequence[Span], name: str, epochs: pl.Series
) -> pl.DataFrame:
    """Return a table's rows at some epochs; ids of objects in the span become ids in the night."""
    rows = _rows_at(solved, spans, name, epochs)
    return rows.with_columns(object_id=pl.format("{}/{}", "span", "object_id")).drop("span")


def _candidate_pairs(
    viewed: Parts, spans: Sequence[Span], assigned: pl.DataFrame, objects: pl.DataFrame
) -> pl.DataFrame:
    """Return the pairs of an unassigned view of a sensor and an object of its epoch.

    If a sensor's clock is seconds off, none of its views fits an object. A sensor with half of its
    views on objects, or more, is not searched: there are no pairs.

    Parameters
    ----------
    assigned
        The sensor's views that are assigned to objects, OBJECT_VIEWS.
    """
    epochs = objects["epoch"].unique().sort()
    tables = [viewed.read(span, "views") for span in spans if viewed.holds(span)]
    wanted = epochs.cast(pl.Int64).to_numpy()
    at = [np.flatnonzero(np.isin(array(rows, "epoch"), wanted)) for rows in tables]
    if 2 * len(assigned) >= sum(map(len, at)):
        return pl.DataFrame(CLOCK_LINES.empty_table())
    views = concat(VIEWS, [rows.take(k) for rows, k in zip(tables, at, strict=True)])
    free = to_polars(views).join(assigned, on=["epoch", "tracklet_id"], how="anti")
    n_objects = objects.group_by("epoch").agg(n=pl.len())
    pairs = free.select("epoch").join(n_objects, on="epoch")["n"].sum()
    stride = epochs[:: max(-(-pairs // MAX_PAIRS), 1)]
    return to_polars(
        pair_with_objects(
            free.filter(pl.col("epoch").is_in(stride.implode())), objects, on=["epoch"]
        )
    )


def sensor_verdicts(
    rows: pl.DataFrame, first_guess: Mapping[str, float] | None = None
) -> JudgedSights:
    """Return the verdicts on those sensors that CLOCK_LINES can judge, by sensor.

    `first_guess` has initial clock offsets by sensor [s]. Sensors with fewer than `MIN_OBJECTS`
    objects that others see too are not judged.
    """
    guess = first_guess or {}
    rows = _with_enough_objects(rows).sort("epoch", "object_id", "sensor_id")
    if not len(rows):
        return JudgedSights([])
    # A quantile: blends in a few tracklets are not an error of the attitude.
    stated = rows.group_by("sensor_id").agg(
        pl.col("position_sigma_km").max(),
        attitude_sigma_rad=pl.col("attitude_rad2").quantile(0.9).sqrt(),
    ).sort("sensor_id")  # fmt: skip
    judged = judge_many_sensors(
        _lines(rows, stated["sensor_id"]),
        stated["position_sigma_km"].to_numpy(),
        stated["attitude_sigma_rad"].to_numpy(),
        np.array([guess.get(name, 0.0) for name in stated["sensor_id"]]),
    )
    drift = TURN_RAD_S / math.sqrt(12.0) * _seconds(rows)
    left = np.hypot(judged.bias_sigma, judged.size * np.minimum(drift, 1.0))
    verdicts = [
        SensorVerdict(
            name,
            float(offset),
            float(sigma),
            cause,
            float(size),
            float(size_sigma),
            (float(bias[0]), float(bias[1]), float(bias[2])),
            float(bias_sigma),
        )
        for name, offset, sigma, cause, size, size_sigma, bias, bias_sigma in zip(
            stated["sensor_id"], *judged[:6], left, strict=True
        )
    ]
    known = [v for v in verdicts if v.sigma_s < MAX_KNOWN_SIGMA_S or v.is_faulty]
    return JudgedSights(known, judged.doubt)


def _seconds(rows: pl.DataFrame) -> Array:
    """Return for how long each sensor has views of objects [s], in the order of their ids."""
    last = pl.col("epoch").max() - pl.col("epoch").min()
    seconds = rows.group_by("sensor_id").agg(s=last.dt.total_microseconds() / 1e6)
    return seconds.sort("sensor_id")["s"].to_numpy()


def _with_enough_objects(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of sensors with `MIN_OBJECTS` objects or more that others of them see too.

    An error in the views of one object, such as those of its neighbour, looks like a fault of the
    sensor. Other objects contradict it.
    """
    # The id in the night begins with the span: an object counts once in all spans.
    rows = rows.with_columns(object=pl.col("object_id").str.split("/").list.last())
    while True:
        shared = rows.filter(pl.len().over("epoch", "object_id") > 1)
        count = shared.group_by("sensor_id").agg(n=pl.col("object").n_unique())
        enough = count.filter(pl.col("n") >= MIN_OBJECTS)["sensor_id"]
        kept = rows.filter(pl.col("sensor_id").is_in(enough.implode()))
        if len(kept) == len(rows):
            return rows.drop("object")
        rows = kept


def _search_clock(free: pl.DataFrame) -> tuple[float, pl.DataFrame] | None:
    """Return the clock offset at which a sensor's views fit objects, and these views."""
    if not len(free):
        return None
    match = search_offset(
        CandidatePairs(
            tracklet=free["tracklet_id"].rank("dense").to_numpy().astype(np.int64),
            object=free["object_id"].rank("dense").to_numpy().astype(np.int64),
            u=stack(free, "u{}"),
            cov_noise=_direction_cov(free, "noise"),
            cov_bias=_direction_cov(free, "bias"),
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
    """Return views of objects as `Lines`; sensors are numbered in the given order."""
    return Lines(
        group=rows.select(pl.struct("epoch", "object_id").rle_id()).to_series().to_numpy(),
        sensor=np.asarray(sensors.search_sorted(rows["sensor_id"]), np.int64),
        u=stack(rows, "u{}"),
        cov=_error_of_frames(rows) + _error_of_parts(rows),
        x_km=stack(rows, "{}_km"),
        v_km_s=stack(rows, "v{}_km_s"),
        r_km=stack(rows, "sensor_{}_km"),
        v_sensor_km_s=stack(rows, "sensor_v{}_km_s"),
    )


def _error_of_frames(rows: pl.DataFrame) -> Array:
    """Return the noise, enlarged because lines share frames: as independent errors [rad^2].

    Lines of a sensor at an epoch share the noise of its attitude. Lines of a tracklet at nearby
    epochs are fitted to the same detections: if each detection is in n fits, their mean is as wrong
    as if each line had an independent error of n times its variance.
    """
    at_epoch = rows.select(pl.len().over("sensor_id", "epoch")).to_series().to_numpy()
    turn = ((at_epoch - 1) * rows["turn_noise_rad2"].to_numpy())[:, None, None] * np.eye(2)
    return _fits_per_detection(rows)[:, None, None] * (_direction_cov(rows, "noise") + turn)


def _fits_per_detection(rows: pl.DataFrame) -> Array:
    """Return (n,): the mean number of lines of a tracklet to which a line's detections belong."""
    tracklet = rows.select(pl.struct("sensor_id", "tracklet_id").rank("dense")).to_series()
    start = rows["first_fitted"].min()
    # A tracklet's rank and a time, in microseconds, are one integer: no night, with what was read
    # around it, lasts four days.
    first, last = (
        tracklet.cast(pl.Int64) * (4 * DAY_NS // 1000)
        + (rows[name] - start).dt.total_microseconds()
        for name in ("first_fitted", "last_fitted")
    )
    begun, ended = np.sort(first.to_numpy()), np.sort(last.to_numpy())
    fits = [
        np.searchsorted(begun, at, side="right") - np.searchsorted(ended, at, side="left")
        for at in (first.to_numpy(), ((first + last) // 2).to_numpy(), last.to_numpy())
    ]
    return np.mean(fits, axis=0)


def _error_of_parts(rows: pl.DataFrame) -> Array:
    """Return what all lines in a part of a sensor's field share, as independent errors [rad^2].

    That is the bias without that of the attitude: of the fitted optics, which differs from part to
    part, and of neighbours' light. The mean of n lines with a shared error is as wrong as if each
    had an independent error of n times its variance.
    """
    shared = _direction_cov(rows, "bias")
    whole = np.trace(shared, axis1=1, axis2=2) / 2
    of_attitude = rows["attitude_rad2"].to_numpy() / np.where(whole > 0.0, whole, np.inf)
    n = rows.select(pl.len().over("sensor_id", "field_part")).to_series().to_numpy()
    return np.asarray((n * np.maximum(1.0 - of_attitude, 0.0))[:, None, None] * shared)


def _direction_cov(rows: pl.DataFrame, which: str) -> Array:
    return stack_covariance(rows, f"cov_{which}_{{}}_rad2", TANGENT_AXES)


def add_faults(
    before: Sequence[SensorVerdict], now: Sequence[SensorVerdict]
) -> list[SensorVerdict]:
    """Return the verdicts on the logs: faults found `before`, plus those found `now` without them.

    A sensor with another kind of fault than before disagrees.
    """
    known = {verdict.sensor_id: verdict for verdict in before if verdict.is_faulty}
    total = {verdict.sensor_id: verdict for verdict in (*before, *now)} | known
    for verdict in now:
        was = known.get(verdict.sensor_id)
        if verdict.is_faulty and was is not None and not was.is_still_wrong:
            bias = np.add(was.bias, verdict.bias).tolist()
            total[verdict.sensor_id] = was._replace(
                cause=was.cause if verdict.cause == was.cause else DISAGREES,
                offset_s=was.offset_s + verdict.offset_s,
                size=math.hypot(*bias),
                bias=(bias[0], bias[1], bias[2]),
            )
    return sorted(total.values())


def add_corrections(
    before: Sequence[SensorVerdict], now: Sequence[SensorVerdict]
) -> list[SensorVerdict]:
    """Return the verdicts with clock offsets as in the logs: corrections so far plus the rest."""
    total = {v.sensor_id: v._replace(corrected=True) for v in before if v.has_wrong_clock}
    for verdict in now:
        corrected = total.get(verdict.sensor_id)
        if corrected is not None:
            verdict = verdict._replace(
                offset_s=verdict.offset_s + corrected.offset_s,
                cause=verdict.cause or CLOCK,
                corrected=True,
            )
        total[verdict.sensor_id] = verdict
    return sorted(total.values())
