"""Residuals: how far a direction is from a predicted object, along and across its track."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S

Array = npt.NDArray[np.float64]


def track_residuals(
    directions: Array, sensor_km: Array, sensor_km_s: Array, states: Array
) -> Array:
    """Return observed minus predicted places at the object's distance, along and across its track.

    Parameters
    ----------
    directions : (n, 2) float
        Astrometric right ascension and declination [rad], GCRF; light time not removed.
    sensor_km, sensor_km_s : (n, 3) float
        Position and velocity of the sensor, GCRF.
    states : (n, 6) float
        Predicted states of the object at the same times [km, km/s], GCRF.

    Returns
    -------
    (n, 2) float
        [km]: along the apparent motion, and to the left of it as the sensor sees it from inside
        the sky.
    """
    apart = states[:, :3] - sensor_km
    delay_s = np.linalg.norm(apart, axis=1, keepdims=True) / SPEED_OF_LIGHT_KM_S
    apart = apart - delay_s * states[:, 3:]  # where the light came from
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    predicted = apart / distance
    ra, dec = directions.T
    observed = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    moving = states[:, 3:] - sensor_km_s
    moving -= np.sum(moving * predicted, axis=1, keepdims=True) * predicted
    along = moving / np.linalg.norm(moving, axis=1, keepdims=True)
    across = np.cross(along, predicted)
    off = (observed - predicted) * distance
    return np.stack([np.sum(off * along, axis=1), np.sum(off * across, axis=1)], axis=1)
