"""Views: the directions of a sensor's tracklets at the epochs, part to part."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.kept_parts import part_key
from epipole.io.work.parts import VIEWED, read_part, write_part
from epipole.io.work.work_layout import SensorParts
from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import (
    array,
    concat,
    conform,
    empty,
    nullable,
    stack,
    table,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.settings import AlignmentSettings, TrackletSettings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import (
    SENSOR_EPOCHS,
    SOLUTIONS,
    TRACKLET_ENDS,
    VIEWED_TRACKLETS,
    VIEWS,
)
from epipole.tasks.algorithms.geometry.camera import Camera, project
from epipole.tasks.algorithms.geometry.covariances import on_tangent_plane, traces
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    interpolate_quaternions,
    matrix_from_quaternion,
)
from epipole.tasks.algorithms.tracking.attributables import MAX_HALF_S
from epipole.tasks.algorithms.tracking.local_motion import LocalMotion, directions_at
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.sightings import (
    Frames,
    by_camera,
    camera_of,
    cameras_of,
    detections_within,
    is_lone,
    solved_frames,
)
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.align_epochs import EpochGrid, align_epochs
from epipole.tasks.solve.sightings import (
    SensorSightings,
    TrackletSightings,
    optics_covariance,
    sight_objects,
    states_near_frames,
    tabulate_attributables,
    tabulate_sightings,
    with_middle_in,
)

# Of an image, per axis. What fitted optics are wrong by changes little within a part. With 1 to 12
# the verdicts on sensors with untold optics were the same.
FIELD_PARTS = 3


def view_objects(
    epochs: pa.Table, sightings: SensorSightings | None, max_rate_deg_s: float, half_width_s: float
) -> pa.Table:
    """Return VIEWS of one sensor: each tracklet at each epoch that it covers, in this order.

    A detection in a lone frame is a tracklet of one detection, at an unknown rate.

    A tracklet covers the epochs between its ends, and those as near to an end as an epoch may be to
    its frame. The aberration by the sensor's geocentric velocity is removed from each detection
    before the motion is fitted.

    Parameters
    ----------
    max_rate_deg_s
        Maximum of the apparent motion: 3 sigma of the prior of an unknown rate.
    half_width_s
        Time on each side of an epoch in which the motion is fitted.
    """
    if sightings is None or not epochs.num_rows:
        return empty(VIEWS)
    query = _queries(sightings.tracklets, epochs, sightings.frames)
    return _view_table(sightings, query, epochs, max_rate_deg_s, half_width_s)


class _EpochQueries(NamedTuple):
    """The views to compute: each tracklet at each epoch that it covers."""

    tracklet: Indices
    row: Indices  # of `epochs`
    frame: Indices  # of the epoch


def frames_of(epochs: pa.Table, frames: Frames) -> Indices:
    """Return the row in `frames` of the frame of each epoch."""
    by_number = np.argsort(frames.number, kind="stable")
    return by_number[
        np.searchsorted(frames.number[by_number], array(epochs, "frame_number"))
    ].astype(np.int64)


def _queries(tracklets: TrackletSightings, epochs: pa.Table, frames: Frames) -> _EpochQueries:
    """Return each epoch that a tracklet covers, by tracklet."""
    epoch_ns, bounds = array(epochs, "epoch"), tracklets.bounds
    time_ns = frames.time_ns[tracklets.frame]
    beyond_ns = int(np.abs(array(epochs, "dt_s")).max() * 1e9) + 1
    first = np.searchsorted(epoch_ns, time_ns[bounds[:-1]] - beyond_ns)
    last = np.searchsorted(epoch_ns, time_ns[bounds[1:] - 1] + beyond_ns, side="right")
    count = last - first
    tracklet = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    row = np.arange(count.sum()) - np.repeat(start - first, count)
    return _EpochQueries(tracklet, row, frames_of(epochs, frames)[row])


def _view_table(
    sightings: SensorSightings,
    query: _EpochQueries,
    epochs: pa.Table,
    max_rate_deg_s: float,
    half_width_s: float,
) -> pa.Table:
    frames, tracklets = sightings.frames, sightings.tracklets
    tracklet, row, frame = query
    v = np.nan_to_num(frames.v_gcrf_km_s)
    at_s = (array(epochs, "epoch")[row] - frames.time_ns[0]) / 1e9
    motion = _motions(sightings, query, at_s, max_rate_deg_s, half_width_s)
    centroid, missed = _centroids(tracklets, query)
    frame_s, u, fitted = (frames.time_ns - frames.time_ns[0]) / 1e9, motion.u, motion.fitted
    R = matrix_from_quaternion(interpolate_quaternions(frame_s, frames.q_sensor_from_icrs, at_s))
    u_sensor = np.einsum("nij,nj->ni", R, aberrate(u, v[frame]))
    image = _in_images(sightings, frame, u_sensor)
    r_km, v_km_s = states_near_frames(frames, frame, array(epochs, "dt_s")[row])
    cov_noise, cov_bias = (on_tangent_plane(u, c) for c in (motion.cov_noise, motion.cov_bias))
    cov_noise, cov_bias, blend_rad2 = _without_blends(tracklet, cov_noise, cov_bias)
    turn = np.where(frames.from_stars[frame], 0.0, traces(cov_bias))
    by_optics = optics_covariance(sightings, R, u_sensor, frame)
    if by_optics.local.any():
        cov_bias = cov_bias + on_tangent_plane(u, by_optics.whole)
        turn += traces(by_optics.turn)
    kept = np.isfinite(image.x_px) & np.isfinite(r_km[:, 0])
    columns = {
        "epoch": array(epochs, "epoch")[row],
        "sensor_id": array(epochs, "sensor_id")[row],
        "frame_number": frames.number[frame],
        "tracklet_id": tracklets.name[tracklet],
        **image._asdict(),
        **unstack("u{}", u),
        **unstack("w{}_rad_s", motion.w),
        **unstack_covariance("cov_noise_{}_rad2", cov_noise, TANGENT_AXES),
        **unstack_covariance("cov_bias_{}_rad2", cov_bias, TANGENT_AXES),
        "blend_rad2": blend_rad2,
        "attitude_rad2": turn / 2,
        "turn_noise_rad2": _turn_noise(tracklets, fitted, cov_noise),
        "first_fitted": tracklets.time_ns[fitted[:, 0]],
        "last_fitted": tracklets.time_ns[fitted[:, 1] - 1],
        **unstack("moment_{}", motion.moments, "123"),
        "unmodelled_rad2": motion.unmodelled,
        **unstack("{}_km", r_km),
        "position_sigma_km": frames.position_sigma_km[frame],
    }
    columns = {key: values[kept] for key, values in columns.items()}
    maybe = {
        "magnitude": _fitted_magnitudes(sightings, fitted),
        **unstack("sensor_v{}_km_s", v_km_s),
    }
    columns |= {name: nullable(values[kept]) for name, values in maybe.items()}
    columns["centroid"] = pa.array(centroid[kept], mask=missed[kept])
    return table(VIEWS, columns)


def _motions(
    sightings: SensorSightings,
    query: _EpochQueries,
    at_s: Array,
    max_rate_deg_s: float,
    half_width_s: float,
) -> LocalMotion:
    """Return each query's motion without aberration, at seconds since the first frame."""
    frames, tracklets, bounds = sightings.frames, sightings.tracklets, sightings.tracklets.bounds
    v_km_s = np.nan_to_num(frames.v_gcrf_km_s)[tracklets.frame]
    return directions_at(
        bounds[query.tracklet],
        bounds[query.tracklet + 1],
        at_s,
        np.radians(max_rate_deg_s) / 3,  # the maximum is a 3-sigma rate
        (tracklets.time_ns - frames.time_ns[0]) / 1e9,
        aberrate(tracklets.u_icrs, -v_km_s),
        tracklets.cov_noise,
        tracklets.cov_bias,
        half_width_s,
    )


def _turn_noise(tracklets: TrackletSightings, fitted: Indices, cov_noise: Array) -> Array:
    """Return the attitude's part of the noise of views, per axis [rad^2].

    It is as in the middle one of the detections that each view is fitted to.
    """
    middle = (fitted[:, 0] + fitted[:, 1] - 1) // 2
    whole = traces(tracklets.cov_noise[middle])
    return tracklets.turn_rad2[middle] / whole * traces(cov_noise)


def _fitted_magnitudes(sightings: SensorSightings, fitted: Indices) -> Array:
    """Return the mean magnitude of ranges of detections, (n, 2), without blended ones; else NaN."""
    magnitude = sightings.magnitude
    known = np.isfinite(magnitude) & (sightings.tracklets.blend_rad2 == 0.0)
    before = np.zeros((len(known) + 1, 2))
    np.cumsum(np.stack([known, np.where(known, magnitude, 0.0)], axis=1), axis=0, out=before[1:])
    count, total = (before[fitted[:, 1]] - before[fitted[:, 0]]).T
    return np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)


def _without_blends(
    tracklet: Indices, cov_noise: Array, cov_bias: Array
) -> tuple[Array, Array, Array]:
    """Return the covariances of noise and bias, and the variance per axis that blends add.

    All views of a tracklet share the smallest bias among them. Blends add more to some of them:
    this part is not shared, and so becomes noise.
    """
    shared = traces(cov_bias)
    minimum = np.full(int(tracklet.max(initial=-1)) + 1, np.inf)
    np.minimum.at(minimum, tracklet, shared)
    stays = (minimum[tracklet] / np.where(shared > 0.0, shared, np.inf))[:, None, None]
    more = (1 - stays) * cov_bias
    return cov_noise + more, stays * cov_bias, traces(more) / 2


class _InImages(NamedTuple):
    """Columns of VIEWS that depend on the camera of the frame, (n,) each."""

    x_px: Array
    y_px: Array
    field_part: npt.NDArray[np.int8]
    pixel_rad: Array


def _in_images(sightings: SensorSightings, frame: Indices, u_sensor: Array) -> _InImages:
    """Return where directions (n, 3), sensor axes, are in the images of frames (n,)."""
    n = len(frame)
    out = _InImages(np.empty(n), np.empty(n), np.empty(n, np.int8), np.empty(n))
    for row, at in by_camera(sightings.frames.camera[frame]):
        camera = camera_of(sightings.cameras, row)
        x_px, y_px = project(camera, u_sensor[at])
        out.x_px[at], out.y_px[at] = x_px, y_px
        out.field_part[at] = _field_parts(camera, x_px, y_px)
        out.pixel_rad[at] = camera.pixel_rad
    return out


def _field_parts(camera: Camera, x_px: Array, y_px: Array) -> npt.NDArray[np.int8]:
    """Return the part of the image that each pixel is in; those outside are in the nearest."""
    column, row = (
        np.clip(np.nan_to_num(FIELD_PARTS * px / size), 0, FIELD_PARTS - 1).astype(np.int8)
        for px, size in ((x_px, camera.width), (y_px, camera.height))
    )
    return FIELD_PARTS * row + column


def _centroids(tracklets: TrackletSightings, query: _EpochQueries) -> tuple[Indices, Flags]:
    """Return each query's centroid in its frame, and for which queries it is missing."""
    n_frames = max(int(tracklets.frame.max()), int(query.frame.max(initial=0))) + 1
    key = tracklets.tracklet * n_frames + tracklets.frame  # increasing
    queried = query.tracklet * n_frames + query.frame
    at = np.minimum(np.searchsorted(key, queried), len(key) - 1)
    return tracklets.centroid[at], key[at] != queried


MIN_FRAMES = 6  # beyond the ends of a span: the motion at an epoch is fitted to these too


@stage_task(Stage.SOLVE, "views {span}")
def view_sensors(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    tracklets: TrackletSettings,
    alignment: AlignmentSettings,
) -> int:
    """Write the views of some sensors in a span, `VIEWED`, unless the parts exist.

    Returns
    -------
    int
        Number of views.
    """
    count = 0
    for sensor in sensors:
        if not sensor.viewed.holds(span):
            of_sensor = cameras_of(cameras, sensor.sensor_id)
            _view_span(sensor, span, grid, of_sensor, tracklets, alignment)
        count += sensor.viewed.read(span, "views").num_rows
    return count


def _view_span(
    sensor: SensorParts,
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    tracklets: TrackletSettings,
    alignment: AlignmentSettings,
) -> None:
    """Write the views of a sensor in a span, or take those that are kept."""
    margin_s = max(2 * alignment.window_s, MAX_HALF_S)
    wide = span.widened(round(1e9 * margin_s) + MIN_FRAMES * grid.interval_ns)
    of_night = read_part(sensor.names.of_night(), "tracklets", TRACKLET_ENDS.names)
    named = _Named(tracklets_near(of_night, wide), with_middle_in(of_night, span))
    key = _key(sensor, span, wide, grid, named)
    if not sensor.viewed.take(span, key):
        tables = _view(sensor, span, wide, grid, named, cameras, tracklets, alignment)
        write_part(sensor.viewed.of(span), VIEWED, tables, key=key)


class _Named(NamedTuple):
    """A sensor's tracklets with their names in the night: those near a span, and those whose middle
    is in it."""

    near: pa.Table
    middle_in: pa.Table


def tracklets_near(tracklets: pa.Table, wide: Span) -> pa.Table:
    """Return the tracklets in a time, their ends as far as they are in it.

    So the rows do not depend on how long a tracklet goes on elsewhere in the night.
    """
    start_ns, end_ns = array(tracklets, "start_time"), array(tracklets, "end_time")
    near = np.flatnonzero((end_ns >= wide.start_ns) & (start_ns < wide.end_ns))
    ids = tracklets.select(["tracklet_id", "track_id"]).take(near)
    return table(
        TRACKLET_ENDS,
        {
            **{name: ids[name] for name in ids.column_names},
            "start_time": np.maximum(start_ns[near], wide.start_ns),
            "end_time": np.minimum(end_ns[near], wide.end_ns),
        },
    )


def _key(sensor: SensorParts, span: Span, wide: Span, grid: EpochGrid, named: _Named) -> str | None:
    """Return the key of a sensor's views in a span; `wide` is the time whose rows are read."""
    stages = (sensor.identified, sensor.tracked)
    read = [part for stage in stages for part in stage.written(stage.near(wide))]
    names = [sensor.names.read(near, "names") for near in sensor.names.near(wide)]
    return part_key([Stage.SOLVE, "views", span, grid], [*named, *names], read)


def _view(
    sensor: SensorParts,
    span: Span,
    wide: Span,
    grid: EpochGrid,
    named: _Named,
    cameras: pa.Table,
    tracklets: TrackletSettings,
    alignment: AlignmentSettings,
) -> dict[str, pa.Table]:
    solutions = sensor.identified.rows_within(wide, SOLUTIONS, "solutions")
    epochs = span.of(align_epochs(solutions, alignment, grid), "epoch")
    half_width_s = alignment.window_s
    detections = detections_within(sensor, wide)
    sightings = sight_objects(solutions, detections, cameras, tracklets, half_width_s)
    views = view_objects(epochs, sightings, tracklets.max_rate_deg_s, half_width_s)
    return {
        "epochs": sensor_epochs(epochs, solutions),
        "views": views,
        "sightings": span.of(tabulate_sightings(sightings), "time"),
        "attributables": tabulate_attributables(sightings, named.middle_in),
        "tracklets": viewed_tracklets(named.near, views),
    }


def sensor_epochs(epochs: pa.Table, solutions: pa.Table) -> pa.Table:
    """Return SENSOR_EPOCHS: EPOCHS of one sensor with the states of their frames."""
    frames = solved_frames(solutions)
    row = frames_of(epochs, frames) if epochs.num_rows else np.zeros(0, np.int64)
    state = {name: frames.table[name].take(row) for name in ("vx_km_s", "vy_km_s", "vz_km_s")}
    return table(
        SENSOR_EPOCHS,
        {name: epochs[name] for name in epochs.column_names}
        | unstack("q{}", frames.q_sensor_from_icrs[row], "xyzw")
        | unstack("{}_km", stack(frames.table, "{}_km")[row])
        | state
        | {"camera": frames.camera[row]},
    )


def viewed_tracklets(tracklets: pa.Table, views: pa.Table) -> pa.Table:
    """Return VIEWED_TRACKLETS of one sensor, in the order of the ids, as the views are."""
    bounds = group_offsets(array(views, "tracklet_id"))
    rows = _with_lone(tracklets, views.take(bounds[:-1])).sort_by("tracklet_id")
    columns = {name: rows[name] for name in rows.column_names}
    where = {"first_view": bounds[:-1], "n_views": np.diff(bounds)}
    return table(VIEWED_TRACKLETS, columns | where)


def _with_lone(tracklets: pa.Table, views: pa.Table) -> pa.Table:
    """Return the tracklets that have views, and a row for each lone detection that has views."""
    tracklets = conform(TRACKLET_ENDS, tracklets.select(TRACKLET_ENDS.names))
    tracklets = tracklets.filter(pc.is_in(tracklets["tracklet_id"], views["tracklet_id"]))
    lone = views.filter(is_lone(views["tracklet_id"]))
    _, first = np.unique(array(lone, "tracklet_id").astype(str), return_index=True)
    lone = lone.take(first)
    columns = dict.fromkeys(("tracklet_id", "track_id"), lone["tracklet_id"])
    columns |= dict.fromkeys(("start_time", "end_time"), lone["epoch"])
    return concat(TRACKLET_ENDS, [tracklets, table(TRACKLET_ENDS, columns)])
