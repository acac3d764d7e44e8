"""Object density: volumes against points at random, revised odds against plain counting."""

import numpy as np
import pytest
from scenes.ten_tracklets import ten_tracklets, unit

from epipole.tasks.algorithms.association.chance import (
    Chance,
    revised_odds,
    sets_of_sensors,
    visible_volume,
)
from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

SHELLS = np.array([(0.0, 10000.0, 1.0), (9000.0, 16000.0, 2.5), (16000.0, np.inf, 0.7)])


@pytest.mark.parametrize(
    ("seed", "n_sensors", "of_set"), [(0, 2, 2), (5, 3, 2), (7, 4, 2), (7, 6, 6), (12, 7, 6)]
)
def test_the_volume_is_that_of_random_points_that_just_these_sensors_see(seed, n_sensors, of_set):
    scene = ten_tracklets(seed, n_sensors=n_sensors, n_objects=1, n_strays=0)
    rng, samples, farthest = np.random.default_rng(seed), scene.samples, 2e4
    first = int(np.argmin(samples.half_field[:of_set].prod(axis=1)))
    points, wide = 400_000, samples.half_field[first]
    toward = np.column_stack([rng.uniform(-1, 1, (points, 2)) * wide, np.ones(points)])
    # Uniform on the plane: a point stands for 1 / stretch^3 of the solid angle.
    stretch = np.linalg.norm(toward, axis=1)
    rho = farthest * rng.random(points) ** (1 / 3)
    turned = unit(toward) @ samples.R_sensor_from_icrs[first, 0]
    x = samples.sensor_km[first, 0] + rho[:, None] * turned
    seen = np.array([sees(samples, s, x) for s in range(n_sensors)])
    inside, outside = seen[:of_set].sum(axis=0), seen[of_set:].sum(axis=0)
    part = 4 * wide.prod() / stretch**3 * farthest**3 / 3 / points
    part *= inside >= 0.8 * (of_set + outside)
    radius = np.linalg.norm(x, axis=1)
    expected = [w * part[(radius >= low) & (radius < high)].sum() for low, high, w in SHELLS]
    volume = visible_volume(scene.space.views, np.arange(of_set), SHELLS, farthest)
    np.testing.assert_allclose(volume, expected, rtol=0.1, atol=0.01 * np.sum(expected))
    assert volume.sum() > 0


def sees(samples, s, x):
    """Return which of the points a sensor sees, as `ten_tracklets.in_field` for many points."""
    r, R = samples.sensor_km[s, 0], samples.R_sensor_from_icrs[s, 0]
    d = x - r
    here = d @ R.T
    inside = (np.abs(here[:, :2]) <= 0.98 * samples.half_field[s] * here[:, 2:]).all(axis=1)
    part = np.clip(-(d @ r) / np.sum(d * d, axis=1), 0, 1)
    return inside & (np.linalg.norm(r + part[:, None] * d, axis=1) >= EARTH_RADIUS_KM)


def test_the_volume_is_unknown_if_one_attitude_alone_is_known():
    scene = ten_tracklets(0, n_sensors=3)
    camera = scene.space.views.camera.copy()
    camera[:2, :, 12:21] = np.nan
    views = scene.space.views._replace(camera=camera)
    assert np.isnan(visible_volume(views, np.arange(3), SHELLS, 2e4)).all()


def test_sets_of_almost_the_same_sensors_are_one():
    views = ten_tracklets(1, n_sensors=5, n_objects=1, n_strays=0, seen=1.0).space.views
    members = [(0, 1, 2, 3, 4), (0, 1), (0, 1, 2, 3, 4), (0, 1, 2, 3)]
    nothing, x = np.zeros(0, np.int64), np.zeros(3)
    groups = [Hypothesis(9.0, (0, 1), m, x, nothing) for m in members]
    groups.append(Hypothesis(9.0, (0, 1), (0, 1), x, np.array([2, 3, 4])))
    sets, of = sets_of_sensors(views, groups)
    assert [s.tolist() for s in sets] == [[0, 1, 2, 3, 4], [0, 1]]
    np.testing.assert_array_equal(of, [0, 1, 0, 0, 0])


def chance(objects, volume):
    nothing = np.zeros(0)
    return Chance(nothing, nothing, nothing, objects, objects / volume, nothing)


def counted(scores, radius, set_of, volume, assumed_km3):
    """Return the revised odds: shell by shell, group by group, to the same fixed point."""
    n, n_shells = len(scores), len(SHELLS)
    expected = [[assumed_km3 * v for v in row] for row in volume]
    prior = [
        [1e-9 + (w if lo <= radius[g] < hi else 0.0) for lo, hi, w in SHELLS] for g in range(n)
    ]
    sure, revised = [float(s > 8.0) for s in scores], list(scores)
    near = [[h for h in range(n) if h != g and set_of[h] == set_of[g]] for g in range(n)]
    for _ in range(100):
        common = [
            (sum(sure[h] for h in near[g]) + 1.0) / (sum(expected[set_of[g]]) + 1.0)
            for g in range(n)
        ]
        factor = [[c] * n_shells for c in common]
        for _ in range(10):
            share = [[sure[g] * p for p in shares(prior[g], factor[g])] for g in range(n)]
            factor = [
                [
                    common[g] * min(
                        (sum(share[h][j] for h in near[g]) + 1.0)
                        / (common[g] * expected[set_of[g]][j] + 1.0), 10.0
                    )
                    for j in range(n_shells)
                ]
                for g in range(n)
            ]  # fmt: skip
        before = sure
        revised = [
            scores[g] + np.log(np.dot(prior[g], factor[g]) / sum(prior[g])) for g in range(n)
        ]
        sure = [1 / (1 + np.exp(-min(max(r, -50), 50))) for r in revised]
        if max(abs(a - b) for a, b in zip(sure, before, strict=True)) < 1e-6:
            break
    return revised


def shares(prior, factor):
    """Return the probabilities of the shells."""
    both = [p * f for p, f in zip(prior, factor, strict=True)]
    return [b / sum(both) for b in both]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_revised_odds_are_those_of_counting_shell_by_shell(seed, known):
    rng = np.random.default_rng(seed)
    scores = rng.normal(6.0, 5.0, 12)
    radius = rng.choice([7000.0, 9500.0, 12000.0, 42000.0], 12)
    volume = rng.uniform(1e10, 1e12, (3, 3)) if known else np.full((3, 3), np.nan)
    of, set_of = chance(rng.uniform(1, 50), 1e12), rng.integers(0, 3, 12)
    set_of[0] = 2
    revised = revised_odds(scores, radius, SHELLS, set_of, volume, of)
    if not known:
        volume = np.full((3, 3), 1e12 / 3)
    expected = counted(scores, radius, set_of, volume, of.objects_km3)
    np.testing.assert_allclose(revised, expected, rtol=1e-9, atol=1e-9)
