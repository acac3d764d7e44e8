"""Sightings: detections with the attitude of their frame and the position of its sensor."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.direction_errors import (
    attitude_covariance,
    centroid_covariance,
)
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.algorithms.geometry.sky import unit_from_radec

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class Frames(NamedTuple):
    """Frames of one sensor, in time order.

    The attitude of frames without one is the identity, so their directions are in sensor axes.
    """

    table: pa.Table
    number: npt.NDArray[np.int64]
    time_ns: npt.NDArray[np.int64]
    q_sensor_from_icrs: Array
    cov_att_rad2: Array
    from_stars: npt.NDArray[np.bool_]
    r_gcrf_km: Array
    v_gcrf_km_s: Array
    position_sigma_km: Array
    camera: npt.NDArray[np.int64]


def solved_frames(solutions: pa.Table) -> Frames:
    """Return the frames of a `solutions` table that have an attitude, in time order."""
    return _frames(solutions.filter(pa.compute.field("attitude_source") != "none"))


def unsolved_frames(solutions: pa.Table) -> Frames:
    """Return the frames of a `solutions` table with a camera but no attitude, in time order."""
    unsolved = (pa.compute.field("attitude_source") == "none") & (pa.compute.field("camera") >= 0)
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
    ``offsets[k]:offsets[k + 1]``. `cov_noise` is the error that is independent in each frame,
    `cov_bias` the error that is common to all [rad^2, ICRS]: the error of an attitude from stars
    is independent, that of a prior is common.
    """

    row: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    u_icrs: Array
    cov_noise: Array
    cov_bias: Array


def sightings_of(frames: Frames, detections: pa.Table) -> Sightings:
    """Return the sightings in solved frames, sorted by frame."""
    row, frame = _in_frames(frames, detections)
    u = unit_from_radec(
        np.radians(array(detections, "ra_deg")[row]), np.radians(array(detections, "dec_deg")[row])
    )
    noise = centroid_covariance(u, array(detections, "sigma_arcsec")[row] * ARCSEC)
    R = matrix_from_quaternion(frames.q_sensor_from_icrs)
    attitude = attitude_covariance(u, (np.swapaxes(R, -1, -2) @ frames.cov_att_rad2 @ R)[frame])
    stars = frames.from_stars[frame][:, None, None]
    return Sightings(
        row,
        frame,
        np.searchsorted(frame, np.arange(len(frames.number) + 1)),
        u,
        noise + np.where(stars, attitude, 0.0),
        np.where(stars, 0.0, attitude),
    )


def image_sightings_of(frames: Frames, detections: pa.Table, camera: Camera) -> Sightings:
    """Return the sightings in unsolved frames, sorted by frame; directions in sensor axes."""
    row, frame = _in_frames(frames, detections)
    u = unproject(camera, array(detections, "x_px")[row], array(detections, "y_px")[row])
    noise = centroid_covariance(u, array(detections, "sigma_arcsec")[row] * ARCSEC)
    offsets = np.searchsorted(frame, np.arange(len(frames.number) + 1))
    return Sightings(row, frame, offsets, u, noise, np.zeros_like(noise))


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


def part_of(sightings: Sightings, kept: npt.NDArray[np.bool_]) -> Sightings:
    """Return some of the sightings, in the same order."""
    before = np.concatenate([[0], np.cumsum(kept)])
    return Sightings(
        sightings.row[kept],
        sightings.frame[kept],
        before[sightings.offsets],
        sightings.u_icrs[kept],
        sightings.cov_noise[kept],
        sightings.cov_bias[kept],
    )


def camera_of(cameras: pa.Table, row: int) -> Camera:
    """Return the camera in a row of `cameras`."""
    # Not the time: a Python datetime has no nanoseconds.
    return Camera(**cameras.select(list(Camera._fields)).slice(row, 1).to_pylist()[0])


def optics_covariance_of(cameras: pa.Table, row: int) -> Array:
    """Return the covariance (9, 9) of the optics in a row of `cameras`; 0 as the log tells them."""
    return stack_covariance(cameras.slice(row, 1), "cov_{}", OPTICS_AXES)[0]
