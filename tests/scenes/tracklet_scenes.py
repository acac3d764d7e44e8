"""Scenes of tracklets: many sensors that see geostationary objects, and scores of the groups."""

import numpy as np

from epipole.tasks.algorithms.association.likelihood import associate_tracklets
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import propagate

GEO = np.array([-39359.89, 15125.76, 64.30])
V_GEO = np.array([-1.103, -2.870, 0.0])
FIELD = np.radians(2.0)
TIMES = np.array([5.0, 17.0, 29.0])


class Scene:
    """Sensors on circular orbits that look at GEO, objects near it, and unrelated tracklets."""

    def __init__(self, seed, n_sensors, *, sigma_arcsec=1.0, times=TIMES, same_side=True):
        self.rng = np.random.default_rng(seed)
        self.times, self.sigma = times, sigma_arcsec * ARCSEC
        self.r = np.empty((n_sensors, len(times), 3))
        for s in range(n_sensors):
            while True:
                out, along = self.rng.normal(size=(2, 3))
                out /= np.linalg.norm(out)
                if not same_side or out @ GEO > 0.3 * np.linalg.norm(GEO):
                    break
            along = np.cross(out, along)
            along /= np.linalg.norm(along)
            angle = times[:, None] * 7.5 / 7000.0
            self.r[s] = 7000.0 * (np.cos(angle) * out + np.sin(angle) * along)
        self.sensor, self.who, self.seen, self.u = [], [], [], []

    def objects(self, n, spread_km=200.0, seen_by=None):
        """Add n objects near GEO with a tracklet in each sensor of `seen_by` (default: all)."""
        for k in range(n):
            start = GEO + self.rng.normal(size=3) * spread_km
            v = V_GEO + self.rng.normal(size=3) * 0.02
            orbit = np.array([propagate(np.concatenate([start, v]), t)[:3] for t in self.times])
            for s in range(len(self.r)) if seen_by is None else seen_by:
                path = orbit - self.r[s]
                self.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
        return self

    def strays(self, n, sensors=None):
        """Add n tracklets per sensor that no other sensor sees; they move much like the others."""
        for s in range(len(self.r)) if sensors is None else sensors:
            for _ in range(n):
                path = GEO + self.times[:, None] * V_GEO - self.r[s]
                u = path / np.linalg.norm(path, axis=1, keepdims=True)
                off = self.rng.uniform(-FIELD / 2, FIELD / 2, 2)
                rate = self.rng.normal(size=2) * 2 * ARCSEC
                step = off + self.times[:, None] * rate
                self.add(s, -1, u + np.einsum("ka,kai->ki", step, tangent_basis(u)))
        return self

    def add(self, sensor, who, u, seen=None):
        """Add a tracklet of object `who` (-1: unrelated) with noise; u (k, 3)."""
        noise = self.rng.normal(size=(len(self.times), 2)) * self.sigma
        u = u + np.einsum("ka,kai->ki", noise, tangent_basis(u))
        self.u.append(u / np.linalg.norm(u, axis=1, keepdims=True))
        self.sensor.append(sensor)
        self.who.append(who)
        self.seen.append(np.ones(len(self.times), bool) if seen is None else seen)

    def samples(self, order=None):
        order = np.arange(len(self.who)) if order is None else order
        sensor = np.array(self.sensor, np.int64)[order]
        seen = np.array(self.seen).reshape(-1, len(self.times))[order]
        first = np.array([self.times[np.flatnonzero(s)[0]] for s in seen])
        last = np.array([self.times[np.flatnonzero(s)[-1]] for s in seen])
        look = GEO + self.times[:, None] * V_GEO - self.r
        look /= np.linalg.norm(look, axis=2, keepdims=True)
        n_sensors = len(self.r)
        u = np.array(self.u).reshape(-1, len(self.times), 3)[order]
        return Samples(
            sensor=sensor,
            start_s=first,
            end_s=last,
            seen=seen,
            u=u,
            cov=np.tile(np.eye(2) * self.sigma**2, (*u.shape[:2], 1, 1)),
            sigma_km=np.full(u.shape[:2], 0.02),
            time_s=self.times,
            sensor_km=self.r,
            R_sensor_from_icrs=np.concatenate([tangent_basis(look), look[:, :, None]], axis=2),
            half_field=np.full((n_sensors, 2), np.tan(FIELD / 2)),
        )


def solve(samples, **changes):
    options = {
        "gate_sigma": 4.5,
        "min_altitude_km": 100.0,
        "max_range_km": 1e5,
        "min_log_odds": 3.0,
        "ambiguity_log_odds": 3.0,
    }
    return associate_tracklets(samples, **options | changes)


def pairs(label):
    """Return the pairs of tracklets with the same label, 0 or above."""
    return {
        (i, j)
        for i in range(len(label))
        for j in range(i + 1, len(label))
        if label[i] == label[j] >= 0
    }


def judge(scene, groups):
    """Return the precision and recall of pairs."""
    grouped, true = pairs(groups.group), pairs(np.array(scene.who))
    right = len(grouped & true)
    return right / max(len(grouped), 1), right / max(len(true), 1)
