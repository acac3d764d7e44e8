"""Classify detections that are no objects: hot pixels, planets, unlisted stars."""

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.constants import ARCSEC, SECOND_NS
from epipole.tasks.algorithms.geometry.camera import Camera, pixel_angle, unproject
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.geometry.turning import angular_rates, turned
from epipole.tasks.algorithms.orbits.planets import planet_directions
from epipole.tasks.algorithms.tracking.hot_pixels import FixedPositions, fixed_positions
from epipole.tasks.common.sightings import Frames, Sightings, by_camera, camera_of, row_offsets_s

GATE_SIGMA = 4.0  # largest distance of a detection from a known hot pixel, planet or star


def stated_sigma_px(
    frames: Frames, sightings: Sightings, detections: pa.Table, cameras: pa.Table
) -> Array:
    """Return the 1-sigma error of each sighting in the image [px]; `cameras` are those of
    `frames`."""
    x_px, y_px = (array(detections, name)[sightings.row] for name in ("x_px", "y_px"))
    pixel_rad = np.empty(len(sightings.row))
    for row, of in by_camera(frames.camera[sightings.frame]):
        camera = camera_of(cameras, row)
        # Off the boresight a pixel is smaller: at 45 degrees by four tenths.
        pixel_rad[of] = pixel_angle(camera, unproject(camera, x_px[of], y_px[of]))
    return np.asarray(array(detections, "sigma_arcsec")[sightings.row] * ARCSEC / pixel_rad)


def static_positions(
    frames: Frames, sightings: Sightings, detections: pa.Table, sigma_px: Array, camera: Camera
) -> FixedPositions:
    """Return the pixel positions that sightings stay at, and how likely each is a hot pixel.

    sigma_px : (n,) float, of `stated_sigma_px`
    """
    return fixed_positions(
        sightings.frame,
        array(detections, "x_px")[sightings.row],
        array(detections, "y_px")[sightings.row],
        sigma_px,
        (frames.time_ns - frames.time_ns[0]) / 1e9,
        frames.q_sensor_from_icrs,
        camera,
    )


def at_hot_pixel(
    sightings: Sightings, detections: pa.Table, known: Flags, sigma_px: Array
) -> Flags:
    """Return which sightings stand where hot pixels do.

    known : (d,) bool, these among all detections
    sigma_px : (n,) float, of `stated_sigma_px`
    """
    position_px = np.column_stack([array(detections, "x_px"), array(detections, "y_px")])
    if not known.any() or not len(sightings.row):
        return np.zeros(len(sightings.row), bool)
    off_px, _ = cKDTree(position_px[known]).query(position_px[sightings.row])
    return np.asarray(off_px < GATE_SIGMA * sigma_px)


def is_planet(frames: Frames, sightings: Sightings, cameras: pa.Table) -> Flags:
    """Return which sightings lie at a planet, within the errors of both; `cameras` are those of
    `frames`."""
    r_km, v_km_s = np.nan_to_num(frames.r_gcrf_km), np.nan_to_num(frames.v_gcrf_km_s)
    u, error_rad = planet_directions(frames.time_ns, r_km, v_km_s)
    boresight = matrix_from_quaternion(frames.q_sensor_from_icrs)[:, 2]
    widest_rad = max(
        camera_of(cameras, row).half_diagonal_rad for row, _ in by_camera(frames.camera)
    )
    edge = np.cos(widest_rad + error_rad)
    in_field = np.einsum("fpa,fa->fp", u, boresight) > edge
    planets = np.zeros(len(sightings.row), bool)
    sigma = sighting_sigma(sightings)
    for planet in np.flatnonzero(in_field.any(axis=0)):
        rows = np.flatnonzero(in_field[sightings.frame, planet])
        frame = sightings.frame[rows]
        off = np.linalg.norm(sightings.u_icrs[rows] - u[frame, planet], axis=1)
        planets[rows] |= off < error_rad[frame, planet] + GATE_SIGMA * sigma[rows]
    return planets


def at_star(sightings: Sightings, rows: Integers, stars: Array) -> Flags:
    """Return which of some sightings stand at a star.

    Parameters
    ----------
    rows : (n,) int
        Indices of these sightings.
    stars : (s, 3) float
        Directions of stars, unit vectors.
    """
    if not len(stars) or not len(rows):
        return np.zeros(len(rows), bool)
    off, _ = cKDTree(stars).query(sightings.u_icrs[rows])
    return np.asarray(off < GATE_SIGMA * sighting_sigma(sightings)[rows])


def star_directions(frames: Frames, stars: pa.Table, cameras: pa.Table) -> Array:
    """Return where each star of STARS was measured, the mean over its frames: (s, 3) unit vectors,
    ICRS, with the aberration of the sensor. `cameras` are those of `frames`."""
    by_number = np.argsort(frames.number, kind="stable")
    number = array(stars, "frame_number")
    if not len(number) or not len(by_number):
        return np.zeros((0, 3))
    at = np.minimum(np.searchsorted(frames.number[by_number], number), len(by_number) - 1)
    frame = by_number[at]
    known = frames.number[frame] == number
    x_px, y_px, frame = array(stars, "x_px")[known], array(stars, "y_px")[known], frame[known]
    R = matrix_from_quaternion(frames.q_sensor_from_icrs)
    camera, u = frames.camera[frame], np.empty((len(frame), 3))
    for row, of in by_camera(camera):
        u[of] = unproject(camera_of(cameras, row), x_px[of], y_px[of])
    row_s = row_offsets_s(cameras, camera, y_px)
    if row_s.any():  # as they were at the times of the frames
        t_s = (frames.time_ns - frames.time_ns[0]) / SECOND_NS
        rates = angular_rates(t_s, R, np.ones(len(t_s), np.bool_))
        u = turned(u, -rates[frame] * row_s[:, None])
    u = np.einsum("nij,ni->nj", R[frame], u)
    ids, star = np.unique(array(stars, "star_id")[known], return_inverse=True)
    mean = np.column_stack([np.bincount(star, u[:, a], minlength=len(ids)) for a in range(3)])
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def sighting_sigma(sightings: Sightings) -> Array:
    """Return the 1-sigma error per axis [rad] of each sighting, the attitude's error included."""
    noise, bias = sightings.cov_noise, sightings.cov_bias
    variance = noise[:, 0, 0] + bias[:, 0, 0]
    for a in (1, 2):  # not np.trace of their sum, which would be as large as they are
        variance = variance + (noise[:, a, a] + bias[:, a, a])
    return np.asarray(np.sqrt(variance / 2))
