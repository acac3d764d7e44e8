"""Rolling shutter: a sensor's centroids as they were at the times of their frames.

A row is exposed some time before or after the frame, and the sensor has turned meanwhile. Its rate
comes from the attitudes of neighbouring frames, or, where all are too far apart, from the stars of
each frame. So the frames are identified first, with an error that an unknown rate makes, and then
again.
"""

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import array, stack
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.geometry.turning import (
    FrameRates,
    angular_rates,
    rates_within_frames,
    turned,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.identify.frame_inputs import FlatCentroids
from epipole.tasks.identify.tabulate import (
    barycentric_velocity,
    matched_stars,
    predicted_stars,
    used_sigma_px,
)

# 1-sigma of the unknown rate of a sensor [rad/s], tried in this order until this share of its
# frames is identified; before them the rate of the prior attitudes, or rest.
UNKNOWN_RATES, ENOUGH = (2e-3, 2e-2), 0.5
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
    t_s, v_km_s = (time_ns - time_ns[0]) / 1e9, barycentric_velocity(time_ns, frame_states)
    q = stack(frame_states, "q{}", "xyzw")
    rates = angular_rates(t_s, matrix_from_quaternion(q), np.isfinite(q[:, 3]))
    stated = at_frame_times(c, rates)
    best, c = _with_any_rate(stated, identify)
    by_stars = False
    for _ in range(ROUNDS):
        if best[0] is None or not best[0].solutions.solved.any():
            break
        solutions, before = best[0].solutions, c.turn
        known = angular_rates(t_s, solutions.R_sensor_from_icrs, solutions.solved)
        by_stars = not known.any()
        if by_stars:
            change = _rates_of_stars(best, stated, c, v_km_s).rate_rad_s
            rates = _at_all_frames(t_s, rates + change, solutions.solved)
        else:
            rates = known
        c = at_frame_times(stated, rates)
        best = identify(c)
        if np.abs(c.turn - before).max() < SETTLED_PX * np.nanmin(c.pixel_rad):
            break
    if by_stars and best[0] is not None:
        best = _with_errors_of_rates(best, c, _rates_of_stars(best, stated, c, v_km_s))
    return best, c


def _with_any_rate(
    stated: FlatCentroids, identify: Callable[[FlatCentroids], Identified]
) -> tuple[Identified, FlatCentroids]:
    """Return what is identified with the error of an unknown rate that most frames need, and the
    centroids with it."""
    best, c = identify(stated), stated
    most = _n_solved(best)
    for rate in UNKNOWN_RATES:
        if most > ENOUGH * (len(stated.first) - 1):
            break
        tried = with_unknown_rate(stated, rate)
        found = identify(tried)
        if _n_solved(found) > most:
            best, most, c = found, _n_solved(found), tried
    return best, c


def _n_solved(found: Identified) -> int:
    return 0 if found[0] is None else int(found[0].solutions.solved.sum())


def _rates_of_stars(
    found: Identified, stated: FlatCentroids, c: FlatCentroids, v_km_s: Array
) -> FrameRates:
    """Return what the identified stars tell of the rates of their frames, beyond those of `c`.

    `stated` has the errors of centroids without that of an unknown rate, `v_km_s` (F, 3) are the
    sensor's velocities by which stars are aberrated.
    """
    sensor, rows = found
    assert sensor is not None
    stars, R = matched_stars(sensor, rows, c), sensor.solutions.R_sensor_from_icrs
    at, frame = stars.at, c.frame[stars.at]
    u = predicted_stars(R, stars, frame, v_km_s)
    sigma_px = used_sigma_px(stated, at, stars.floor_px) * stars.scale[frame]
    return rates_within_frames(
        frame, u, c.u[at] - u, c.row_s[at], sigma_px * c.pixel_rad[at], len(R)
    )


def _at_all_frames(t_s: Array, rates: Array, known: Flags) -> Array:
    """Return the rates (F, 3), interpolated in frames in which they are not known."""
    return np.column_stack([np.interp(t_s, t_s[known], rates[known, k]) for k in range(3)])


def _with_errors_of_rates(found: Identified, c: FlatCentroids, rates: FrameRates) -> Identified:
    """Return what was found, with what the errors of the frames' rates add to the covariances.

    The scale of centroid errors is that of residuals, after three unknowns of each frame. Rates
    that were fitted to the same stars have made these smaller.
    """
    sensor, rows = found
    assert sensor is not None
    n_stars = np.bincount(c.frame[rows[sensor.solutions.star >= 0]], minlength=len(c.first) - 1)
    fitted = rates.n_fitted > 0
    left = np.sum(2.0 * n_stars - rates.n_fitted, where=fitted)
    larger = np.sum(2.0 * n_stars - 3.0, where=fitted) / left if left > 0 else 1.0
    # A scale of 1 is that of the log.
    larger = np.where(sensor.sigma_scale == 1.0, 1.0, max(larger, 1.0))
    cov = sensor.solutions.cov_rad2 * larger[:, None, None]
    alone = traces(rates.cov_alone)
    # The solutions have other errors of centroids than the fit assumes.
    scale = np.where(alone > 0, traces(cov) / np.where(alone > 0, alone, 1.0), 0.0)
    cov = cov + scale[:, None, None] * (rates.cov_rad2 - rates.cov_alone)
    solutions = sensor.solutions._replace(cov_rad2=cov)
    scales = sensor.sigma_scale * np.sqrt(larger)
    return sensor._replace(solutions=solutions, sigma_scale=scales), rows


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
