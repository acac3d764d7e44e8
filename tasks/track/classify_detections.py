"""What detections are, other than objects: hot pixels, planets, unlisted stars."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.spatial import cKDTree

from epipole.schemas.bridge import array
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.algorithms.orbits.planets import planet_directions
from epipole.tasks.algorithms.tracking.hot_pixels import hot_pixels
from epipole.tasks.common.sightings import Frames, Sightings

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

GATE_SIGMA = 4.0  # a detection is what stands within this of it


def is_hot_pixel(frames: Frames, seen: Sightings, detections: pa.Table, camera: Camera) -> Flags:
    """Return which sightings are hot pixels."""
    sigma_px = array(detections, "sigma_arcsec")[seen.row] * ARCSEC / camera.pixel_rad
    return hot_pixels(
        seen.frame,
        array(detections, "x_px")[seen.row],
        array(detections, "y_px")[seen.row],
        sigma_px,
        (frames.time_ns - frames.time_ns[0]) / 1e9,
        frames.q_sensor_from_icrs,
        camera,
    )


def at_hot_pixel(seen: Sightings, detections: pa.Table, known: Flags, camera: Camera) -> Flags:
    """Return which sightings stand in the image where known hot pixels (rows) do."""
    place_px = np.column_stack([array(detections, "x_px"), array(detections, "y_px")])
    if not known.any() or not len(seen.row):
        return np.zeros(len(seen.row), bool)
    off_px, _ = cKDTree(place_px[known]).query(place_px[seen.row])
    sigma_px = array(detections, "sigma_arcsec")[seen.row] * ARCSEC / camera.pixel_rad
    return np.asarray(off_px < GATE_SIGMA * sigma_px)


def is_planet(frames: Frames, seen: Sightings, camera: Camera) -> Flags:
    """Return which sightings lie where a planet does, to its ephemeris's and their own error."""
    here, moving = np.nan_to_num(frames.r_gcrf_km), np.nan_to_num(frames.v_gcrf_km_s)
    u, error_rad = planet_directions(frames.time_ns, here, moving)
    boresight = matrix_from_quaternion(frames.q_sensor_from_icrs)[:, 2]
    edge = np.cos(camera.half_diagonal_rad + error_rad)
    in_field = np.einsum("fpa,fa->fp", u, boresight) > edge
    out = np.zeros(len(seen.row), bool)
    sigma = sighting_sigma(seen)
    for planet in np.flatnonzero(in_field.any(axis=0)):
        rows = np.flatnonzero(in_field[seen.frame, planet])
        frame = seen.frame[rows]
        off = np.linalg.norm(seen.u_icrs[rows] - u[frame, planet], axis=1)
        out[rows] |= off < error_rad[frame, planet] + GATE_SIGMA * sigma[rows]
    return out


def at_star(seen: Sightings, rows: npt.NDArray[np.int64], stars: Array) -> Flags:
    """Return which of some sightings stand where a run stood still: an unlisted star.

    Parameters
    ----------
    rows : (n,) int
        Sightings asked for.
    stars : (s, 3) float
        Unit vectors of the runs that stood still.
    """
    if not len(stars) or not len(rows):
        return np.zeros(len(rows), bool)
    off, _ = cKDTree(stars).query(seen.u_icrs[rows])
    return np.asarray(off < GATE_SIGMA * sighting_sigma(seen)[rows])


def sighting_sigma(seen: Sightings) -> Array:
    """Return the 1-sigma error an axis [rad] of each sighting, attitude and all."""
    return np.sqrt(np.trace(seen.cov_noise + seen.cov_bias, axis1=1, axis2=2) / 2)
