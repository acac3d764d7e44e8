"""View objects: where one sensor's tracklets stand at the epochs."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, empty, table, unstack, unstack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.geometry.camera import project
from epipole.tasks.algorithms.geometry.direction_errors import on_tangent_plane
from epipole.tasks.algorithms.geometry.rotations import (
    interpolate_quaternions,
    matrix_from_quaternion,
)
from epipole.tasks.algorithms.geometry.sky import aberrate
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.common.lone_detections import in_lone_frames, with_lone_detections
from epipole.tasks.common.sightings import Frames, Sightings, camera_of, sightings_of, solved_frames

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def view_objects(
    epochs: pa.Table,
    solutions: pa.Table,
    detections: pa.Table,
    cameras: pa.Table,
    settings: Settings,
) -> pa.Table:
    """Return one sensor's views: each tracklet at each epoch that it covers.

    A detection of a frame that stands alone is a tracklet of its own, at an unknown rate.

    A tracklet covers an epoch that lies between its ends or no farther beyond them than the
    frame that serves the epoch may be. Aberration by the sensor's geocentric velocity is taken
    off each detection before its motion is fitted.
    """
    frames = solved_frames(solutions)
    detections = _with_lone(frames, detections, settings)
    # What has no direction was tracked in the image alone.
    placed = pa.compute.field("tracklet_id").is_valid() & pa.compute.field("ra_deg").is_valid()
    tracked = detections.filter(placed)
    if not tracked.num_rows or not epochs.num_rows:
        return empty(VIEWS)
    seen = sightings_of(frames, tracked)
    name = array(tracked, "tracklet_id")[seen.row]
    order = np.lexsort((seen.frame, name.astype(str)))
    bounds = _bounds(name[order])
    frame = frames_of(epochs, frames)
    dt_s = array(epochs, "dt_s")
    epoch_ns = array(epochs, "epoch")
    query = _queries(bounds, frames.time_ns[seen.frame[order]], epoch_ns, np.abs(dt_s).max())
    return _view_table(
        frames, seen, order, bounds, query, frame, epochs, tracked, cameras, settings
    )


def _with_lone(frames: Frames, detections: pa.Table, settings: Settings) -> pa.Table:
    """Return the detections; the unknown ones of lone frames have an id as a tracklet has."""
    lone_frames = frames.number[in_lone_frames(frames.time_ns, settings.tracklets)]
    if not len(lone_frames):
        return detections
    unknown = array(detections, "kind") == "unknown"
    lone = unknown & np.isin(array(detections, "frame_number"), lone_frames)
    return with_lone_detections(detections, lone)


def frames_of(epochs: pa.Table, frames: Frames) -> Indices:
    """Return the row in `frames` of the frame that serves each epoch."""
    by_number = np.argsort(frames.number, kind="stable")
    return by_number[
        np.searchsorted(frames.number[by_number], array(epochs, "frame_number"))
    ].astype(np.int64)


def _bounds(names: npt.NDArray[np.object_]) -> Indices:
    """Return where each run of equal names begins, and the end."""
    change = np.flatnonzero(names[1:] != names[:-1]) + 1
    return np.concatenate([[0], change, [len(names)]]).astype(np.int64)


def _queries(
    bounds: Indices, time_ns: Indices, epoch_ns: Indices, beyond_s: float
) -> tuple[Indices, Indices]:
    """Return (tracklet, epoch row) of every epoch that a tracklet covers."""
    beyond_ns = int(beyond_s * 1e9) + 1
    first = np.searchsorted(epoch_ns, time_ns[bounds[:-1]] - beyond_ns)
    last = np.searchsorted(epoch_ns, time_ns[bounds[1:] - 1] + beyond_ns, side="right")
    count = last - first
    tracklet = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    epoch = np.arange(count.sum()) - np.repeat(start - first, count)
    return tracklet, epoch


def _view_table(
    frames: Frames,
    seen: Sightings,
    order: Indices,
    bounds: Indices,
    query: tuple[Indices, Indices],
    frame: Indices,
    epochs: pa.Table,
    tracked: pa.Table,
    cameras: pa.Table,
    settings: Settings,
) -> pa.Table:
    tracklet, row = query
    origin = frames.time_ns[0]
    own = seen.frame[order]
    v = np.nan_to_num(frames.v_gcrf_km_s)
    u_still = aberrate(seen.u_icrs[order], -v[own])
    at_s = (array(epochs, "epoch")[row] - origin) / 1e9
    u, _, noise, bias, _ = directions_at(
        bounds[tracklet],
        bounds[tracklet + 1],
        at_s,
        np.radians(settings.tracklets.max_rate_deg_s) / 3,  # the fastest is a 3-sigma rate
        (frames.time_ns[own] - origin) / 1e9,
        u_still,
        seen.cov_noise[order],
        seen.cov_bias[order],
        settings.alignment.window_s,
    )
    served = frame[row]
    centroid, missed = _centroids(seen, order, bounds, tracklet, served, tracked)
    camera = camera_of(cameras, int(frames.camera[0]))
    q = interpolate_quaternions((frames.time_ns - origin) / 1e9, frames.q_sensor_from_icrs, at_s)
    u_sensor = np.einsum("nij,nj->ni", matrix_from_quaternion(q), aberrate(u, v[served]))
    x_px, y_px = project(camera, u_sensor)
    r_km = _carried(frames, served, array(epochs, "dt_s")[row])
    cov_noise, cov_bias = on_tangent_plane(u, noise), on_tangent_plane(u, bias)
    names = array(tracked, "tracklet_id")[seen.row[order[bounds[:-1]]]]
    kept = np.isfinite(x_px) & np.isfinite(r_km[:, 0])
    columns = {
        "epoch": array(epochs, "epoch")[row],
        "sensor_id": array(epochs, "sensor_id")[row],
        "frame_number": frames.number[served],
        "tracklet_id": names[tracklet],
        "x_px": x_px,
        "y_px": y_px,
        **unstack("u{}", u),
        **unstack_covariance("cov_noise_{}_rad2", cov_noise, TANGENT_AXES),
        **unstack_covariance("cov_bias_{}_rad2", cov_bias, TANGENT_AXES),
        **unstack("{}_km", r_km),
        "position_sigma_km": frames.position_sigma_km[served],
        "pixel_rad": np.full(len(row), camera.pixel_rad),
    }
    columns = {key: values[kept] for key, values in columns.items()}
    columns["centroid"] = pa.array(centroid[kept], mask=missed[kept])
    return table(VIEWS, columns).sort_by([("epoch", "ascending"), ("tracklet_id", "ascending")])


def _centroids(
    seen: Sightings,
    order: Indices,
    bounds: Indices,
    tracklet: Indices,
    served: Indices,
    tracked: pa.Table,
) -> tuple[Indices, npt.NDArray[np.bool_]]:
    """Return each query's centroid in the frame that serves, and where there is none."""
    n_frames = len(seen.offsets)
    run = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
    key = run * n_frames + seen.frame[order]  # increasing: runs, and frames within each
    wanted = tracklet * n_frames + served
    at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    missed = key[at] != wanted
    return array(tracked, "centroid")[seen.row[order[at]]], missed


def _carried(frames: Frames, served: Indices, dt_s: Array) -> Array:
    """Return the sensor's positions at the epochs, carried from the frames that serve them.

    Along the orbit's curve, which over a second is 4 m deep.
    """
    r, v = frames.r_gcrf_km[served], frames.v_gcrf_km_s[served]
    back = -dt_s[:, None]  # dt is frame minus epoch
    gravity = -GM_KM3_S2 * r / np.linalg.norm(r, axis=1, keepdims=True) ** 3
    return r + np.nan_to_num(v) * back + gravity * back**2 / 2
