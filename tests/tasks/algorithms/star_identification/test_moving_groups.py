"""Stars in a crowd are told from satellites by their motion."""

import numpy as np
from scenes.random_stars import (
    BETA,
    CAMERA,
    MATCHING,
    SEEN,
    SKIES,
    angle_between,
    optics,
    random_attitude,
)
from scenes.random_stars import frame as star_frame
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry.camera import pixel_angle, unproject
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.moving_groups import groups_that_move
from epipole.tasks.algorithms.star_identification.sensor import identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import no_priors

PIXEL_RAD = 1.0 / CAMERA.fx_px
SIGMA_PX = 0.1


def _directions(rng, n):
    return unproject(CAMERA, *rng.uniform(0, CAMERA.width - 1, (2, n)))


def _moved(u, turn, rng):
    return Rotation.from_rotvec(turn).apply(u) + rng.normal(0, SIGMA_PX * PIXEL_RAD, u.shape)


def test_two_groups_with_rotations_of_their_own_are_told_apart():
    rng = np.random.default_rng(0)
    crowd, stars, strays = _directions(rng, 50), _directions(rng, 7), _directions(rng, 10)
    u = np.concatenate([crowd, stars, strays])
    v = np.concatenate([
        _moved(crowd, np.array([0, 0, 0.01]), rng),
        _moved(stars, np.array([0.01, 0.004, 0.02]), rng),
        _directions(rng, 10),
    ])  # fmt: skip
    order = rng.permutation(len(v))
    found = list(groups_that_move(u, v[order], 0.03, PIXEL_RAD))
    assert [set(group) for group in found] == [set(range(50)), set(range(50, 57))]


def test_random_points_are_hardly_ever_a_group():
    rng = np.random.default_rng(1)
    pairs = [(_directions(rng, 60), _directions(rng, 60)) for _ in range(40)]
    found = [list(groups_that_move(u, v, 0.02, PIXEL_RAD)) for u, v in pairs]
    assert sum(len(groups) > 0 for groups in found) <= 4


def _crowded_frames(n_frames, n_satellites, n_stars, seed):
    """Return frames, one a second, of satellites that the sensor follows and a few stars that move
    through them, and the attitudes."""
    rng = np.random.default_rng(seed)
    R0, still = random_attitude(seed), rng.uniform(20, CAMERA.width - 20, (2, n_satellites))
    u, attitudes = [], []
    for k in range(n_frames):
        R = Rotation.from_rotvec([2e-4 * k, -1e-4 * k, 1e-4 * k]).as_matrix() @ R0
        stars = star_frame(SEEN, R, k, SIGMA_PX)[0].u[:n_stars]
        drift = still + rng.normal(0, SIGMA_PX, still.shape) + 0.02 * k
        seen = np.concatenate([stars, unproject(CAMERA, *drift)])
        u.append(rng.permutation(seen))
        attitudes.append(R)
    counts = [len(each) for each in u]
    u = np.concatenate(u)
    centroids = RawCentroids(
        np.concatenate([[0], np.cumsum(counts)]), u, pixel_angle(CAMERA, u),
        np.full(len(u), SIGMA_PX), np.full(len(u), np.nan), np.tile(BETA, (n_frames, 1)),
        [optics()], np.zeros(n_frames, np.int64),
    )  # fmt: skip
    return centroids, attitudes


def _identify(centroids):
    n = len(centroids.beta)
    return identify_sensor(np.arange(n) * 1.0, centroids, no_priors(n), SKIES, None, MATCHING)


def test_six_stars_that_move_through_sixty_satellites_are_identified():
    centroids, attitudes = _crowded_frames(40, n_satellites=60, n_stars=6, seed=2)
    solutions = _identify(centroids).solutions
    assert solutions.solved.sum() >= 36
    for k in np.flatnonzero(solutions.solved):
        assert angle_between(solutions.R_sensor_from_icrs[k], attitudes[k]) < 1e-3


def test_groups_of_satellites_are_no_stars():
    """Each frame has two crowds that move through each other."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        frames = [_directions(rng, 45), _directions(rng, 8)]
        turns = [(np.zeros(3), np.full(3, 3e-4 * k)) for k in range(25)]
        u = np.concatenate(
            [_moved(f, t, rng) for turn in turns for f, t in zip(frames, turn, strict=True)]
        )
        centroids = RawCentroids(
            np.arange(26) * 53, u, pixel_angle(CAMERA, u), np.full(len(u), SIGMA_PX),
            np.full(len(u), np.nan), np.tile(BETA, (25, 1)), [optics()], np.zeros(25, np.int64),
        )  # fmt: skip
        assert not _identify(centroids).solutions.solved.any()
