"""Agreement: a sensor that has the others' objects in its field but joins none is at fault.

A wrong clock, position or attitude moves all of a sensor's lines of sight. Its tracklets then
join no object, although objects of the other sensors are in its field and it has enough
tracklets.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.visibility import seeing
from epipole.tasks.algorithms.association.sampling.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.geometry.triangulation import triangulate

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

FEWEST_OBJECTS = 3  # objects in its field from which a sensor is judged
AGREES = 0.3  # least share of them that a sound sensor joins
STRAYS = 0.5  # tracklets without an object per object in the field, of a sensor at fault


class Agreement(NamedTuple):
    """How many objects were in each sensor's field, and how many it joined.

    looked : (s,) int
        Objects of at least two other sensors that were in the sensor's field.
    joined : (s,) int
        Those of them that have a tracklet of the sensor.
    free : (s,) int
        Tracklets of the sensor without an object.
    """

    looked: Indices
    joined: Indices
    free: Indices

    def disagreeing(self) -> Indices:
        """Return the sensors that detect but disagree: they should be left out."""
        return np.flatnonzero(
            (self.looked >= FEWEST_OBJECTS)
            & (self.joined < AGREES * self.looked)
            & (self.free >= STRAYS * self.looked)
        )


def agreement(samples: Samples, groups: Groups) -> Agreement:
    """Return how far each sensor agrees with the objects of the other sensors."""
    n_sensors, n_groups = len(samples.half_field), len(groups.score)
    looked, joined = np.zeros(n_sensors, np.int64), np.zeros(n_sensors, np.int64)
    member, group, instant = _members_at_best(samples, groups)
    has = np.zeros((n_groups, n_sensors), np.int64)
    np.add.at(has, (group, samples.sensor[member]), 1)
    points = _points(samples, member, group, instant, n_groups)
    half_field = np.array(samples.half_field, float)
    in_field = np.zeros(n_sensors, bool)
    for g in np.flatnonzero(np.isfinite(points[:, 0])).tolist():
        place, attitude = (
            np.ascontiguousarray(values[:, instant[g]])
            for values in (samples.sensor_km, samples.R_sensor_from_icrs)
        )
        seeing(place, attitude, half_field, points[g], in_field)
        others = has[g].sum() - has[g] >= 2
        looked += others & (in_field | (has[g] > 0))
        joined += others & (has[g] > 0)
    free = np.bincount(samples.sensor[groups.group == FREE], minlength=n_sensors)
    return Agreement(looked, joined, free)


def _members_at_best(samples: Samples, groups: Groups) -> tuple[Indices, Indices, Indices]:
    """Return the members of each group at its best instant, their groups, and these instants.

    The best instant is the first one with most members.
    """
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
    """Return the points where the groups' lines of sight meet, (g, 3); NaN where they do not."""
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
