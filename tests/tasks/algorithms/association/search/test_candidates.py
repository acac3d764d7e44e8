"""Candidates: the best tracklet of a sensor is the best of all its tracklets, one by one."""

import numpy as np
import pytest
from scenes.ten_tracklets import (
    ARCSEC,
    GATE_SIGMA,
    blocked,
    clash,
    enter,
    gain_of,
    points_of,
    range_km,
    residual,
    scene_of,
    ten_tracklets,
)

from epipole.tasks.algorithms.association.search.candidates import (
    best_of_sensor,
    lasts_throughout,
    odds_of_view,
    other_group_near,
)
from epipole.tasks.algorithms.kernels import kernel

SCENES = [
    {"n_objects": 4},
    {"n_objects": 12, "spread_km": 0.4, "n_strays": 12},
    {"n_objects": 12, "spread_km": 0.4, "n_strays": 12, "moving": True},
    {"n_objects": 5, "spread_km": 0.5, "times": (0.0, 12.0, 30.0), "seen": 0.6},
    {"n_objects": 5, "spread_km": 0.5, "times": (0.0, 20.0), "seen": 0.7, "moving": True},
]


@kernel
def _best_of_sensor(space, work, s, same_sensor, min_gain):
    return best_of_sensor(space, work, s, same_sensor, min_gain)


def of_points(seed, options):
    """Yield scenes, the points of one object by some sensors, and one of the other sensors."""
    scene = ten_tracklets(seed, n_sensors=4, **options)
    samples = scene.samples
    for k in range(3):
        views = [i for i in np.flatnonzero(scene.who == k) if samples.sensor[i] < 3]
        for members in (views[:2], views):
            solved = points_of(samples, members)
            if solved is not None and solved[0]:
                enter(scene.work, samples, members, solved[0])
                yield scene, solved[0], 3


@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(4))
def test_the_best_and_the_second_best_are_those_of_all_tracklets(seed, options):
    rng = np.random.default_rng(seed)
    for scene, points, s in of_points(seed, options):
        samples = scene.samples
        all_of = np.flatnonzero(samples.sensor == s)
        for taken, same_sensor, min_gain in [
            ([], [], -5.0),
            (rng.choice(all_of, 2), [], 2.0),
            ([], rng.choice(all_of, 1), -5.0),
        ]:
            scene.space.taken[:] = False
            scene.space.taken[taken] = True
            free = [
                c for c in all_of
                if c not in taken and not any(clash(samples, c, o) for o in same_sensor)
            ]  # fmt: skip
            gains = sorted(((gain_of(scene, c, points), c) for c in free), reverse=True)
            gains = [(gain, c) for gain, c in gains if gain > min_gain] + 2 * [(min_gain, -1)]
            same_sensor = np.array(same_sensor, np.int64)
            best, gain, second = _best_of_sensor(scene.space, scene.work, s, same_sensor, min_gain)
            assert best == gains[0][1]
            assert gain == pytest.approx(gains[0][0], abs=2e-3)
            assert second == pytest.approx(gains[1][0], abs=2e-3)
        scene.space.taken[:] = False


def test_a_sensor_whose_position_is_vague_loses_no_tracklet():
    """Where a tracklet is not seen, its samples have another position error than where it is."""
    compared = 0
    for seed in range(20):
        options = {"n_objects": 3, "spread_km": 60.0, "times": (0.0, 20.0, 40.0), "seen": 0.6}
        exact = ten_tracklets(seed, n_sensors=4, n_strays=0, sigma_km=0.05, **options)
        samples = exact.samples
        vague_km = np.where(samples.seen, 30.0, 1.0)
        sigma_km = np.where(samples.sensor[:, None] == 3, vague_km, samples.sigma_km)
        samples = samples._replace(sigma_km=sigma_km)
        scene = scene_of(samples, exact.who, np.random.default_rng(seed))
        for k in range(3):
            views = [i for i in np.flatnonzero(scene.who == k) if samples.sensor[i] < 3]
            solved = points_of(samples, views)
            if solved is None or not solved[0]:
                continue
            enter(scene.work, samples, views, solved[0])
            of_sensor = np.flatnonzero(samples.sensor == 3)
            gains = [(gain_of(scene, c, solved[0]), c) for c in of_sensor]
            gain, want = max(gains, default=(-np.inf, -1))
            found = _best_of_sensor(scene.space, scene.work, 3, np.zeros(0, np.int64), -5.0)
            assert found[0] == (want if gain > -5.0 else -1)
            compared += 1
    assert compared > 50


@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(3))
def test_the_odds_of_any_view_are_those_of_the_formula_without_a_gate(seed, options):
    for scene, points, s in of_points(seed, options):
        for c in np.flatnonzero(scene.samples.sensor == s):
            shared = [m for m in points if scene.samples.seen[c, m]]
            expected = gain_of(scene, c, points, np.inf)
            far = expected < -1e3  # far from the points, planes and angles differ
            value = odds_of_view(scene.space, scene.work, s, c)
            assert value == pytest.approx(expected, rel=0.05 if far else 1e-3, abs=2e-3), shared


@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(4))
def test_another_group_is_found_wherever_one_of_its_tracklets_fits(seed, options):
    rng = np.random.default_rng(seed)
    n_found = 0
    for scene, points, s in of_points(seed, options):
        samples = scene.samples
        group = rng.integers(-1, 3, len(scene.who))
        for g in range(3):
            others = np.flatnonzero((samples.sensor == s) & (group >= 0) & (group != g))
            fits = any(np.isfinite(gain_of(scene, c, points)) for c in others)
            near = any(
                sigmas(samples, c, m, *points[m]) < 3 * GATE_SIGMA
                for c in others for m in points if samples.seen[c, m]
            )  # fmt: skip
            found = other_group_near(scene.space, scene.work, s, group, g)
            assert fits <= found <= near
            n_found += found
    assert n_found or seed


def sigmas(samples, c, m, x, P):
    """Return how far a tracklet is from a point, in sigmas of the widest tracklet there is."""
    error, _ = residual(samples, c, m, x)
    rho = range_km(samples, samples.sensor[c], m, x)
    variance = (4.1 * ARCSEC) ** 2 + (0.1**2 + np.trace(P)) / rho**2
    return np.linalg.norm(error) / np.sqrt(variance)


@pytest.mark.parametrize("seed", range(3))
def test_a_tracklet_fills_where_no_other_one_could_be_another_fragment(seed):
    scene = ten_tracklets(seed, n_objects=3, times=(0.0, 10.0, 20.0, 30.0), seen=0.6)
    views, samples = scene.space.views, scene.samples
    for solved in range(16):
        seen_by = np.array([2 * (solved >> m & 1) for m in range(4)])
        instants = np.flatnonzero(seen_by >= 2)
        for c in range(len(scene.who)):
            times = samples.time_s[instants]
            # Another fragment would have to be seen at one of these instants, before or after c.
            room = any(t < samples.start_s[c] or t > samples.end_s[c] for t in times)
            if not len(instants):
                assert not lasts_throughout(views, c, seen_by)
            elif lasts_throughout(views, c, seen_by):
                assert not room
            elif samples.seen[c, instants[[0, -1]]].all():
                raise AssertionError("it is seen from the first instant to the last")
            views.bounded[:] = False
            assert not lasts_throughout(views, c, seen_by)
            views.bounded[:] = True


def test_sensors_that_have_the_points_behind_them_have_no_candidate():
    scene = ten_tracklets(1)
    solved = points_of(scene.samples, np.flatnonzero(scene.who == 0)[:3])[0]
    behind = {0: (2 * scene.samples.sensor_km[3, 0] - solved[0][0], solved[0][1])}
    assert not blocked(scene.samples.sensor_km[3, 0], solved[0][0])
    enter(scene.work, scene.samples, np.flatnonzero(scene.who == 0)[:3], behind)
    found = _best_of_sensor(scene.space, scene.work, 3, np.zeros(0, np.int64), -50.0)
    assert found == (-1, -50.0, -50.0)
    assert not other_group_near(scene.space, scene.work, 3, np.zeros(len(scene.who), np.int64), 1)
