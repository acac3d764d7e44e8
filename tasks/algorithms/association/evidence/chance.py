"""Chance: what makes unrelated tracklets agree, estimated from the data."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.sampling.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC

Array = npt.NDArray[np.float64]


class Chance(NamedTuple):
    """What chance has to work with, estimated from the data.

    density : (s,) float
        Tracklets a steradian.
    drift : (s, 3) float
        How its tracklets move, the median rate of their directions [1/s].
    spread : (s,) float
        How differently the tracklets of a sensor move, 1-sigma an axis [rad/s].
    objects_in_view, objects_km3 : float
        How many objects there are, at most, and that a km^3 of the space in view.
    detected : (s,) float
        Probability that a sensor which looks at an object has a tracklet of it.
    """

    density: Array
    drift: Array
    spread: Array
    objects_in_view: float
    objects_km3: float
    detected: Array


def chance_of(samples: Samples, farthest_km: float, detected: float) -> Chance:
    """Return what chance has to work with before anything is associated."""
    n_sensors = len(samples.field_sr)
    count = np.bincount(samples.sensor, minlength=n_sensors).astype(float)
    instants = np.maximum(samples.seen.any(axis=0).sum(), 1)
    # A tracklet that is seen at one instant of many is not in the field at the others.
    share = np.bincount(samples.sensor, samples.seen.sum(axis=1), minlength=n_sensors) / instants
    density = np.maximum(share, 1.0) / samples.field_sr
    rate = _rates(samples)
    drift, spread = np.zeros((n_sensors, 3)), np.empty(n_sensors)
    for s in range(n_sensors):
        own = rate[(samples.sensor == s) & np.isfinite(rate[:, 0])]
        # One made-up tracklet at 10 arcsec/s keeps the estimate sane where there are few.
        drift[s] = np.median(own, axis=0) if len(own) else 0.0
        squares = np.sum((own - drift[s]) ** 2) / 2
        spread[s] = np.sqrt((squares + (10 * ARCSEC) ** 2) / (len(own) + 1))
    volume = float(np.median(samples.field_sr)) * farthest_km**3 / 3
    objects = max(float(np.median(count)), 1.0)
    return Chance(density, drift, spread, objects, objects / volume, np.full(n_sensors, detected))


def _rates(samples: Samples) -> Array:
    """Return each tracklet's mean rate [rad/s] between its first and last sample; NaN: one."""
    out = np.full((len(samples.sensor), 3), np.nan)
    n_instants = samples.seen.shape[1]
    twice = np.flatnonzero(samples.seen.sum(axis=1) > 1)
    if len(twice):
        a = np.argmax(samples.seen[twice], axis=1)
        b = n_instants - 1 - np.argmax(samples.seen[twice, ::-1], axis=1)
        dt = samples.time_s[b] - samples.time_s[a]
        out[twice] = (samples.u[twice, b] - samples.u[twice, a]) / dt[:, None]
    return out
