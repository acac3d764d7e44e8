"""Object density: volumes against points at random, revised odds against plain counting."""

import numpy as np
import pytest
from scenes.ten_tracklets import ten_tracklets, unit

from epipole.tasks.algorithms.association.chance import Chance, revised_odds, visible_volume
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

SHELLS = np.array([(0.0, 10000.0, 1.0), (9000.0, 16000.0, 2.5), (16000.0, np.inf, 0.7)])


@pytest.mark.parametrize(("seed", "n_sensors"), [(0, 3), (1, 4), (2, 6), (3, 130)])
def test_the_volume_is_that_of_random_points_that_two_sensors_see(seed, n_sensors):
    scene = ten_tracklets(seed, n_sensors=n_sensors, n_objects=1, n_strays=0)
    rng, samples, farthest = np.random.default_rng(seed), scene.samples, 2e4
    points, expected = 40000 // n_sensors, np.zeros(3)
    for s in range(n_sensors):
        wide = samples.half_field[s]
        side = rng.uniform(-1, 1, (points, 2)) * wide
        toward = np.column_stack([side, np.ones(points)])
        # Uniform on the plane: a point stands for 1 / stretch^3 of the solid angle.
        stretch = np.linalg.norm(toward, axis=1)
        rho = farthest * rng.random(points) ** (1 / 3)
        x = samples.sensor_km[s, 0] + rho[:, None] * (
            unit(toward) @ samples.R_sensor_from_icrs[s, 0]
        )
        part = 4 * wide.prod() / stretch**3 * farthest**3 / 3 / points
        count = sum(sees(samples, o, x).astype(int) for o in range(n_sensors))
        part = np.where(count >= 2, part / np.maximum(count, 1), 0.0)
        radius = np.linalg.norm(x, axis=1)
        for j, (low, high, weight) in enumerate(SHELLS):
            expected[j] += weight * part[(radius >= low) & (radius < high)].sum()
    volume = visible_volume(scene.space.views, SHELLS, farthest)
    np.testing.assert_allclose(volume, expected, rtol=0.2, atol=0.02 * expected.sum())
    assert volume.sum() == pytest.approx(expected.sum(), rel=0.15)


def sees(samples, s, x):
    """Return which of the points a sensor sees, as `ten_tracklets.in_field` for many points."""
    r, R = samples.sensor_km[s, 0], samples.R_sensor_from_icrs[s, 0]
    d = x - r
    here = d @ R.T
    inside = (np.abs(here[:, :2]) <= 0.98 * samples.half_field[s] * here[:, 2:]).all(axis=1)
    part = np.clip(-(d @ r) / np.sum(d * d, axis=1), 0, 1)
    return inside & (np.linalg.norm(r + part[:, None] * d, axis=1) >= EARTH_RADIUS_KM)


def test_one_sensor_alone_has_no_volume_in_view():
    scene = ten_tracklets(0, n_sensors=3)
    camera = scene.space.views.camera.copy()
    camera[:2, :, 12:21] = np.nan
    assert not visible_volume(scene.space.views._replace(camera=camera), SHELLS, 2e4).any()


def chance(objects, volume):
    nothing = np.zeros(0)
    return Chance(nothing, nothing, nothing, objects, objects / volume, nothing)


def counted(scores, radius, shells, volume, assumed_km3):
    """Return the revised odds: shell by shell, group by group, to the same fixed point."""
    n, n_shells = len(scores), len(shells)
    expected = [assumed_km3 * volume[j] + 1e-9 for j in range(n_shells)]
    prior = [
        [1e-9 + (w if lo <= radius[g] < hi else 0.0) for lo, hi, w in shells] for g in range(n)
    ]
    sure, revised = [float(s > 8.0) for s in scores], list(scores)
    for _ in range(100):
        common = max(sum(sure), 0.5) / sum(expected)
        factor = [common] * n_shells
        for _ in range(10):
            counts = [0.0] * n_shells
            for g in range(n):
                total = sum(p * f for p, f in zip(prior[g], factor, strict=True))
                for j in range(n_shells):
                    counts[j] += sure[g] * prior[g][j] * factor[j] / total
            factor = [
                common * min((counts[j] + 1.0) / (common * expected[j] + 1.0), 10.0)
                for j in range(n_shells)
            ]
        before = sure
        revised = [
            scores[g] + np.log(
                sum(p * f for p, f in zip(prior[g], factor, strict=True)) / sum(prior[g])
            )
            for g in range(n)
        ]  # fmt: skip
        sure = [1 / (1 + np.exp(-min(max(r, -50), 50))) for r in revised]
        if max(abs(a - b) for a, b in zip(sure, before, strict=True)) < 1e-6:
            break
    return revised


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_revised_odds_are_those_of_counting_shell_by_shell(seed, known):
    rng = np.random.default_rng(seed)
    scores = rng.normal(6.0, 5.0, 12)
    radius = rng.choice([7000.0, 9500.0, 12000.0, 42000.0], 12)
    volume = rng.uniform(1e10, 1e12, 3) if known else np.zeros(3)
    of = chance(rng.uniform(1, 50), 1e12)
    revised = revised_odds(scores, radius, SHELLS, volume, of)
    if not known:
        volume = np.full(3, 1e12)
    expected = counted(scores, radius, SHELLS, volume, of.objects_km3)
    np.testing.assert_allclose(revised, expected, rtol=1e-9, atol=1e-9)
