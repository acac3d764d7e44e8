"""Sightings: detections with the attitude of their frame and the position of its sensor."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.work_layout import SensorParts
from epipole.schemas.arrays import Array, Flags, Indices, Integers
from epipole.schemas.bridge import array, concat, rows_with, stack, stack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.settings import TrackletSettings
from epipole.schemas.spans import Span, spans_between
from epipole.schemas.tables import DETECTIONS
from epipole.tasks.algorithms.constants import ARCSEC, SECOND_NS
from epipole.tasks.algorithms.geometry.camera import Camera, row_offset_s, unproject
from epipole.tasks.algorithms.geometry.covariances import (
    attitude_covariance,
    centroid_covariance,
    in_components,
)
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion, unit_from_radec
from epipole.tasks.algorithms.times import frame_intervals_ns

# Sightings of tracklets.


class Frames(NamedTuple):
    """Frames of one sensor, in time order.

    The attitude of frames without one is the identity, so their directions are in sensor axes.
    """

    table: pa.Table
    number: Integers
    time_ns: Integers
    q_sensor_from_icrs: Array
    cov_att_rad2: Array
    from_stars: Flags
    r_gcrf_km: Array
    v_gcrf_km_s: Array
    position_sigma_km: Array
    camera: Integers


def solved_frames(solutions: pa.Table) -> Frames:
    """Return the frames of a `solutions` table that have an attitude, in time order."""
    return _frames(solutions.filter(pc.not_equal(solutions["attitude_source"], "none")))


def unsolved_frames(solutions: pa.Table) -> Frames:
    """Return the frames of a `solutions` table with a camera but no attitude, in time order."""
    unsolved = pc.and_(
        pc.equal(solutions["attitude_source"], "none"), pc.greater_equal(solutions["camera"], 0)
    )
    frames = _frames(solutions.filter(unsolved))
    n = len(frames.number)
    return frames._replace(
        q_sensor_from_icrs=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)), cov_att_rad2=np.zeros((n, 3, 3))
    )


def _frames(solutions: pa.Table) -> Frames:
    solved = solutions.sort_by("time")
    return Frames(
        solved,
        array(solved, "frame_number"),
        array(solved, "time"),
        stack(solved, "q{}", "xyzw"),
        stack_covariance(solved, "cov_att_{}_arcsec2") * ARCSEC**2,
        array(solved, "attitude_source") == "stars",
        stack(solved, "{}_km"),
        stack(solved, "v{}_km_s"),
        array(solved, "used_position_sigma_km").astype(float),
        array(solved, "camera"),
    )


class Sightings(NamedTuple):
    """Detections of one sensor, in the order of its frames.

    `row` is the row of the detection, `frame` the index of its frame. Frame k has the sightings
    ``offsets[k]:offsets[k + 1]``. `time_ns` is the time of its row: the frame's without a rolling
    shutter. `cov_noise` is the error that is independent in each frame,
    `cov_bias` the error that is common to all [rad^2, ICRS]: the error of an attitude from stars
    is independent, that of a prior is common.
    """

    row: Integers
    frame: Integers
    time_ns: Integers
    offsets: Integers
    u_icrs: Array
    cov_noise: Array
    cov_bias: Array


def sightings_of(frames: Frames, detections: pa.Table, cameras: pa.Table) -> Sightings:
    """Return the sightings in solved frames, sorted by frame."""
    row, frame = _in_frames(frames, detections)
    u = unit_from_radec(
        np.radians(array(detections, "ra_deg")[row]), np.radians(array(detections, "dec_deg")[row])
    )
    noise = centroid_covariance(u, array(detections, "sigma_arcsec")[row] * ARCSEC)
    R = matrix_from_quaternion(frames.q_sensor_from_icrs)
    attitude = attitude_covariance(
        u, in_components(np.swapaxes(R, -1, -2), frames.cov_att_rad2)[frame]
    )
    stars = frames.from_stars[frame][:, None, None]
    return Sightings(
        row,
        frame,
        _row_times(frames, detections, row, frame, cameras),
        np.searchsorted(frame, np.arange(len(frames.number) + 1)),
        u,
        noise + np.where(stars, attitude, 0.0),
        np.where(stars, 0.0, attitude),
    )


def _row_times(
    frames: Frames, detections: pa.Table, row: Indices, frame: Indices, cameras: pa.Table
) -> Indices:
    """Return the times of the image rows of detections [ns]."""
    late_s = row_offsets_s(cameras, frames.camera[frame], array(detections, "y_px")[row])
    return frames.time_ns[frame] + np.rint(late_s * SECOND_NS).astype(np.int64)


def row_offsets_s(cameras: pa.Table, camera: Integers, y_px: Array) -> Array:
    """Return the times of image rows (n,) after those of their frames [s]; `camera` (n,) are rows
    of CAMERAS, negative where there is none."""
    late_s = np.zeros(len(y_px))
    if not cameras.num_rows or not array(cameras, "line_time_s").any():
        return late_s
    for row, at in by_camera(camera):
        if row >= 0:
            late_s[at] = row_offset_s(camera_of(cameras, row), y_px[at].astype(float))
    return late_s


def image_sightings_of(frames: Frames, detections: pa.Table, cameras: pa.Table) -> Sightings:
    """Return the sightings in unsolved frames, sorted by frame; directions in sensor axes."""
    row, frame = _in_frames(frames, detections)
    x_px, y_px = array(detections, "x_px")[row], array(detections, "y_px")[row]
    u = np.empty((len(row), 3))
    for camera, at in by_camera(frames.camera[frame]):
        u[at] = unproject(camera_of(cameras, camera), x_px[at], y_px[at])
    noise = centroid_covariance(u, array(detections, "sigma_arcsec")[row] * ARCSEC)
    offsets = np.searchsorted(frame, np.arange(len(frames.number) + 1))
    return Sightings(row, frame, frames.time_ns[frame], offsets, u, noise, np.zeros_like(noise))


def _in_frames(frames: Frames, detections: pa.Table) -> tuple[Indices, Indices]:
    """Return the rows of detections in these frames, sorted by frame and centroid; their frames."""
    by_number = np.argsort(frames.number, kind="stable")
    number = array(detections, "frame_number")
    at = np.searchsorted(frames.number[by_number], number)
    at = np.minimum(at, max(len(by_number) - 1, 0))
    known = frames.number[by_number][at] == number if len(by_number) else np.zeros(0, bool)
    row = np.flatnonzero(known)
    frame = by_number[at[row]] if len(row) else np.zeros(0, np.int64)
    order = np.lexsort((array(detections, "centroid")[row], frame))
    return row[order], frame[order]


def part_of(sightings: Sightings, kept: Flags) -> Sightings:
    """Return some of the sightings, in the same order."""
    before = np.concatenate([[0], np.cumsum(kept)])
    return Sightings(
        sightings.row[kept],
        sightings.frame[kept],
        sightings.time_ns[kept],
        before[sightings.offsets],
        sightings.u_icrs[kept],
        sightings.cov_noise[kept],
        sightings.cov_bias[kept],
    )


def cameras_of(cameras: pa.Table, sensor_id: str) -> pa.Table:
    """Return the CAMERAS of a sensor, in order of time. The column `camera` counts these rows."""
    return rows_with(cameras, "sensor_id", sensor_id)


def calibration_at(begins_ns: Integers, time_ns: Integers) -> Indices:
    """Return the calibration (n,) of a sensor that holds at each time (n,).

    It is the newest one; the first one also holds before its time. `begins_ns` (k,) are the times
    of its calibrations, ascending.
    """
    return np.maximum(np.searchsorted(begins_ns, time_ns, side="right") - 1, 0)


def camera_of(cameras: pa.Table, row: int) -> Camera:
    """Return the camera in a row of `cameras`."""
    # Not the time: a Python datetime has no nanoseconds.
    return Camera(**cameras.select(list(Camera._fields)).slice(row, 1).to_pylist()[0])


def by_camera(camera: Integers) -> Iterator[tuple[int, Flags]]:
    """Yield each row of CAMERAS in `camera` (n,), and where it is."""
    for row in np.unique(camera).tolist():
        yield row, camera == row


def optics_covariance_of(cameras: pa.Table, row: int) -> Array:
    """Return the covariance (9, 9) of the optics in a row of `cameras`; 0 for those of the log."""
    return stack_covariance(cameras.slice(row, 1), "cov_{}", OPTICS_AXES)[0]


# Lone detections: too few frames, or too far apart, for a tracklet. Association takes each as a
# tracklet of one detection. Their ids are not published: `tracklet_id` is null in a dataset.

MARK = "lone:"  # sensor ids have no colon, so no other id begins like this


def max_coast(interval: Array | Integers, settings: TrackletSettings) -> Array:
    """Return the maximum time between two frames of a track, for usual intervals of frames."""
    return np.asarray((settings.max_missed + 1.5) * interval)  # half a frame of slack, for jitter


def in_lone_frames(frame_time_ns: Integers, settings: TrackletSettings) -> Flags:
    """Return which frames of one sensor, in time order, have too few others near for a tracklet."""
    if not len(frame_time_ns):
        return np.zeros(0, bool)
    coast_ns = max_coast(frame_intervals_ns(frame_time_ns), settings)
    run = np.concatenate([[0], np.cumsum(np.diff(frame_time_ns) > coast_ns[1:])]).astype(np.int64)
    return np.asarray(np.bincount(run)[run] < settings.min_detections)


def with_lone_detections(detections: pa.Table, lone: Flags) -> pa.Table:
    """Return the detections; each lone one gets an unpublished tracklet_id."""
    names = array(detections, "tracklet_id").copy()
    rows = np.flatnonzero(lone)
    sensor, frame = array(detections, "sensor_id"), array(detections, "frame_number")
    centroid = array(detections, "centroid")
    for row in rows:
        names[row] = f"{MARK}{sensor[row]}-{frame[row]}-{centroid[row]}"
    at = detections.schema.get_field_index("tracklet_id")
    return detections.set_column(at, detections.schema.field(at), pa.array(names, pa.string()))


def with_lone_objects(detections: pa.Table, associations: pa.Table) -> pa.Table:
    """Return the detections; lone ones that a position used are of kind ``object``.

    One detection alone may be anything. A detection that several sensors agree on is an object.
    """
    is_lone_view = pc.and_(associations["used"], pc.is_null(associations["tracklet_id"]))
    key = ["sensor_id", "frame_number", "centroid"]
    lone = pl.DataFrame(associations.filter(is_lone_view).select(key)).drop_nulls().unique()
    if not len(lone):
        return detections
    marked = pl.DataFrame(detections.select(key)).join(
        lone.with_columns(is_object=True), on=key, how="left", maintain_order="left"
    )  # fmt: skip
    at = detections.schema.get_field_index("kind")
    kind = pc.if_else(marked["is_object"].fill_null(False).to_arrow(), "object", detections["kind"])
    return detections.set_column(at, detections.schema.field(at), kind)


def is_lone(tracklet_id: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return which ids are of lone detections."""
    return pc.starts_with(tracklet_id, MARK)


def published_ids(tracklet_id: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the ids; null for those of lone detections."""
    return pc.if_else(is_lone(tracklet_id), pa.scalar(None, pa.string()), tracklet_id)


def only_id(tracklet_id: npt.NDArray[np.object_]) -> str | None:
    """Return the one id in an array; None where there are several, or it is of a lone detection."""
    ids = set(tracklet_id.tolist())
    if len(ids) != 1:
        return None
    (name,) = ids
    return None if name.startswith(MARK) else str(name)


# Detections of one sensor, with the names of their tracklets in the night.


def detections_within(sensor: SensorParts, span: Span) -> pa.Table:
    """Return a sensor's detections in a time, each from the part of the span it lies in."""
    rows = []
    for other in spans_between(*span):
        if not sensor.tracked.holds(other):
            continue
        detections = other.of(sensor.tracked.read(other, "detections"), "time")
        names = sensor.names.read(other, "names")
        rows.append(with_names(span.of(detections, "time"), names))
    return concat(DETECTIONS, rows)


def with_names(detections: pa.Table, names: pa.Table) -> pa.Table:
    """Return detections of a span with the names of their tracklets in the night.

    `names` are the sensor's TRACKLET_NAMES of the span.
    """
    row = pc.index_in(detections["tracklet_id"], names["span_name"])
    row = pc.if_else(detections["tracklet_id"].is_valid(), row, pa.scalar(None, pa.int32()))
    if pc.any(pc.and_(row.is_null(), detections["tracklet_id"].is_valid())).as_py():
        raise AssertionError("a detection's tracklet has no name")
    for name in ("tracklet_id", "track_id"):
        at = detections.schema.get_field_index(name)
        detections = detections.set_column(at, detections.schema.field(at), names[name].take(row))
    return detections
