"""Passages: low sensors that look at random directions; two of them see one object for a while."""

import numpy as np

from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import propagate

TIMES = np.array([4.0, 10.0, 16.0, 22.0, 26.0])
SIGMA = 2 * ARCSEC
HALF_FIELD = np.radians(9.0)
RADIUS_KM, SPEED_KM_S = 6920.0, 7.59


def passages(seed: int, n_sensors: int) -> Samples:
    """Return the tracklets of low sensors in fields of 18 degrees.

    The first two sensors are those of the seed, however many there are, and see one object from
    about 1,200 km. Each other one sees one object of its own, which no other sensor has in its
    field.
    """
    rng = np.random.default_rng(seed)
    sensors = [_orbit(rng)]
    sensors.append(_orbit(rng, near=sensors[0][:3]))
    target = _orbit(rng, near=sensors[0][:3], radius_km=7400.0)
    sensors += [_orbit(rng, away_from=target[:3]) for _ in range(n_sensors - 2)]
    r = np.array([[propagate(s, t)[:3] for t in TIMES] for s in sensors])
    targets = [target, target, *(_orbit(rng, near=s[:3], radius_km=7400.0) for s in sensors[2:])]
    path = np.array([[propagate(o, t)[:3] for t in TIMES] for o in targets]) - r
    u = path / np.linalg.norm(path, axis=2, keepdims=True)
    look = u[:, 2:3]  # fixed in space, on the object in the middle of the time
    basis = tangent_basis(u)
    u = u + np.einsum("ska,skai->ski", rng.normal(size=(*u.shape[:2], 2)) * SIGMA, basis)
    u /= np.linalg.norm(u, axis=2, keepdims=True)
    seen = np.einsum("ski,sji->skj", u, look)[..., 0] > np.cos(HALF_FIELD)
    n, k = seen.shape
    attitude = np.concatenate([tangent_basis(look), look[:, :, None]], axis=2)
    return Samples(
        sensor=np.arange(n),
        start_s=np.array([TIMES[s][0] for s in seen]),
        end_s=np.array([TIMES[s][-1] for s in seen]),
        seen=seen,
        u=u,
        cov=np.tile(np.eye(2) * SIGMA**2, (n, k, 1, 1)),
        sigma_km=np.full((n, k), 0.02),
        time_s=TIMES,
        sensor_km=r,
        R_sensor_from_icrs=np.tile(attitude, (1, k, 1, 1)),
        half_field=np.full((n, 2), np.tan(HALF_FIELD)),
    )


def _orbit(rng, near=None, away_from=None, radius_km=RADIUS_KM):
    """Return a state on a circular orbit: within 1,000 km of a position, or behind the Earth."""
    while True:
        out = rng.normal(size=3)
        if near is not None:
            out = near / np.linalg.norm(near) + 0.08 * out
        out /= np.linalg.norm(out)
        if away_from is None or out @ away_from < -0.3 * np.linalg.norm(away_from):
            break
    along = np.cross(out, rng.normal(size=3))
    speed = SPEED_KM_S * np.sqrt(RADIUS_KM / radius_km)
    return np.concatenate([radius_km * out, speed * along / np.linalg.norm(along)])
