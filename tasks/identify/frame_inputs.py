"""The inputs of identification: one sensor's centroids as arrays, and its state at each frame.

`flatten_centroids` puts the centroid lists of all frames one after another, with their directions.
`interpolate_sensor_states` returns position, velocity and prior attitude at the times of frames.
"""

import logging
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import array, flatten, nullable, stack, table, unstack
from epipole.schemas.log_bounds import POSITION, SPEED
from epipole.schemas.settings import SensorSettings
from epipole.schemas.work_tables import SENSOR_STATES_AT_FRAMES
from epipole.tasks.algorithms.geometry.camera import (
    Camera,
    inside,
    pixel_angle,
    row_offset_s,
    unproject,
)
from epipole.tasks.algorithms.log_checks.frames import LEAST_SIGMA_PX
from epipole.tasks.algorithms.orbits.state_interpolation import (
    InterpolatedStates,
    SensorStates,
    interpolate_states,
)
from epipole.tasks.algorithms.star_identification.centroids import filled_sigmas
from epipole.tasks.common.sightings import calibration_at

LOGGER = logging.getLogger(__name__)

_MIX = np.uint64(0x9E3779B97F4A7C15)  # an odd number with mixed bits, from the golden ratio


class FlatCentroids(NamedTuple):
    """All centroids of one sensor's frames, one after another.

    Frame k has the centroids ``first[k]:first[k + 1]``. Cameras are named by their row in
    `cameras`; -1 where a frame's camera is unknown.
    """

    first: Integers
    frame: Integers
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array  # NaN where none is possible as stated; a missing one is the others' median
    u: Array  # sensor axes at the frame's time
    pixel_rad: Array
    in_image: Flags  # of the frame's camera; false without one
    camera_of_frame: Integers
    cameras: dict[int, Camera]
    row_s: Array  # time of a centroid's row after the frame's
    turn: Array  # (N, 3) rotation of directions from the frame's time to the row's [rad]
    repeated: Flags  # at the very position of another one of the frame; then not `in_image` either


def flatten_centroids(
    exposures: pa.Table, cameras: pa.Table, settings: SensorSettings
) -> FlatCentroids:
    """Return the centroids of one sensor's frames, with the valid cameras."""
    x_px, first = flatten(exposures, "x_px")
    y_px, _ = flatten(exposures, "y_px")
    frame = np.repeat(np.arange(exposures.num_rows), np.diff(first))
    sigma_px = optional_values(exposures, "sigma_px")
    sigma_px[sigma_px < LEAST_SIGMA_PX] = np.nan
    if settings.centroid_sigma_px is not None:
        sigma_px = np.where(np.isnan(sigma_px), settings.centroid_sigma_px, sigma_px)
    sigma_px = filled_sigmas(sigma_px)
    camera_of_frame, used = _cameras_of(exposures, cameras)
    u, pixel_rad = np.zeros((len(x_px), 3)), np.ones(len(x_px))
    row_s, turn = np.zeros(len(x_px)), np.zeros((len(x_px), 3))
    in_image = np.zeros(len(x_px), np.bool_)
    flux = optional_values(exposures, "flux")
    repeated = repeats(frame, x_px, y_px, flux)
    for row, camera in used.items():
        at = camera_of_frame[frame] == row
        u[at] = unproject(camera, x_px[at], y_px[at])
        pixel_rad[at] = pixel_angle(camera, u[at])
        row_s[at] = row_offset_s(camera, y_px[at])
        # In the corners of a wide lens's image, a position may have no direction.
        in_image[at] = inside(camera, x_px[at], y_px[at]) & np.isfinite(u[at, 2]) & ~repeated[at]
    return FlatCentroids(
        first, frame, x_px, y_px, flux, sigma_px, u, pixel_rad, in_image, camera_of_frame, used,
        row_s, turn, repeated,
    )  # fmt: skip


def repeats(frame: Integers, x_px: Array, y_px: Array, flux: Array) -> Flags:
    """Return which centroids (n,) have the very position of a brighter or an earlier one of their
    frame. A star that two centroids fit equally well would be left without any."""
    found = np.zeros(len(x_px), np.bool_)
    # Equal positions have equal numbers: without two of these, which is usual, nothing is sorted
    # by position, which takes ten times as long.
    x, y = (np.ascontiguousarray(v, np.float64).view(np.uint64) for v in (x_px, y_px))
    number = np.sort((x * _MIX + y) * _MIX + frame.astype(np.uint64))
    if not np.any(number[1:] == number[:-1]):
        return found
    order = np.lexsort((-np.nan_to_num(flux), y_px, x_px, frame))
    later, before = order[1:], order[:-1]
    same = (frame[later] == frame[before]) & (x_px[later] == x_px[before])
    found[later[same & (y_px[later] == y_px[before])]] = True
    return found


def optional_values(exposures: pa.Table, name: str) -> Array:
    """Return a list column as one array, a value per centroid; NaN where a list is null or a value
    not positive."""
    _, first = flatten(exposures, "x_px")
    known, first_known = flatten(exposures, name)
    values = np.full(first[-1], np.nan)
    values[np.repeat(np.diff(first_known) > 0, np.diff(first))] = known
    values[~(values > 0)] = np.nan
    return values


def _cameras_of(exposures: pa.Table, cameras: pa.Table) -> tuple[Integers, dict[int, Camera]]:
    """Return the row of `cameras` that is valid for each frame (-1: unknown), and these cameras."""
    rows = np.flatnonzero(array(cameras, "sensor_id") == exposures["sensor_id"][0].as_py())
    if len(rows) == 0:
        return np.full(exposures.num_rows, -1), {}
    times = array(cameras, "time")[rows]
    rows = rows[np.argsort(times, kind="stable")]
    holds = rows[calibration_at(np.sort(times), array(exposures, "time"))]
    used = np.unique(holds)
    values = [cameras.select(list(Camera._fields)).slice(int(r), 1).to_pylist()[0] for r in used]
    return holds, {int(r): Camera(**v) for r, v in zip(used, values, strict=True)}


# States.

# Bounds in GCRF. Earth-fixed axes turn, so states of a log may be twice as fast there.
MAX_SPEED_KM_S, MAX_RADIUS_KM = 2 * SPEED.maximum, 2 * POSITION.maximum


def interpolate_sensor_states(
    exposures: pa.Table, states: pa.Table, settings: SensorSettings
) -> pa.Table:
    """Return SENSOR_STATES_AT_FRAMES, one row per row of `exposures`; see `interpolate_states`.

    `states` are sorted by sensor and time, each time once, as `order_sensors` leaves them.
    """
    sensor, time_ns = array(exposures, "sensor_id"), array(exposures, "time")
    state_sensor, all_states = array(states, "sensor_id"), _states(states, settings)
    n = len(time_ns)
    at_frames = InterpolatedStates(
        *(np.full((n, *width), np.nan) for width in ((3,), (3,), (), (4,), ()))
    )
    stated = np.zeros(n, bool)
    for name in sorted(set(sensor)):
        frames = np.flatnonzero(sensor == name)
        rows = np.flatnonzero(state_sensor == name)
        columns: list[npt.NDArray[Any]] = [values[rows] for values in all_states]
        stated[frames] = _states_sigma(states.take(rows), time_ns[frames])
        found = interpolate_states(
            SensorStates(*columns),
            time_ns[frames],
            settings.state_gap_s,
        )
        for column, values in zip(at_frames, _possible(found), strict=True):
            column[frames] = values
    without = np.count_nonzero(np.isnan(at_frames.r_gcrf_km[:, 0]))
    LOGGER.debug(
        "interpolated the states of %d frames; %d have no state near in time", n - without, without
    )
    by_name = {
        **unstack("{}_km", at_frames.r_gcrf_km),
        **unstack("v{}_km_s", at_frames.v_gcrf_km_s),
        "position_sigma_km": np.where(stated, at_frames.position_sigma_km, np.nan),
        "used_position_sigma_km": at_frames.position_sigma_km,
        **unstack("q{}", at_frames.q_sensor_from_icrs, "xyzw"),
        "attitude_sigma_arcsec": at_frames.attitude_sigma,
    }
    key = {name: exposures[name] for name in ("sensor_id", "frame_number", "time")}
    return table(
        SENSOR_STATES_AT_FRAMES,
        {**key, **{name: nullable(value) for name, value in by_name.items()}},
    )


def _possible(found: InterpolatedStates) -> InterpolatedStates:
    """Return the states, without a position where the sensor would be too fast or too far away.

    A wrong clock or position shows only between two states: neither states a speed for which a log
    would be refused.
    """
    speed = np.linalg.norm(found.v_gcrf_km_s, axis=1)
    radius = np.linalg.norm(found.r_gcrf_km, axis=1)
    known = (speed <= MAX_SPEED_KM_S) & (radius <= MAX_RADIUS_KM)
    return found._replace(
        r_gcrf_km=np.where(known[:, None], found.r_gcrf_km, np.nan),
        v_gcrf_km_s=np.where(known[:, None], found.v_gcrf_km_s, np.nan),
        position_sigma_km=np.where(known, found.position_sigma_km, np.nan),
    )


def _states_sigma(states: pa.Table, at_ns: Integers) -> Flags:
    """Return whether the states of one sensor on both sides of each time state their sigma."""
    if not states.num_rows:
        return np.zeros(len(at_ns), bool)
    known = array(states, "position_sigma_km") > 0
    right = np.minimum(np.searchsorted(array(states, "time"), at_ns), states.num_rows - 1)
    return np.asarray(known[np.maximum(right - 1, 0)] & known[right])


def _states(states: pa.Table, settings: SensorSettings) -> SensorStates:
    """Return the states as arrays; an unknown sigma (0) takes the value of the settings."""
    position_sigma_km = array(states, "position_sigma_km")
    attitude_sigma = array(states, "attitude_sigma_arcsec")
    return SensorStates(
        array(states, "time"),
        stack(states, "{}_km"),
        stack(states, "v{}_km_s"),
        np.where(position_sigma_km > 0, position_sigma_km, settings.position_sigma_km),
        stack(states, "q{}", "xyzw"),
        np.where(attitude_sigma > 0, attitude_sigma, settings.attitude_sigma_arcsec),
    )
