"""Strangers: sensors that never look there take nothing from the two that see an object."""

import numpy as np
import pytest
from scenes.many_sensors import circular
from scenes.tracklet_scenes import Scene
from scenes.tracklet_scenes import solve as solve_scene

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


def with_idle(samples, n):
    """Return the samples with n more sensors without a tracklet, which look away from the rest."""
    k, away = samples.seen.shape[1], np.array([1.0, 0.0, 0.0])
    r = np.array([7000.0, 500.0, 0.0]) + 30.0 * np.arange(n)[:, None] * [0.0, 1.0, 0.0]
    R = np.concatenate([tangent_basis(away), away[None]])
    return samples._replace(
        sensor_km=np.concatenate([samples.sensor_km, np.tile(r[:, None], (1, k, 1))]),
        R_sensor_from_icrs=np.concatenate(
            [samples.R_sensor_from_icrs, np.tile(R, (n, k, 1, 1))]
        ),
        half_field=np.concatenate([samples.half_field, np.full((n, 2), 0.01)]),
    )  # fmt: skip


@pytest.mark.parametrize("n_idle", [1, 3, 4])
def test_sensors_that_see_nothing_change_nothing(n_idle):
    """Of two sensors among many strays, few groups are certain: each part of the odds counts."""
    n_found = 0
    for seed in range(4):
        samples = Scene(seed, 2, sigma_arcsec=2.0).objects(20).strays(100).samples()
        alone, among = solve_scene(samples), solve_scene(with_idle(samples, n_idle))
        np.testing.assert_array_equal(among.group, alone.group)
        np.testing.assert_allclose(among.score, alone.score, rtol=1e-12)
        np.testing.assert_array_equal(among.ambiguous, alone.ambiguous)
        n_found += len(alone.score)
    assert n_found > 10
