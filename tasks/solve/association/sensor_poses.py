"""Sensor poses: where the sensors are and where they look at a few instants."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, stack
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.common.sightings import camera_of

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAR_S = 2.0  # a frame within this time of an epoch gives the sensor's pose


class Poses(NamedTuple):
    """Poses of s sensors at k instants: attitudes (s, k, 3, 3), positions and velocities
    (s, k, 3), GCRF; NaN where no frame is near."""

    R_sensor_from_icrs: Array
    sensor_km: Array
    sensor_km_s: Array


class SensorPoses:
    """The poses of sensors at their epochs, and their fields.

    Parameters
    ----------
    epochs
        SENSOR_EPOCHS of each sensor, in order of time.
    """

    def __init__(self, epochs: Sequence[pa.Table], cameras: pa.Table) -> None:
        self._frames = [_near_frames(rows) for rows in epochs]
        half_field, focal_px = [], []
        for rows in epochs:
            camera = camera_of(cameras, int(array(rows, "camera")[0]) if rows.num_rows else 0)
            half_field.append(
                (camera.width / camera.fx_px / 2, camera.height / abs(camera.fy_px) / 2)
            )
            focal_px.append(camera.fx_px)
        self.half_field = np.array(half_field, float).reshape(-1, 2)
        self.focal_px = np.array(focal_px, float)

    def at(self, instants: Indices) -> Poses:
        """Return the poses at some epochs."""
        n, k = len(self._frames), len(instants)
        q, place = np.full((n, k, 4), np.nan), np.full((n, k, 3), np.nan)
        velocity = np.full((n, k, 3), np.nan)
        for s, frames in enumerate(self._frames):
            if not len(frames.epoch_ns):
                continue
            at = np.searchsorted(frames.epoch_ns, instants)
            at = np.minimum(at, len(frames.epoch_ns) - 1)
            there = np.flatnonzero(frames.epoch_ns[at] == instants)
            q[s, there], place[s, there] = frames.q[at[there]], frames.r_km[at[there]]
            velocity[s, there] = frames.v_km_s[at[there]]
        return Poses(matrix_from_quaternion(q), place, velocity)


class _Frames(NamedTuple):
    """Attitude, position and velocity of a sensor at its epochs."""

    epoch_ns: Indices
    q: Array
    r_km: Array
    v_km_s: Array


def _near_frames(epochs: pa.Table) -> _Frames:
    """Return the epochs with a frame near."""
    near = epochs.filter(pa.array(np.abs(array(epochs, "dt_s")) < NEAR_S))
    return _Frames(
        array(near, "epoch"),
        stack(near, "q{}", "xyzw"),
        stack(near, "{}_km"),
        stack(near, "v{}_km_s"),
    )
