"""Turn states: from the reference frames of a log to GCRF."""

import logging

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, nullable, stack, table, unstack
from epipole.schemas.work_tables import ITRF, SENSOR_STATES
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, to_gcrf

LOGGER = logging.getLogger(__name__)


def states_to_gcrf(states: pa.Table, unknown_sigma_km: float) -> pa.Table:
    """Return SENSOR_STATES for the rows of LOG_STATES.

    For times outside the Earth-orientation table, sigmas of Earth-fixed positions are increased by
    the uncertainty of the Earth's rotation.
    """
    time_ns, frame = array(states, "time"), array(states, "frame")
    r_km, v_km_s = stack(states, "{}_km"), stack(states, "v{}_km_s")
    sigma_km = array(states, "position_sigma_km").copy()
    for name in sorted(set(frame)):
        i = np.flatnonzero(frame == name)
        orientation = orientation_at(time_ns[i], *read_earth_orientation())
        r_km[i], v_km_s[i] = to_gcrf(name, time_ns[i], r_km[i], v_km_s[i], orientation)
        if name == ITRF and orientation.sigma_rad.any():
            turn_km = orientation.sigma_rad * np.linalg.norm(r_km[i], axis=1)
            known_km = np.where(sigma_km[i] > 0, sigma_km[i], unknown_sigma_km)
            sigma_km[i] = np.where(turn_km > 0, np.hypot(known_km, turn_km), sigma_km[i])
            _warn_of_orientation(turn_km)
    values = {name: states[name] for name in SENSOR_STATES.names}
    values.update(unstack("{}_km", r_km), position_sigma_km=sigma_km)
    values.update({n: nullable(v) for n, v in unstack("v{}_km_s", v_km_s).items()})
    return table(SENSOR_STATES, values)


def _warn_of_orientation(turn_km: Array) -> None:
    end = np.datetime64("1858-11-17") + int(read_earth_orientation().mjd[-1])
    LOGGER.warning(
        "%d ITRF states lie outside the Earth-orientation table, which ends %s; their positions "
        "are uncertain by up to %.3f km more; install a newer astropy-iers-data",
        np.count_nonzero(turn_km),
        end,
        turn_km.max(),
    )
