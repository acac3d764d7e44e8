"""Input and output of association: samples of tracklets at common instants, and their groups.

A sample is the direction of a tracklet, or of a single detection, at one instant.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.kernels import kernel

FREE = -1  # the object of a tracklet that belongs to none


class Samples(NamedTuple):
    """Tracklets of s sensors at k common instants: t tracklets.

    sensor : (t,) int
        Sensor of the tracklet, 0 .. s - 1.
    start_s, end_s : (t,) float
        First and last detection [s]. Tracklets of one sensor that overlap are different objects.
    seen : (t, k) bool
        The tracklet has a direction at the instant.
    u : (t, k, 3) float
        Directions without aberration, ICRS.
    cov : (t, k, 2, 2) float
        Their covariances [rad^2] on `tangent_basis(u)`.
    sigma_km : (t, k) float
        1-sigma errors of the sensor positions, per axis [km].
    time_s : (k,) float
        The instants [s].
    sensor_km : (s, k, 3) float
        Positions of the sensors [km], GCRF; NaN where unknown. They must be known at the instants
        at which a tracklet of the sensor is seen.
    R_sensor_from_icrs : (s, k, 3, 3) float
        Attitudes of the sensors; NaN where unknown.
    half_field : (s, 2) float
        Tangents of half the field's width and height.
    rate : (t, k, 3) float or None
        Rates of the directions [rad/s], ICRS; 0 where unknown.
    sensor_km_s : (s, k, 3) float or None
        Velocities of the sensors [km/s], GCRF; NaN where unknown. Without them, or without the
        rates, light time is ignored. This is right for sensors at similar ranges.
    magnitude : (t,) float or None
        Mean apparent magnitudes; NaN where unknown.
    blend_rad : (s,) float or None
        Angle between two objects below which a sensor sees them as one [rad]; None: always apart.
    """

    sensor: Indices
    start_s: Array
    end_s: Array
    seen: Flags
    u: Array
    cov: Array
    sigma_km: Array
    time_s: Array
    sensor_km: Array
    R_sensor_from_icrs: Array
    half_field: Array
    rate: Array | None = None
    sensor_km_s: Array | None = None
    magnitude: Array | None = None
    blend_rad: Array | None = None

    @property
    def field_sr(self) -> Array:
        """Solid angle of each sensor's field [sr], (s,)."""
        x, y = self.half_field.T
        return 4 * np.arcsin(np.clip(x * y / np.sqrt((1 + x * x) * (1 + y * y)), 0, 1))


class Groups(NamedTuple):
    """Which tracklets are one object.

    group : (t,) int
        Group of each tracklet; `FREE` for no group.
    score : (g,) float
        Log-odds of each group against its members being unrelated.
    ambiguous : (t,) bool
        Tracklets in no group because two groups explain them about equally well, or because
        the group that explains them is not certain enough.
    undecided : (t,) bool
        Other tracklets in no group that fit one object with a tracklet of another sensor, but with
        too little evidence.
    detected : (s,) float
        Estimated probability that a sensor detects an object in its field; NaN if not estimated.
    """

    group: Indices
    score: Array
    ambiguous: Flags
    undecided: Flags
    detected: Array


class InstantPoints(NamedTuple):
    """One point for each of k instants, solved where at least two tracklets have a direction.

    x_km : (k, 3) float
        Positions [km], GCRF.
    normal, cov_km2 : (k, 3, 3) float
        Normal equations [1/km^2] (the upper half is filled) and their inverse, the covariance.
    seen_by : (k,) int
        Number of tracklets with a direction at the instant. Below 2 the point is undefined.
    """

    x_km: Array
    normal: Array
    cov_km2: Array
    seen_by: Indices


def repeated_samples(seen: Flags, time_s: Array, width_s: Array) -> Array:
    """Return how many samples of its tracklet each sample repeats, itself included, (t, k).

    Samples that are fitted to the same detections share their errors. With this factor on the noise
    of each, the shared detections count once.

    Parameters
    ----------
    seen : (t, k) bool
        Whether tracklet t has a sample at instant k.
    time_s : (k,) float
        The instants [s].
    width_s : (t, k) float
        Time that the detections of each sample span.
    """
    out = np.empty(seen.shape)
    _count_repeated(seen, np.array(time_s, float), np.array(width_s, float, order="C"), out)
    return out


@kernel
def _count_repeated(seen, time_s, width_s, out):
    """Write `repeated_samples` to `out` (t, k); the other arguments as there."""
    for t in range(len(seen)):
        for i in range(len(time_s)):
            out[t, i] = 1.0 if seen[t, i] else 0.0
            for j in range(len(time_s)):
                if j != i and seen[t, j]:
                    width = max((width_s[t, i] + width_s[t, j]) / 2, 1e-9)
                    out[t, i] += max(1 - abs(time_s[i] - time_s[j]) / width, 0.0)
