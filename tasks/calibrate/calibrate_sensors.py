"""Calibrate sensors: fit the optics of each to its stars of the night."""

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import Parts
from epipole.schemas.bridge import array, concat, empty, rows_of, table
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CALIBRATIONS, STARS
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.optics_calibration import OPTICS, OpticsFit, calibrate_optics
from epipole.tasks.common.stage_tasks import stage_task

LOGGER = logging.getLogger(__name__)

MAX_STARS = 20_000  # with more, the sigmas would be smaller than the errors of the model
# The optics differ if chi-square falls by this much. By chance it falls by 9, and by more where the
# errors of centroids are not normal.
REAL_GAIN = 60.0


class Calibrated(NamedTuple):
    """Fitted optics.

    `calibrations` is CALIBRATIONS, a row per sensor with enough stars. `cameras` is CAMERAS, with
    the fitted optics of the sensors in `departed`: theirs certainly differ from the calibration.
    """

    calibrations: pa.Table
    cameras: pa.Table
    departed: list[str]


@stage_task(Stage.CALIBRATE, "{sensor}")
def calibrate_sensor(
    sensor: Sensor, identified: Parts, spans: Sequence[Span], cameras: pa.Table
) -> Calibrated:
    """Fit one sensor's optics to its stars of all spans; `identified` has its parts."""
    of_sensor = cameras.filter(pc.field("sensor_id") == sensor.sensor_id)
    return calibrate_sensors(_spread(identified, spans), of_sensor)


def _spread(identified: Parts, spans: Sequence[Span]) -> pa.Table:
    """Return the stars of frames that are evenly spread over the night, about `MAX_STARS`."""
    parts = [identified.read(span, "stars") for span in spans]
    total = sum(part.num_rows for part in parts)
    # A tenth fewer, because frames have different numbers of stars.
    step = 1 if total <= MAX_STARS else -(-total * 10 // (MAX_STARS * 9))
    return concat(STARS, [_every(part, step) for part in parts])


def _every(stars: pa.Table, step: int) -> pa.Table:
    """Return the stars of every `step`-th frame."""
    if step == 1 or not stars.num_rows:
        return stars
    frame = array(stars, "frame_number")
    number = np.cumsum(np.diff(frame, prepend=frame[:1]) != 0)
    return stars.take(np.flatnonzero(number % step == 0))


def calibrate_sensors(stars: pa.Table, cameras: pa.Table) -> Calibrated:
    """Return the optics that fit the stars; `stars` of a sensor are in order of time."""
    rows, changed = [], {}
    for camera_row in _single(cameras):
        name = camera_row["sensor_id"]
        fit = _fit(stars.filter(pc.field("sensor_id") == name), camera_row)
        if fit is None:
            continue
        rows.append(_row(name, fit))
        if fit.gain > REAL_GAIN:
            changed[name] = fit.camera._asdict()
        LOGGER.info("%s: optics from %d stars, rms %.3f px", name, fit.n_stars, fit.residual_px)
    new = [row | changed.get(row["sensor_id"], {}) for row in rows_of(cameras)]
    return Calibrated(
        concat(CALIBRATIONS, rows) if rows else empty(CALIBRATIONS),
        pa.Table.from_pylist(new, schema=CAMERAS),
        sorted(changed),
    )


def _single(cameras: pa.Table) -> list[dict[str, Any]]:
    """Return the cameras of sensors with one calibration.

    With two calibrations, it is not known which of them a star was identified with.
    """
    first: dict[str, dict[str, Any] | None] = {}
    for row in rows_of(cameras):
        optics = {name: row[name] for name in Camera._fields}
        known = first.setdefault(row["sensor_id"], optics)
        if known != optics:
            first[row["sensor_id"]] = None
    return [{"sensor_id": name} | value for name, value in first.items() if value is not None]


def _fit(stars: pa.Table, row: dict[str, Any]) -> OpticsFit | None:
    camera = Camera(**{name: row[name] for name in Camera._fields})
    x, y, frame = array(stars, "x_px"), array(stars, "y_px"), array(stars, "frame_number")
    dx, dy = array(stars, "dx_px"), array(stars, "dy_px")
    # Whole frames, spread evenly over the night.
    number = np.cumsum(np.diff(frame, prepend=frame[:1]) != 0) if len(frame) else frame
    step = max(1, -(-len(frame) // MAX_STARS))
    kept = np.isfinite(dx) & np.isfinite(dy) & (number % step == 0)
    x, y, dx, dy = x[kept], y[kept], dx[kept], dy[kept]
    star = array(stars, "star_id")[kept]
    return calibrate_optics(camera, x, y, unproject(camera, x - dx, y - dy), number[kept], star)


def _row(sensor_id: str, fit: OpticsFit) -> pa.Table:
    sigma = np.sqrt(np.diagonal(fit.cov))
    return table(
        CALIBRATIONS,
        {"sensor_id": [sensor_id], "n_stars": [fit.n_stars], "residual_px": [fit.residual_px]}
        | {name: [getattr(fit.camera, name)] for name in OPTICS}
        | {f"sigma_{name}": [s] for name, s in zip(OPTICS, sigma.tolist(), strict=True)},
    )
