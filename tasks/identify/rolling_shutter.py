"""Rolling shutter: a sensor's centroids as they were at the times of their frames.

A row is exposed some time before or after the frame, and the sensor has turned meanwhile. Its rate
comes from the attitudes of neighbouring frames. So the frames are identified first, with an error
that an unknown rate makes, and then again.
"""

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.bridge import array, stack
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.geometry.turning import angular_rates, turned
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.identify.frame_inputs import FlatCentroids

# 1-sigma of the unknown rate of a sensor [rad/s], tried in this order until this share of its
# frames is identified. 0: the rate of the prior attitudes, or rest.
UNKNOWN_RATES, ENOUGH = (0.0, 2e-3, 2e-2), 0.5
# Most rounds with rates from attitudes, and the change of directions that ends them: the first
# attitudes are of centroids without a correction, and so a little off.
ROUNDS, SETTLED_PX = 4, 0.02
ASSUMED_PX = 0.3  # 1-sigma of a centroid that states none, beside the error of an unknown rate

Identified = tuple[IdentifiedSensor | None, Integers]


def identify_at_frame_times(
    exposures: pa.Table,
    frame_states: pa.Table,
    c: FlatCentroids,
    identify: Callable[[FlatCentroids], Identified],
) -> tuple[Identified, FlatCentroids]:
    """Return what `identify` finds, and the centroids as they were at the times of their frames.

    Parameters
    ----------
    exposures, frame_states
        EXPOSURES of one sensor, in order of time, and SENSOR_STATES_AT_FRAMES.
    identify
        Identifies the frames of these centroids; see `identify_stars`.
    """
    if not c.row_s.any():
        return identify(c), c
    time_ns = array(exposures, "time")
    t_s = (time_ns - time_ns[0]) / 1e9
    q = stack(frame_states, "q{}", "xyzw")
    has_prior = np.isfinite(q[:, 3])
    stated = at_frame_times(c, angular_rates(t_s, matrix_from_quaternion(q), has_prior))
    best, most, c = identify(stated), -1, stated
    for rate in UNKNOWN_RATES:
        tried = stated if not rate else with_unknown_rate(stated, rate)
        found = best if not rate else identify(tried)
        solved = 0 if found[0] is None else int(found[0].solutions.solved.sum())
        if solved > most:
            best, most, c = found, solved, tried
        if most > ENOUGH * len(t_s):
            break
    for _ in range(ROUNDS):
        if best[0] is None or most < 2:
            break
        solutions, before = best[0].solutions, c.turn
        c = at_frame_times(
            stated, angular_rates(t_s, solutions.R_sensor_from_icrs, solutions.solved)
        )
        best = identify(c)
        most = 0 if best[0] is None else int(best[0].solutions.solved.sum())
        if np.abs(c.turn - before).max() < SETTLED_PX * np.nanmin(c.pixel_rad):
            break
    return best, c


def at_frame_times(c: FlatCentroids, rates: Array) -> FlatCentroids:
    """Return the centroids with their directions at the times of their frames.

    Parameters
    ----------
    rates : (F, 3) float
        Of each frame, as `angular_rates` gives them.
    """
    turn = rates[c.frame] * c.row_s[:, None]
    at_rows = turned(c.u, c.turn) if c.turn.any() else c.u
    return c._replace(u=turned(at_rows, -turn), turn=turn)


def with_unknown_rate(c: FlatCentroids, rate_rad_s: float) -> FlatCentroids:
    """Return the centroids with the error that a rate of this 1-sigma makes, of each by its row."""
    stated = np.where(np.isnan(c.sigma_px), ASSUMED_PX, c.sigma_px)
    return c._replace(sigma_px=np.hypot(stated, rate_rad_s * np.abs(c.row_s) / c.pixel_rad))
