"""Odds: which sensors should detect an object, and the score as an integral over space."""

import numpy as np
import pytest
from scenes.ten_tracklets import (
    LOWEST_KM,
    enter,
    in_field,
    point,
    points_of,
    range_km,
    residual,
    score,
    subsets,
    ten_tracklets,
    unit,
)

from epipole.tasks.algorithms.association import odds
from epipole.tasks.algorithms.association.odds import (
    blocked,
    in_view,
    looks_at,
    near_fields,
    nearest_range2,
    seeing,
    should_detect,
)
from epipole.tasks.algorithms.association.views import views_of
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

SHELLS = [(LOWEST_KM, 15000.0, 3.0), (14000.0, 30000.0, 0.5), (0.0, np.inf, 0.2)]
SCENES = [
    {},
    {"moving": True, "shells": SHELLS},
    {"times": (0.0, 12.0, 30.0), "seen": 0.7, "shells": SHELLS},
    {"times": (0.0, 15.0), "moving": True},
    {"magnitudes": True},
    {"magnitudes": True, "times": (0.0, 12.0, 30.0), "seen": 0.7, "blend_rad": np.radians(0.1)},
]


@pytest.mark.parametrize("seed", range(2))
def test_the_earth_blocks_a_line_of_which_a_part_is_inside_it(seed):
    rng, n_blocked = np.random.default_rng(seed), 0
    for _ in range(200):
        r, x = unit(rng.normal(size=(2, 3))) * rng.uniform(6500, 30000, (2, 1))
        radius = rng.uniform(5000.0, 6400.0)
        along = r + np.linspace(0, 1, 4001)[:, None] * (x - r)
        lowest = np.linalg.norm(along, axis=1).min()
        if abs(lowest - radius) > 10.0:
            assert blocked(r, x, radius) == (lowest < radius)
            n_blocked += lowest < radius
    assert 20 < n_blocked < 180
    up = np.array([0.0, 0.0, 7000.0])
    assert not blocked(up, 3 * up, EARTH_RADIUS_KM)  # away from the Earth
    assert not blocked(3 * up, up, EARTH_RADIUS_KM)  # towards it, but not as far
    assert blocked(3 * up, -up, EARTH_RADIUS_KM)


def some_unknown(scene):
    """Return samples and views of a scene in which a sensor's attitude is unknown at times."""
    R = scene.samples.R_sensor_from_icrs.copy()
    R[1, 0] = np.nan
    samples = scene.samples._replace(R_sensor_from_icrs=R)
    return samples, views_of(samples)[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_sees_what_is_in_its_field_and_not_behind_the_earth(seed):
    samples, views = some_unknown(ten_tracklets(seed, n_strays=1, times=(0.0, 20.0)))
    rng, n, n_seen = np.random.default_rng(seed), len(samples.half_field), 0
    for _ in range(400):
        s, m = rng.integers(n), rng.integers(2)
        R, r = samples.R_sensor_from_icrs[s, m], samples.sensor_km[s, m]
        side = rng.uniform(-1.1, 1.1, 2) * samples.half_field[s]
        toward = np.array([*side, rng.choice([1.0, 1.0, 1.0, -1.0])])
        x = r + rng.uniform(10.0, 60000.0) * (np.nan_to_num(R, nan=0.1).T @ toward)
        out = np.empty(n, np.bool_)
        seeing(
            samples.sensor_km[:, m], samples.R_sensor_from_icrs[:, m], samples.half_field, x, out
        )
        expected = [in_field(samples, o, m, x) for o in range(n)]
        assert out.tolist() == expected
        assert [in_view(views.camera[o, m], x) for o in range(n)] == expected
        n_seen += expected[s]
    assert 40 < n_seen < 360


@pytest.mark.parametrize("times", [(0.0,), (0.0, 12.0, 24.0)])
@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_misses_what_it_sees_throughout_and_not_much_farther_than_the_nearest(seed, times):
    scene = ten_tracklets(seed, n_sensors=6, n_strays=1, times=times, seen=0.6)
    samples, views = some_unknown(scene)
    rng, work = np.random.default_rng(seed), scene.work
    for k in range(2):
        members = rng.permutation(np.flatnonzero(scene.who == k))[:3]
        solved = points_of(samples, members)
        if solved is None or not solved[0]:
            continue
        enter(work, samples, members, solved[0])
        points, first = solved[0], min(solved[0])
        # Other positions of the points, so that sensors see them and do not.
        for m in points:
            work.points.x_km[m] += rng.normal(size=3) * rng.choice([0.0, 100.0])
            points[m] = (work.points.x_km[m].copy(), points[m][1])
        x, ranges = points[first][0], {}
        for i in members:
            if samples.seen[i, first]:
                ranges[i] = range_km(samples, samples.sensor[i], first, x)
        nearest2 = nearest_range2(views, members, work.points)
        assert nearest2 == pytest.approx(min(ranges.values()) ** 2)
        for s in range(6):
            sees = all(in_field(samples, s, m, at) for m, (at, _) in points.items())
            assert looks_at(views, s, work.points.x_km, work.points.seen_by) == sees
            rho = range_km(samples, s, first, x)
            for limit in (rho / 1.49, rho / 1.51, nearest2**0.5):
                expected = sees and rho <= 1.5 * limit
                assert should_detect(views, s, work.points, limit**2) == expected


def test_a_sensor_looks_at_nothing_where_no_instant_is_solved():
    scene = ten_tracklets(0, times=(0.0, 12.0))
    scene.work.points.seen_by[:] = 1
    assert not looks_at(scene.space.views, 0, scene.work.points.x_km, scene.work.points.seen_by)
    assert nearest_range2(scene.space.views, np.arange(3), scene.work.points) == np.inf


@pytest.mark.parametrize("seed", range(4))
def test_fields_within_six_sigma_of_a_point_are_near(seed):
    scene = ten_tracklets(seed, n_sensors=5, n_strays=1, times=(0.0, 20.0), seen=0.7)
    samples, views, points = scene.samples, scene.space.views, scene.work.points
    rng, n_near = np.random.default_rng(seed), 0
    for _ in range(60):
        spread = rng.choice([1.0, 30.0])
        for m in range(2):
            s = rng.integers(5)
            toward = samples.R_sensor_from_icrs[s, m].T @ [*rng.uniform(-0.1, 0.1, 2), 1.0]
            points.x_km[m] = samples.sensor_km[s, m] + rng.uniform(-1e3, 2e4) * toward
            points.cov_km2[m] = np.diag(rng.uniform(0.1, 2.0, 3)) * spread**2
            points.seen_by[m] = rng.choice([0, 2, 3])
        asked = rng.permutation(5)[: rng.integers(1, 6)]
        near = np.empty(5, np.int64)
        n = near_fields(views, points, asked, near)
        expected = [s for s in asked.tolist() if any(near_at(scene, s, m) for m in range(2))]
        assert near[:n].tolist() == expected
        n_near += n
        # No tracklet of a sensor that is left out is within six sigma.
        for i in range(len(scene.who)):
            for m in np.flatnonzero(points.seen_by >= 2):
                if samples.seen[i, m] and samples.sensor[i] in asked and beside(scene, i, m) < 5.9:
                    assert samples.sensor[i] in expected
    assert 15 < n_near < 285


def near_at(scene, s, m):
    """Return whether a point is within six sigma of the cone about a sensor's field."""
    points, views, samples = scene.work.points, scene.space.views, scene.samples
    if points.seen_by[m] < 2 or not samples.seen[samples.sensor == s, m].any():
        return False
    d = points.x_km[m] - samples.sensor_km[s, m]
    depth = views.plane[s, m, 2] @ d
    if depth <= 0:
        return False
    slack = 6 * np.sqrt(np.trace(points.cov_km2[m]))
    across = np.linalg.norm(d - depth * views.plane[s, m, 2])
    return across <= cone_of(scene, s, m) * depth + slack


def cone_of(scene, s, m):
    """Return the tangent of the cone about a sensor's plane that holds its tracklets and field."""
    views, samples = scene.space.views, scene.samples
    R, normal = samples.R_sensor_from_icrs[s, m], views.plane[s, m, 2]
    xy = views.sight[(samples.sensor == s) & samples.seen[:, m], m, :2]
    box = np.maximum(np.abs(xy.min(axis=0)), np.abs(xy.max(axis=0)))
    off = np.arccos(np.clip(R[2] @ normal, -1, 1))
    field = off + np.arctan(np.hypot(*samples.half_field[s]))
    return np.tan(max(np.arctan(np.hypot(*box)), field))


def beside(scene, i, m):
    """Return how far a point is from a tracklet's line of sight, in sigmas of the point."""
    points, samples = scene.work.points, scene.samples
    d = points.x_km[m] - samples.sensor_km[samples.sensor[i], m]
    if d @ samples.u[i, m] <= 0:
        return np.inf
    off = d - (d @ samples.u[i, m]) * samples.u[i, m]
    return np.linalg.norm(off) / np.sqrt(np.trace(points.cov_km2[m]))


def score_of(scene, members):
    """Return what the kernel says of members whose points are known, and the sensors missed."""
    enter(scene.work, scene.samples, members, points_of(scene.samples, members)[0])
    near = np.arange(len(scene.samples.half_field))
    total, _, n_missed = odds.score(scene.space, scene.work, np.array(members), near)
    return total, scene.work.missed[:n_missed].tolist()


@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(3))
def test_every_set_of_tracklets_that_may_be_one_object_has_the_odds_of_the_formula(seed, options):
    scene = ten_tracklets(seed, n_strays=seed % 2, n_sensors=4 - seed % 2, **options)
    compared = missed = 0
    for members in subsets(scene.samples, range(len(scene.who))):
        total, missing = score(scene, members)
        if np.isfinite(total):
            value = score_of(scene, members)
            assert value[0] == pytest.approx(total, abs=2e-3)
            assert value[1] == missing
            compared, missed = compared + 1, missed + len(missing)
    assert compared >= 3
    assert missed or seed


@pytest.mark.parametrize(
    ("seed", "sigma_km"),
    [(0, 0.0), (1, 0.0), (0, 0.05)],
)
def test_the_score_at_one_instant_is_an_integral_over_space(seed, sigma_km):
    """ln of: density of objects, times likelihood over that of unrelated directions, integrated."""
    scene = ten_tracklets(seed, n_strays=0, n_objects=1, sigma_km=sigma_km)
    samples, chance = scene.samples, scene.space.chance
    members = tuple(range(4))
    x, P, _ = point(samples, members, 0)
    axes = np.linalg.cholesky(P)
    step = np.linspace(-5, 5, 14)
    total = 0.0
    for offset in np.stack(np.meshgrid(step, step, step), axis=-1).reshape(-1, 3):
        log_ratio = 0.0
        for i in members:
            error, cov = residual(samples, i, 0, x + axes @ offset)
            log_ratio -= 0.5 * error @ np.linalg.solve(cov, error)
            log_ratio -= np.log(2 * np.pi * np.sqrt(np.linalg.det(cov)) * chance.density[i])
        total += np.exp(log_ratio)
    volume = np.linalg.det(axes) * (step[1] - step[0]) ** 3
    expected = np.log(chance.objects_km3 * total * volume) + np.log(chance.detected).sum()
    # All four sensors have a tracklet, so none misses the object.
    assert score_of(scene, members)[0] == pytest.approx(expected, abs=5e-3)


def test_shells_that_overlap_add_up_and_end_below_their_upper_edge():
    shells = np.array([(7000.0, 8000.0, 2.0), (7500.0, 9000.0, 3.0)])
    for radius, weight in [(7000, 2), (7499, 2), (7500, 5), (7999, 5), (8000, 3), (8999, 3)]:
        for axis in np.eye(3):
            assert odds._altitude_weight(radius * axis, shells) == pytest.approx(np.log(weight))
    assert odds._altitude_weight(np.array([0.0, 9000.0, 0.0]), shells) < -20.0
    assert odds._altitude_weight(np.array([0.0, 9000.0, 0.0]), shells[:0]) == 0.0


def test_lists_of_sensors_have_numbers_of_their_own():
    stamp = np.array([4, 0, 9])
    assert [odds.next_mark(stamp) for _ in range(3)] == [10, 11, 12]
    assert stamp.tolist() == [4, 0, 12]
