"""Sensor check: a sensor that looks at what the others see and never agrees is wrong itself.

A wrong clock, position or attitude moves all of a sensor's lines of sight. Its tracklets then
join no object, though the objects that the other sensors found stand in its field and it has
tracklets enough.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.visibility import sees
from epipole.tasks.algorithms.association.sampling.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.geometry.triangulation import triangulate

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
    n_sensors, n_groups = len(samples.half_field), len(groups.score)
    looked, joined = np.zeros(n_sensors, np.int64), np.zeros(n_sensors, np.int64)
    member, group, instant = _members_at_best(samples, groups)
    has = np.zeros((n_groups, n_sensors), np.int64)
    np.add.at(has, (group, samples.sensor[member]), 1)
    points = _points(samples, member, group, instant, n_groups)
    for g in np.flatnonzero(np.isfinite(points[:, 0])).tolist():
        m = instant[g]
        for s in np.flatnonzero(has[g].sum() - has[g] >= 2).tolist():
            place, attitude = samples.sensor_km[s, m], samples.R_sensor_from_icrs[s, m]
            if has[g, s] or sees(place, attitude, samples.half_field[s], points[g]):
                looked[s] += 1
                joined[s] += has[g, s] > 0
    free = np.bincount(samples.sensor[groups.group == FREE], minlength=n_sensors)
    return Agreement(looked, joined, free)


def _members_at_best(samples: Samples, groups: Groups) -> tuple[Indices, Indices, Indices]:
    """Return the members that each group has when it has most, their groups; and when that is."""
    n_groups = len(groups.score)
    member = np.flatnonzero(groups.group != FREE)
    member = member[np.argsort(groups.group[member], kind="stable")]
    count = np.zeros((n_groups, samples.seen.shape[1]), np.int64)
    np.add.at(count, groups.group[member], samples.seen[member])
    instant = np.argmax(count, axis=1)
    member = member[samples.seen[member, instant[groups.group[member]]]]
    return member, groups.group[member], instant


def _points(
    samples: Samples, member: Indices, group: Indices, instant: Indices, n_groups: int
) -> Array:
    """Return where the groups' lines of sight meet, (g, 3); NaN where they do not."""
    m = instant[group]
    x, *_ = triangulate(
        np.searchsorted(group, np.arange(n_groups + 1)),
        samples.sensor_km[samples.sensor[member], m],
        samples.u[member, m],
        samples.cov[member, m],
        samples.sigma_km[member, m],
        np.zeros((n_groups, 3)),
        np.inf,
    )
    return x
