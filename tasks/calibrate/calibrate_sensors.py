"""Calibrate sensors: fit the optics of each to its stars of the night.

The stars are a sample of whole frames, evenly over the night. Optics that certainly differ from the
log's calibration are named in `Calibrated.departed`: the sensor is identified again with them.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.schemas.arrays import Array, Indices, Integers
from epipole.schemas.bridge import (
    array,
    concat,
    empty,
    rows_of,
    rows_with,
    table,
    unstack_covariance,
)
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CALIBRATIONS, STARS
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import (
    Camera,
    flip_rows,
    unproject,
)
from epipole.tasks.algorithms.geometry.covariances import OPTICS
from epipole.tasks.algorithms.geometry.optics_calibration import (
    NominalOptics,
    OpticsFit,
    StarImages,
    calibrate_in_steps,
    calibrate_optics,
)
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.sightings import calibration_at, camera_of, optics_covariance_of
from epipole.tasks.common.stage_tasks import stage_task

LOGGER = logging.getLogger(__name__)

MAX_STARS = 20_000  # of a fit; with more, sigmas would be below the errors of the model
# The optics differ if chi-square falls by more than this. With right optics it falls by 9, and by
# more where the errors of centroids are not normal.
MIN_GAIN = 60.0


class Calibrated(NamedTuple):
    """Fitted optics.

    calibrations : CALIBRATIONS, a row per sensor with enough stars
    cameras : CAMERAS, with the fitted optics and their covariance where they certainly differ
    departed : sensors with such optics
    """

    calibrations: pa.Table
    cameras: pa.Table
    departed: list[str]


class SensorStars(NamedTuple):
    """A sensor's parts of `identify_spans`, and their spans."""

    sensor: Sensor
    spans: Sequence[Span]
    identified: Parts

    def __str__(self) -> str:
        """Return the sensor's id."""
        return f"{self.sensor}"


@stage_task(Stage.CALIBRATE, "{sensors}")
def calibrate_each(
    sensors: Batch[SensorStars],
    cameras: pa.Table,
    nominal: pa.Table,
    principal_point_px: float | None,
) -> list[Calibrated]:
    """Fit the optics of some sensors, each to its stars of all spans; see `calibrate_sensors`."""
    return [_calibrate(sensor, cameras, nominal, principal_point_px) for sensor in sensors]


def _calibrate(
    stars: SensorStars, cameras: pa.Table, nominal: pa.Table, principal_point_px: float | None
) -> Calibrated:
    name = stars.sensor.sensor_id
    return calibrate_sensors(
        _sampled_stars(stars.identified, stars.spans),
        rows_with(cameras, "sensor_id", name),
        rows_with(nominal, "sensor_id", name),
        principal_point_px,
    )


def _sampled_stars(identified: Parts, spans: Sequence[Span]) -> pa.Table:
    """Return the stars of some frames, evenly over the night, about `MAX_STARS`."""
    parts = [identified.read(span, "stars") for span in spans]
    total = sum(part.num_rows for part in parts)
    # A tenth fewer than the maximum, because frames have different numbers of stars.
    step = 1 if total <= MAX_STARS else -(-total * 10 // (MAX_STARS * 9))
    return concat(STARS, [_every(part, step) for part in parts])


def _every(stars: pa.Table, step: int) -> pa.Table:
    """Return the stars of every `step`-th frame."""
    if step == 1 or not stars.num_rows:
        return stars
    frame = array(stars, "frame_number")
    number = np.cumsum(np.diff(frame, prepend=frame[:1]) != 0)
    return stars.take(np.flatnonzero(number % step == 0))


def calibrate_sensors(
    stars: pa.Table, cameras: pa.Table, nominal: pa.Table, principal_point_px: float | None = None
) -> Calibrated:
    """Return the optics that fit the stars.

    Each calibration of a sensor is fitted to the stars of the frames for which it holds. The row of
    a sensor is that of the calibration with most stars.

    Parameters
    ----------
    stars
        STARS; those of a sensor are in order of time.
    cameras, nominal
        CAMERAS with which the stars were identified, and those of the log, row by row; the rows of
        a sensor are in order of time.
    principal_point_px
        1-sigma error of the log's principal points, per axis; None: unknown, and taken as 0 where
        the stars do not contradict the log.
    """
    rows, changed, departed = [], dict[int, dict[str, Any]](), set[str]()
    for name in dict.fromkeys(cameras["sensor_id"].to_pylist()):
        fits, stars_of_sensor = [], rows_with(stars, "sensor_id", name)
        for one in _calibrations(cameras, nominal, name):
            images = _images(one.choose(stars_of_sensor), one.present.camera)
            fitted = _fit(NominalOptics(one.logged, principal_point_px), one.present, images)
            if fitted is None:
                continue
            fit, departs = fitted
            fits.append(fit)
            if departs:
                values = fit.camera._asdict() | _covariance_columns(fit.cov)
                changed |= dict.fromkeys(one.rows, values)
                departed.add(name)
            LOGGER.debug(
                "%s: optics from %d stars, rms %.3f px", name, fit.n_stars, fit.residual_px
            )
        if fits:
            rows.append(_row(name, max(fits, key=lambda fit: fit.n_stars)))
    return Calibrated(
        concat(CALIBRATIONS, rows) if rows else empty(CALIBRATIONS),
        with_optics(cameras, changed),
        sorted(departed),
    )


def with_optics(cameras: pa.Table, changed: Mapping[int, dict[str, Any]]) -> pa.Table:
    """Return CAMERAS with other values in some rows."""
    rows = [row | changed.get(k, {}) for k, row in enumerate(rows_of(cameras))]
    return pa.Table.from_pylist(rows, schema=CAMERAS)


class _Present(NamedTuple):
    camera: Camera
    is_fitted: bool  # its covariance is not that of the log


class _Calibration(NamedTuple):
    """One calibration of a sensor.

    rows : its rows in CAMERAS, several where it holds again after another one
    logged : the camera of the log
    present : the camera with which the stars were identified
    all_rows, begins_ns : rows of all calibrations of the sensor, and from when they hold [ns]
    """

    rows: list[int]
    logged: Camera
    present: _Present
    all_rows: Indices
    begins_ns: Integers

    def choose(self, stars: pa.Table) -> pa.Table:
        """Return the stars of the sensor that were identified with this calibration."""
        if len(self.rows) == len(self.all_rows):
            return stars
        row = self.all_rows[calibration_at(self.begins_ns, array(stars, "time"))]
        return stars.filter(pa.array(np.isin(row, self.rows)))


def _calibrations(cameras: pa.Table, nominal: pa.Table, sensor_id: str) -> list[_Calibration]:
    """Return the calibrations of a sensor that differ."""
    rows = np.flatnonzero(np.asarray(cameras["sensor_id"]) == sensor_id)
    begins_ns = array(cameras, "time")[rows]
    found: dict[tuple[Any, ...], _Calibration] = {}
    for k in rows.tolist():
        present, logged = camera_of(cameras, k), camera_of(nominal, k)
        cov, logged_cov = (optics_covariance_of(t, k).tobytes() for t in (cameras, nominal))
        one = _Calibration([], logged, _Present(present, cov != logged_cov), rows, begins_ns)
        found.setdefault((present, logged, cov, logged_cov), one).rows.append(k)
    return list(found.values())


def _images(stars: pa.Table, camera: Camera) -> StarImages:
    """Return the images of the stars of whole frames, spread evenly over the night."""
    x, y, frame = array(stars, "x_px"), array(stars, "y_px"), array(stars, "frame_number")
    dx, dy = array(stars, "dx_px"), array(stars, "dy_px")
    number = np.cumsum(np.diff(frame, prepend=frame[:1]) != 0) if len(frame) else frame
    step = max(1, -(-len(frame) // MAX_STARS))
    kept = np.isfinite(dx) & np.isfinite(dy) & (number % step == 0)
    # A star at the fold of the distortion may be predicted beyond it, where no direction is.
    u_sensor = unproject(camera, x - dx, y - dy)
    kept &= np.isfinite(u_sensor[:, 2])
    return StarImages(x[kept], y[kept], u_sensor[kept], number[kept], array(stars, "star_id")[kept])


def _fit(
    given: NominalOptics, present: _Present, images: StarImages
) -> tuple[OpticsFit, bool] | None:
    """Return the optics, and whether frames must be identified again with them.

    Optics are fitted in steps if they differ from those of the log, or if the settings state an
    uncertain principal point. Then the covariance of the fit must reach the frames once, however
    near the present optics are.
    """
    if present.camera.fy_px < 0:
        return _fit_upward(given, present, images)
    free = calibrate_optics(given, images, present.camera)
    if free is None:
        return None
    as_logged = present.camera == given.camera and not present.is_fitted
    if as_logged and free.gain <= MIN_GAIN and not given.principal_point_px:
        return free, False
    fit = calibrate_in_steps(given, images, free, present.camera)
    return fit, not present.is_fitted or fit.gain > MIN_GAIN


def _fit_upward(
    given: NominalOptics, present: _Present, images: StarImages
) -> tuple[OpticsFit, bool] | None:
    """Return what `_fit` does for rows that count upward: fitted as rows that count down."""
    nominal, _ = flip_rows(given.camera, images.y_px)
    given = given._replace(camera=nominal)
    camera, y_px = flip_rows(present.camera, images.y_px)
    fitted = _fit(given, present._replace(camera=camera), images._replace(y_px=y_px))
    if fitted is None:
        return None
    fit, departs = fitted
    upward, _ = flip_rows(fit.camera, y_px)
    sign = np.where(np.isin(OPTICS, ["fy_px", "cy_px"]), -1.0, 1.0)
    return fit._replace(camera=upward, cov=fit.cov * np.outer(sign, sign)), departs


def _covariance_columns(cov: Array) -> dict[str, float]:
    columns = unstack_covariance("cov_{}", cov[None], OPTICS_AXES)
    return {name: float(values[0]) for name, values in columns.items()}


def _row(sensor_id: str, fit: OpticsFit) -> pa.Table:
    sigma = np.sqrt(np.diagonal(fit.cov))
    return table(
        CALIBRATIONS,
        {"sensor_id": [sensor_id], "n_stars": [fit.n_stars], "residual_px": [fit.residual_px]}
        | {name: [getattr(fit.camera, name)] for name in (*OPTICS, "k4", "fisheye")}
        | {f"sigma_{name}": [s] for name, s in zip(OPTICS, sigma.tolist(), strict=True)},
    )
