"""Points at one instant: sensors in low orbits see objects near GEO, and false points.

The scene of the association benchmark: 2 degree fields of 512 px, 0.16 px centroids,
attitude errors of 1" (x, y) and 8" (roll), 95 % of the objects detected.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.covariances import (
    attitude_covariance,
    centroid_covariance,
    on_tangent_plane,
)
from epipole.tasks.algorithms.geometry.directions import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    tangent_basis,
)

CENTRE_KM = np.array([-39353.5, 15130.6, 452.2])
GEO_RADIUS_KM, RING_KM = 42164.2, 15.0
FIELD_RAD = np.radians(2.0)
PIXEL_RAD = FIELD_RAD / 512
CENTROID_PX = 0.16
ATTITUDE_RAD = np.array([1.0, 1.0, 8.0]) * ARCSEC
PRIOR_DETECTION = 0.95


class Points(NamedTuple):
    """Samples of one instant, the object of each point (-1: false), and the positions [km]."""

    samples: Samples
    who: Integers
    x_km: Array


def low_orbits(rng: np.random.Generator, n: int) -> Array:
    """Return positions of sensors at 600 to 1200 km that see the centre past the Earth."""
    out: list[Array] = []
    while len(out) < n:
        r = rng.normal(size=3)
        r *= rng.uniform(6980, 7580) / np.linalg.norm(r)
        sight = CENTRE_KM - r
        along = -(r @ sight) / (sight @ sight)
        if not 0 < along < 1 or np.linalg.norm(r + along * sight) > 6478:
            out.append(r)
    return np.array(out)


def scene(
    seed: int, n_sensors: int, n_objects: int, n_false: int, spread_km: float = 250.0
) -> Points:
    """Return the points of one instant."""
    rng = np.random.default_rng(seed)
    r = low_orbits(rng, n_sensors)
    x = CENTRE_KM + rng.normal(size=(n_objects, 3)) * spread_km
    # Uniform across the field; in altitude within the geostationary ring.
    height = GEO_RADIUS_KM + rng.normal(size=n_objects) * RING_KM
    x *= (height / np.linalg.norm(x, axis=1))[:, None]
    sensor, who, u, cov, look = [], [], [], [], []
    for s in range(n_sensors):
        boresight = (CENTRE_KM - r[s]) / np.linalg.norm(CENTRE_KM - r[s])
        R = np.vstack([tangent_basis(boresight), boresight])
        seen = np.flatnonzero(rng.random(n_objects) < PRIOR_DETECTION)
        toward = (x[seen] - r[s]) @ R.T
        place = toward[:, :2] / toward[:, 2:]
        inside = (np.abs(place) < FIELD_RAD / 2).all(axis=1)
        false = rng.uniform(-FIELD_RAD / 2, FIELD_RAD / 2, (n_false, 2))
        place = np.vstack([place[inside], false])
        place += rng.normal(size=place.shape) * CENTROID_PX * PIXEL_RAD
        label = np.concatenate([seen[inside], np.full(n_false, -1)])
        order = rng.permutation(len(label))
        sight = np.column_stack([place[order], np.ones(len(order))])
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        # The attitude error: one small rotation for all points of the sensor.
        turn = matrix_from_quaternion(
            quaternion_from_rotation_vector(rng.normal(size=3) * ATTITUDE_RAD)
        )
        u_icrs = sight @ (turn @ R)
        error = centroid_covariance(u_icrs, np.full(len(order), CENTROID_PX * PIXEL_RAD))
        error += attitude_covariance(u_icrs, R.T @ np.diag(ATTITUDE_RAD**2) @ R)
        sensor.append(np.full(len(order), s))
        who.append(label[order])
        u.append(u_icrs)
        cov.append(on_tangent_plane(u_icrs, error))
        look.append(R)
    n = sum(map(len, who))
    samples = Samples(
        sensor=np.concatenate(sensor),
        start_s=np.zeros(n),
        end_s=np.zeros(n),
        seen=np.ones((n, 1), bool),
        u=np.concatenate(u)[:, None],
        cov=np.concatenate(cov)[:, None],
        sigma_km=np.full((n, 1), 1e-3),
        time_s=np.zeros(1),
        sensor_km=r[:, None],
        R_sensor_from_icrs=np.array(look)[:, None],
        half_field=np.full((n_sensors, 2), FIELD_RAD / 2),
    )
    return Points(samples, np.concatenate(who), x)


def oracle_groups(points: Points, least: float, lead: float) -> Integers:
    """Return the groups from the true positions of the objects: the best that errors allow.

    In each sensor an object gets the point that fits best, if its log-odds against "missed, and
    a false point here" are at least `least` and lead those of the next point by `lead`.
    """
    s = points.samples
    group = np.full(len(points.who), -1)
    for sensor, r in enumerate(s.sensor_km[:, 0]):
        rows = np.flatnonzero(s.sensor == sensor)
        toward = points.x_km - r
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        e = np.einsum("tai,ni->nta", tangent_basis(s.u[rows, 0]), toward)
        weight = np.linalg.inv(s.cov[rows, 0])
        spot = 2 * np.pi * np.sqrt(np.linalg.det(s.cov[rows, 0]))
        clutter = len(rows) / FIELD_RAD**2
        odds = np.log(PRIOR_DETECTION / (1 - PRIOR_DETECTION) / (clutter * spot))
        odds = odds - np.einsum("nta,tab,ntb->nt", e, weight, e) / 2
        odds[toward @ s.u[rows, 0].mean(axis=0) < 0] = -np.inf
        order = np.argsort(-odds, axis=1)[:, :2]
        best, second = np.take_along_axis(odds, order, axis=1).T
        sure = np.flatnonzero((best >= least) & (best - second >= lead))
        # A point that two objects claim belongs to the likelier one.
        for k in sure[np.argsort(best[sure])].tolist():
            group[rows[order[k, 0]]] = k
    return group


class Score(NamedTuple):
    """Objects that three sensors detect, groups, right groups, groups with a false view."""

    wanted: int
    groups: int
    right: int
    strays: int

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.right / max(self.wanted + self.groups, 1)


def judge(points: Points, group: Integers, least: int = 3) -> Score:
    """Score groups of `least` views or more.

    A group is right if it holds at least that many of its object's points and no other;
    groups of fewer views are not counted.
    """
    seen_by = np.bincount(points.who[points.who >= 0])
    groups = right = strays = 0
    for g in range(group.max(initial=-1) + 1):
        members = points.who[group == g]
        if len(members) < least:
            continue
        groups += 1
        true = members[members >= 0]
        best = np.bincount(true).argmax() if len(true) else -1
        n_best = int((members == best).sum()) if len(true) else 0
        right += n_best >= least and n_best == len(members)
        strays += n_best >= least and n_best < len(members)
    return Score(int((seen_by >= least).sum()), groups, right, strays)
