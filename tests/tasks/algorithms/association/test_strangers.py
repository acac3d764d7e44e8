"""Strangers: sensors that never look there take nothing from the two that see an object."""

import numpy as np
import pytest
from scenes.many_sensors import circular

from epipole.schemas.settings import AssociationSettings
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC, GM_KM3_S2
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.solve.associate_objects import associate_by_likelihood

TIMES = np.arange(0.0, 30.0, 2.5)
SIGMA = 13 * ARCSEC
SHELL_KM, HALF_FIELD = 6928.0, np.radians(9.0)
APART_KM = (300.0, 1200.0)  # of a sensor and what it sees
N_PAIRS = 8


def _paths(x, v):
    """Return circular paths (n, k, 3) through places at the middle time, and velocities there."""
    radius = np.linalg.norm(x, axis=1)[:, None, None]
    angle = (TIMES - TIMES.mean())[None, :, None] * np.sqrt(GM_KM3_S2 / radius**3)
    along = (v / np.linalg.norm(v, axis=1, keepdims=True))[:, None] * radius
    return np.cos(angle) * x[:, None] + np.sin(angle) * along


def _beside(rng, x):
    """Return places of sensors in the shell, some hundred km from x (n, 3), and velocities."""
    out = x + tangent_to(rng, x) * rng.uniform(*APART_KM, (len(x), 1))
    out *= SHELL_KM / np.linalg.norm(out, axis=1, keepdims=True)
    v = tangent_to(rng, out) * np.sqrt(GM_KM3_S2 / SHELL_KM)
    return out, v


def tangent_to(rng, x):
    """Return random unit vectors at right angles to each x (n, 3)."""
    side = np.cross(x, rng.normal(size=x.shape))
    return side / np.linalg.norm(side, axis=1, keepdims=True)


def scene(seed, n_strangers):
    """Pairs of sensors with an object each, and strangers that see one of their own each.

    The pairs, and what they see, are the same for any number of strangers.
    """
    parts = []
    for number, each, part in ((N_PAIRS, 2, 0), (n_strangers, 1, 1)):
        rng = np.random.default_rng([seed, part])
        x, v = circular(rng, number, 7000.0, 2.5)
        x, v = np.repeat(x, each, axis=0), np.repeat(v, each, axis=0)
        r, w = _beside(rng, x)
        sensor_km, object_km = _paths(r, w), _paths(x, v)
        u = object_km - sensor_km
        u /= np.linalg.norm(u, axis=2, keepdims=True)
        look = u[:, len(TIMES) // 2]
        u = u + np.einsum("nka,nkai->nki", rng.normal(0, SIGMA, (*u.shape[:2], 2)),
                          tangent_basis(u))  # fmt: skip
        parts.append((sensor_km, u / np.linalg.norm(u, axis=2, keepdims=True), look, w))
    sensor_km, u, look, w = (np.concatenate(each) for each in zip(*parts, strict=True))
    n, k = u.shape[:2]
    seen = np.einsum("nki,ni->nk", u, look) > np.cos(HALF_FIELD)
    R = np.concatenate([tangent_basis(look), look[:, None]], axis=1)
    first, last = np.argmax(seen, axis=1), k - 1 - np.argmax(seen[:, ::-1], axis=1)
    return Samples(
        sensor=np.arange(n), start_s=TIMES[first], end_s=TIMES[last], seen=seen, u=u,
        cov=np.tile(np.eye(2) * SIGMA**2, (n, k, 1, 1)), sigma_km=np.full((n, k), 0.016),
        time_s=TIMES, sensor_km=sensor_km, R_sensor_from_icrs=np.repeat(R[:, None], k, axis=1),
        half_field=np.full((n, 2), np.tan(HALF_FIELD)),
    )  # fmt: skip


def solve(samples):
    return associate_by_likelihood(samples, np.zeros(0), AssociationSettings())


def found(groups):
    """Return which pairs are found, their two sensors and no other in one group."""
    of = groups.group[: 2 * N_PAIRS].reshape(-1, 2)
    alone = [np.count_nonzero(groups.group == g) == 2 for g in of[:, 0]]
    return (of[:, 0] >= 0) & (of[:, 0] == of[:, 1]) & alone


@pytest.mark.parametrize("seed", range(2))
def test_two_sensors_find_their_object_among_any_number_of_others(seed):
    alone = found(solve(scene(seed, 0)))
    assert alone.sum() >= N_PAIRS - 1
    for n_strangers in (60, 1500):
        assert (found(solve(scene(seed, n_strangers))) >= alone).all()
