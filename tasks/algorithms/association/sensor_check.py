"""Sensor check: a sensor that looks at what the others see and never agrees is wrong itself.

A wrong clock, position or attitude moves all of a sensor's lines of sight. Its tracklets then
join no object, though the objects that the other sensors found stand in its field and it has
tracklets enough.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.association.visibility import sees
from epipole.tasks.algorithms.triangulation import triangulate

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

FEWEST_OBJECTS = 3  # that a sensor must look at before it is judged
AGREES = 0.3  # share of them that a sound sensor has at least
STRAYS = 0.5  # tracklets without an object, for each object looked at, of one that sees but errs


class Agreement(NamedTuple):
    """What a sensor looked at, and what of it the sensor had.

    looked : (s,) int
        Objects, found by two other sensors or more, that stood in the sensor's field.
    joined : (s,) int
        Those of them that a tracklet of the sensor belongs to.
    free : (s,) int
        The sensor's tracklets that belong to no object.
    """

    looked: Indices
    joined: Indices
    free: Indices

    def disagreeing(self) -> Indices:
        """Return the sensors that see but err: they are to be left out."""
        return np.flatnonzero(
            (self.looked >= FEWEST_OBJECTS)
            & (self.joined < AGREES * self.looked)
            & (self.free >= STRAYS * self.looked)
        )


def agreement(samples: Samples, groups: Groups) -> Agreement:
    """Return how far each sensor agrees with the objects that the others found."""
    n_sensors = len(samples.half_field)
    looked, joined = np.zeros(n_sensors, np.int64), np.zeros(n_sensors, np.int64)
    for g in range(len(groups.score)):
        members = np.flatnonzero(groups.group == g)
        m = int(np.argmax(samples.seen[members].sum(axis=0)))
        members = members[samples.seen[members, m]]
        for s in range(n_sensors):
            others = members[samples.sensor[members] != s]
            if len(others) < 2:
                continue
            place, attitude = samples.sensor_km[s, m], samples.R_sensor_from_icrs[s, m]
            if not sees(place, attitude, samples.half_field[s], _point(samples, others, m)):
                continue
            looked[s] += 1
            joined[s] += len(others) < len(members)
    free = np.bincount(samples.sensor[groups.group == FREE], minlength=n_sensors)
    return Agreement(looked, joined, free)


def _point(samples: Samples, members: Indices, m: int) -> Array:
    """Return where the members' lines of sight meet at an instant; NaN where they do not."""
    x, *_ = triangulate(
        np.array([0, len(members)]),
        samples.sensor_km[samples.sensor[members], m],
        samples.u[members, m],
        samples.cov[members, m],
        samples.sigma_km[members, m],
        np.zeros((1, 3)),
        np.inf,
    )
    return x[0]
