"""Chance: how often unrelated tracklets agree, estimated from the data."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.sampling.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC

Array = npt.NDArray[np.float64]


class Chance(NamedTuple):
    """The tracklets of each of s sensors as a random process, estimated from the data.

    density : (s,) float
        Tracklets per steradian.
    drift : (s, 3) float
        Median rate of their directions [1/s].
    spread : (s,) float
        Spread of their rates, 1-sigma per axis [rad/s].
    objects_in_view, objects_km3 : float
        Largest number of objects in view, and the same per km^3.
    detected : (s,) float
        Probability that a sensor detects an object in its field.
    """

    density: Array
    drift: Array
    spread: Array
    objects_in_view: float
    objects_km3: float
    detected: Array


def chance_of(samples: Samples, farthest_km: float, detected: float) -> Chance:
    """Return the estimate before anything is associated; `detected` is the same for all sensors."""
    n_sensors = len(samples.field_sr)
    count = np.bincount(samples.sensor, minlength=n_sensors).astype(float)
    instants = np.maximum(samples.seen.any(axis=0).sum(), 1)
    # A tracklet counts by its share of the instants: it is in the field at these only.
    share = np.bincount(samples.sensor, samples.seen.sum(axis=1), minlength=n_sensors) / instants
    density = np.maximum(share, 1.0) / samples.field_sr
    rate = _rates(samples)
    drift, spread = np.zeros((n_sensors, 3)), np.empty(n_sensors)
    moving = np.flatnonzero(np.isfinite(rate[:, 0]))
    moving = moving[np.argsort(samples.sensor[moving], kind="stable")]
    first = np.searchsorted(samples.sensor[moving], np.arange(n_sensors + 1))
    for s in range(n_sensors):
        rates = rate[moving[first[s] : first[s + 1]]]
        # One assumed tracklet at 10 arcsec/s steadies the estimate where there are few.
        drift[s] = np.median(rates, axis=0) if len(rates) else 0.0
        squares = np.sum((rates - drift[s]) ** 2) / 2
        spread[s] = np.sqrt((squares + (10 * ARCSEC) ** 2) / (len(rates) + 1))
    volume = float(np.median(samples.field_sr)) * farthest_km**3 / 3
    objects = max(float(np.median(count)), 1.0)
    return Chance(density, drift, spread, objects, objects / volume, np.full(n_sensors, detected))


def _rates(samples: Samples) -> Array:
    """Return each tracklet's mean rate [rad/s] from first to last sample; NaN with one sample."""
    out = np.full((len(samples.sensor), 3), np.nan)
    n_instants = samples.seen.shape[1]
    twice = np.flatnonzero(samples.seen.sum(axis=1) > 1)
    if len(twice):
        a = np.argmax(samples.seen[twice], axis=1)
        b = n_instants - 1 - np.argmax(samples.seen[twice, ::-1], axis=1)
        dt = samples.time_s[b] - samples.time_s[a]
        out[twice] = (samples.u[twice, b] - samples.u[twice, a]) / dt[:, None]
    return out
