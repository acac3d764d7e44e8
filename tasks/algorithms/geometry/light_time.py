"""Light time: sensors at different ranges see an object at places of different times."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S

Array = npt.NDArray[np.float64]


def apparent_places(x_km: Array, v_km_s: Array, light_s: Array, r_km: Array) -> Array:
    """Return the places that sensors see at an epoch: where objects were when their light left.

    Parameters
    ----------
    x_km, v_km_s : (n, 3) float
        Positions [km] and velocities [km/s] of the objects, GCRF.
    light_s : (n,) float
        Time from the positions to the epoch [s].
    r_km : (n, 3) float
        Positions of the sensors at the epoch, GCRF [km].

    Returns
    -------
    (n, 3) float
        Positions [km], GCRF.
    """
    delay_s = np.linalg.norm(x_km - r_km, axis=1) / SPEED_OF_LIGHT_KM_S
    return np.asarray(x_km + v_km_s * (light_s - delay_s)[:, None])
