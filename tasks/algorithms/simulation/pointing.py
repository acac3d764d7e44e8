"""Pointing: attitudes that track an object, stay fixed, spin or jump."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM

Array = npt.NDArray[np.float64]


def look_along(z: Array, up: Array, roll_rad: float = 0.0) -> Rotation:
    """Return the rotations, sensor from ICRS, with the boresight along (n, 3) directions.

    The image's upper edge (-y) is towards `up`, (3,) or (n, 3), then rolled about the boresight.
    """
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    y = -(up - np.einsum("ij,ij->i", z, np.broadcast_to(up, z.shape))[:, None] * z)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R_sensor_from_icrs = np.stack([np.cross(y, z), y, z], axis=1)
    return Rotation.from_rotvec([0.0, 0.0, roll_rad]) * Rotation.from_matrix(R_sensor_from_icrs)


def body_fixed(
    r_km: Array, v_km_s: Array, azimuth_rad: float, elevation_rad: float, roll_rad: float
) -> Rotation:
    """Return attitudes, sensor from ICRS, that are fixed to the sensor's own orbital frame.

    The frame is radial (away from the Earth), across (the orbit's normal) and along, which
    completes it. Up in the image is radial; where the boresight is within a thousandth of a
    radian of that, it is along.

    Parameters
    ----------
    r_km, v_km_s : (n, 3) float
        Positions and velocities of the sensor, GCRF.
    azimuth_rad, elevation_rad : float
        Boresight, from along towards across, and from there towards radial.
    """
    radial = r_km / np.linalg.norm(r_km, axis=1, keepdims=True)
    across = np.cross(r_km, v_km_s)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, radial)
    level = np.cos(azimuth_rad) * along + np.sin(azimuth_rad) * across
    z = np.cos(elevation_rad) * level + np.sin(elevation_rad) * radial
    up = radial if abs(np.cos(elevation_rad)) > 1e-3 else along
    return look_along(z, up, roll_rad)


def spinning(start: Rotation, axis: Array, rate_rad_s: float, t_s: Array) -> Rotation:
    """Return attitudes, sensor from ICRS, of a constant rotation about an inertial axis."""
    turned = np.asarray(t_s)[:, None] * (rate_rad_s * axis / np.linalg.norm(axis))
    return start * Rotation.from_rotvec(turned).inv()


def random_attitudes(
    rng: np.random.Generator, r_sensor_km: Array, clearance_rad: float | None
) -> Rotation:
    """Return a uniformly random attitude, sensor from ICRS, for each sensor position (n, 3).

    With a clearance, the boresight is at least that far from the Earth's limb.
    """
    distance = np.linalg.norm(r_sensor_km, axis=1)
    limb = np.arcsin(np.minimum(EARTH_RADIUS_KM / distance, 1.0))
    # Four normal numbers, scaled to unit length, are uniform over all rotations.
    q = rng.standard_normal((len(r_sensor_km), 4))
    low = np.arange(len(q)) if clearance_rad is not None else np.arange(0)
    while len(low):
        boresight = Rotation.from_quat(q[low]).as_matrix()[:, 2]
        to_earth = -np.einsum("ij,ij->i", boresight, r_sensor_km[low]) / distance[low]
        low = low[np.arccos(np.clip(to_earth, -1, 1)) < limb[low] + clearance_rad]
        q[low] = rng.standard_normal((len(low), 4))
    return Rotation.from_quat(q)
