"""Seeds: the pairs that sorting one angle finds are those that trying all pairs finds."""

import numpy as np
import pytest
from scenes.ten_tracklets import (
    GATE_SIGMA,
    point,
    possible,
    quantile,
    scene_of,
    ten_tracklets,
)

from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.association.search.seeds import seeds_between
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis

SCENES = [
    {"n_objects": 6, "spread_km": 40.0},
    {"n_objects": 10, "spread_km": 2.0, "moving": True},
    {"n_objects": 6, "spread_km": 5.0, "times": (0.0, 10.0, 25.0), "seen": 0.6},
    {"n_objects": 6, "spread_km": 3.0, "times": (0.0, 20.0), "seen": 0.7, "moving": True},
]


def of_all_pairs(scene, a, b, gate_sigma):
    """Return pairs (i, j) of two sensors that meet, and those that are on the verge of it.

    Two views have one degree of freedom: the chi-square of their point is their gap's.
    """
    samples, sure, verge = scene.samples, set(), set()
    for i in np.flatnonzero((samples.sensor == a) & ~scene.space.taken).tolist():
        for j in np.flatnonzero((samples.sensor == b) & ~scene.space.taken).tolist():
            shared = np.flatnonzero(samples.seen[i] & samples.seen[j])
            points = [point(samples, (i, j), m) for m in shared]
            if not len(shared) or any(p is None for p in points):
                continue
            where = {m: p[:2] for m, p in zip(shared.tolist(), points, strict=True)}
            if not possible(samples, (i, j), where):
                continue
            excess = sum(p[2] for p in points) / quantile(len(shared), gate_sigma)
            if excess < 0.97:
                sure.add((i, j))
            elif excess < 1.03:
                verge.add((i, j))
    return sure, verge


@pytest.mark.parametrize("gate_sigma", [1.0, GATE_SIGMA])
@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(2))
def test_seeds_are_all_pairs_whose_lines_meet(seed, options, gate_sigma):
    scene = ten_tracklets(seed, n_sensors=3, **options)
    rng, meeting = np.random.default_rng(seed), 0
    for a, b in [(0, 1), (2, 0), (1, 2)]:
        scene.space.taken[:] = rng.random(len(scene.who)) < 0.2
        sure, verge = of_all_pairs(scene, a, b, gate_sigma)
        seeds = list(map(tuple, seeds_between(scene.space, a, b, gate_sigma).tolist()))
        assert len(set(seeds)) == len(seeds)
        assert sure <= set(seeds) <= sure | verge
        meeting += len(sure)
    assert meeting > 3 or gate_sigma == 1.0


PRECISE = {"n_objects": 10, "spread_km": 0.3, "sigma_km": 0.0005}  # positions of sensors


@pytest.mark.parametrize("gate_sigma", [1.0, GATE_SIGMA])
def test_angles_of_precise_sensors_leave_out_no_pair_whose_lines_meet(gate_sigma):
    for seed in range(3):
        scene = ten_tracklets(seed, n_sensors=3, **PRECISE)
        for a, b in [(0, 1), (2, 0), (1, 2)]:
            sure, _ = of_all_pairs(scene, a, b, gate_sigma)
            seeds = seeds_between(scene.space, a, b, gate_sigma)
            assert sure <= set(map(tuple, seeds.tolist()))


def astride_the_baseline(n):
    """Return a scene of two sensors, one in the other's field: n objects on the far side of the
    baseline, opposite the middle of the field, and twice as many around that."""
    rng = np.random.default_rng(1)
    toward, side = np.array([0.8, 0.6, 0.0]), np.array([[-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    r = np.array([7000.0, 0.0, 0.0]) + np.array([[0.0], [500.0]]) * toward
    far = np.pi + rng.uniform(-3e-3, 3e-3, n)
    near = rng.uniform(-0.3, 0.3, n)
    turn = np.concatenate([far, near, -near])
    off = np.radians(np.append(rng.uniform(1.0, 3.0, n), rng.uniform(6.0, 12.0, 2 * n)))[:, None]
    u = np.cos(off) * toward + np.sin(off) * (np.column_stack([np.cos(turn), np.sin(turn)]) @ side)
    x = r[0] + rng.uniform(2000.0, 4000.0, 3 * n)[:, None] * u
    u = np.concatenate([x - each for each in r])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    t, sigma = len(u), 4 * ARCSEC
    u += np.einsum("na,nai->ni", rng.normal(0.0, sigma, (t, 2)), tangent_basis(u))
    samples = Samples(
        sensor=np.repeat([0, 1], 3 * n), start_s=np.zeros(t), end_s=np.zeros(t),
        seen=np.ones((t, 1), bool), u=(u / np.linalg.norm(u, axis=1, keepdims=True))[:, None],
        cov=np.tile(np.eye(2) * sigma**2, (t, 1, 1, 1)), sigma_km=np.full((t, 1), 0.001),
        time_s=np.zeros(1), sensor_km=r[:, None],
        R_sensor_from_icrs=np.full((2, 1, 3, 3), np.nan), half_field=np.full((2, 2), 0.3),
    )  # fmt: skip
    return scene_of(samples, np.tile(np.arange(3 * n), 2), rng)


def test_angles_on_both_sides_of_half_a_turn_are_neighbours():
    scene = astride_the_baseline(20)
    for a, b in [(0, 1), (1, 0)]:
        sure, verge = of_all_pairs(scene, a, b, GATE_SIGMA)
        same = {(i, j) for i, j in sure if scene.who[i] == scene.who[j]}
        assert len(same) >= 55
        seeds = list(map(tuple, seeds_between(scene.space, a, b, GATE_SIGMA).tolist()))
        assert len(set(seeds)) == len(seeds)
        assert sure <= set(seeds) <= sure | verge


def test_sensors_at_one_position_have_no_seeds():
    scene = ten_tracklets(3, n_sensors=2)
    assert len(seeds_between(scene.space, 0, 1, GATE_SIGMA)) >= 2
    scene.space.views.camera[1, :, :3] = scene.space.views.camera[0, :, :3] + 0.5
    assert len(seeds_between(scene.space, 0, 1, GATE_SIGMA)) == 0
    scene.space.views.camera[1, :, :3] = np.nan
    assert len(seeds_between(scene.space, 0, 1, GATE_SIGMA)) == 0


@pytest.mark.parametrize("times", [(0.0,), (0.0, 10.0)])
def test_many_seeds_have_room(times):
    """All tracklets of both sensors are one object's: every pair meets."""
    scene = ten_tracklets(5, n_sensors=2, n_objects=25, n_strays=0, spread_km=1e-3, times=times)
    seeds = seeds_between(scene.space, 0, 1, 6.0)
    assert len(np.unique(seeds, axis=0)) == len(seeds) == 625


def test_a_field_along_the_baseline_has_seeds():
    """The angle about the baseline has no natural beginning there."""
    for seed in range(10):
        scene = ten_tracklets(seed, n_sensors=2, n_strays=0, n_objects=3, spread_km=30.0)
        camera = scene.space.views.camera
        along = camera[0, 0, 9:12]
        sure, verge = of_all_pairs(scene, 0, 1, GATE_SIGMA)
        seeds = seeds_between(scene.space, 0, 1, GATE_SIGMA)
        assert sure <= set(map(tuple, seeds.tolist())) <= sure | verge
        # The second sensor behind the first one, on the line of its first tracklet.
        samples = scene.samples._replace(
            sensor_km=np.stack([scene.samples.sensor_km[0],
                                scene.samples.sensor_km[0] - 500.0 * along]),
        )  # fmt: skip
        r = samples.sensor_km[:, 0]
        away = scene.samples.u[0, 0] * 9000.0 + np.random.default_rng(seed).normal(size=3) * 200.0
        u = samples.u.copy()
        for i in range(len(scene.who)):
            d = r[0] + (scene.who[i] + 1) * away - r[samples.sensor[i]]
            u[i, 0] = d / np.linalg.norm(d)
        moved = scene_of(samples._replace(u=u), scene.who, np.random.default_rng(0))
        sure, verge = of_all_pairs(moved, 0, 1, GATE_SIGMA)
        seeds = set(map(tuple, seeds_between(moved.space, 0, 1, GATE_SIGMA).tolist()))
        assert sure <= seeds <= sure | verge
