"""Identification near a known attitude."""

import itertools
import time

import numpy as np
import pytest
from scenes.random_stars import (
    BETA,
    MATCHING,
    angle_between,
    frame,
    random_attitude,
    random_catalogue,
)
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry.directions import aberrate
from epipole.tasks.algorithms.star_identification.frame import identify_predicted
from epipole.tasks.algorithms.star_identification.search.match_stars import (
    Centroids,
    Matches,
    aberrated,
    best_nudge,
    count_in_view,
    match_stars,
    stars_in_cone,
)
from epipole.tasks.algorithms.star_identification.star_grid import sky_to_limit

ARCSEC = np.pi / 648000
CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 99.0)


def _match(u, v, radius=0.1, sigma=0.01, strict=True):
    u, v = np.array(u, float), np.array(v, float)
    matches = Matches(np.empty(len(u), np.int64), np.zeros(len(u)))
    work = np.empty(len(v), np.int64), np.empty(len(v), np.bool_)
    match_stars(u, np.full(len(u), sigma), v, np.full(len(u), radius), matches, strict, *work)
    return matches.star.tolist()


def test_each_centroid_gets_the_nearest_star_within_reach():
    assert _match([[0.0, 0, 1], [0.5, 0, 1]], [[0.5, 0.01, 1], [0.01, 0, 1], [0.3, 0, 1]]) == [1, 0]


def test_a_centroid_between_two_stars_is_neither():
    stars = [[0.01, 0, 1], [-0.011, 0, 1]]
    assert _match([[0.0, 0, 1]], stars) == [-1]
    assert _match([[0.0, 0, 1]], stars, strict=False) == [0]


def test_a_star_between_two_centroids_is_neither_unless_one_is_clearly_nearer():
    assert _match([[0.01, 0, 1], [-0.012, 0, 1]], [[0.0, 0, 1]]) == [-1, -1]
    assert _match([[0.001, 0, 1], [-0.05, 0, 1]], [[0.0, 0, 1]]) == [0, -1]
    assert _match([[-0.05, 0, 1], [0.001, 0, 1]], [[0.0, 0, 1]]) == [-1, 0]


@pytest.mark.parametrize("order", itertools.permutations(range(3)))
def test_a_star_is_its_clearly_nearest_centroids_whichever_came_first(order):
    # 0, 3 and 3.2 sigmas off: the two others contest the star, until the first one comes.
    off = [[0.0, 0, 1], [0.03, 0, 1], [-0.032, 0, 1]]
    assert _match([off[k] for k in order], [[0.0, 0, 1]]) == [-1 if k else 0 for k in order]


def test_compiled_aberration_is_the_one_of_sky():
    out = np.empty(3)
    u = CATALOGUE.u_icrs[0]
    aberrated(*u, BETA, out)
    np.testing.assert_allclose(out, aberrate(u, BETA * 299792.458), atol=1e-15)


def test_the_cone_holds_the_stars_around_the_boresight():
    R, row = random_attitude(1), np.empty(6000, np.int64)
    n = stars_in_cone(CATALOGUE.u_icrs, 6000, R, 0.2, row)
    near = np.arccos(np.clip(CATALOGUE.u_icrs @ R[2], -1, 1)) < 0.2
    np.testing.assert_array_equal(row[:n], np.flatnonzero(near))


def test_only_stars_in_the_image_are_in_view():
    v = np.array([[0.0, 0, 1], [0.2, 0, 1], [0.05, 0.05, 1], [0.0, 0, -1]])
    assert count_in_view(v, np.array([-0.1, 0.1, -0.1, 0.1])) == 2


def _prediction(R, sigma, seed):
    phi = np.random.default_rng(seed).normal(0, sigma, 3)
    return Rotation.from_rotvec(phi).as_matrix() @ R, np.eye(3) * sigma**2


@pytest.mark.parametrize("sigma_arcsec", [20.0, 300.0, 2000.0])
def test_a_prediction_is_refined_to_the_truth_however_wide(sigma_arcsec):
    # 2000" are 35 px, wider than stars and false points are apart.
    for seed in range(15):
        R = random_attitude(seed)
        seen, true = frame(CATALOGUE, R, seed, n_false=15, missing=0.1)
        found = identify_predicted(
            seen, SKY, *_prediction(R, sigma_arcsec * ARCSEC, seed), MATCHING
        )
        assert found is not None
        assert angle_between(found.R_sensor_from_icrs, R) < 200 * ARCSEC
        claimed = found.star >= 0
        assert np.all(found.star[claimed] == true[claimed])
        assert claimed.sum() >= 0.9 * (true >= 0).sum()


def test_a_wrong_prediction_is_not_believed():
    for seed in range(30):
        seen, _ = frame(CATALOGUE, random_attitude(seed), seed, n_false=15)
        elsewhere = random_attitude(seed + 1000)
        assert (
            identify_predicted(seen, SKY, elsewhere, np.eye(3) * (60 * ARCSEC) ** 2, MATCHING)
            is None
        )


def test_errors_of_the_attitude_are_honest():
    # With matching and its gate in the loop: a gate of 3.7 sigma cuts 1 in 1,000 only.
    normalised, nees = [], []
    for seed in range(600):
        R = random_attitude(seed)
        seen, _ = frame(CATALOGUE, R, seed, n_false=3)
        found = identify_predicted(seen, SKY, R, np.eye(3) * (30 * ARCSEC) ** 2, MATCHING)
        phi = Rotation.from_matrix(R @ found.R_sensor_from_icrs.T).as_rotvec()
        normalised.append(phi / np.sqrt(np.diag(found.cov_rad2)))
        nees.append(phi @ np.linalg.solve(found.cov_rad2, phi))
    # Standard deviation of 600 values: its own sigma is 0.029.
    np.testing.assert_allclose(np.std(normalised, axis=0), 1.0, atol=0.09)
    assert abs(np.mean(nees) - 3) < 0.3


def test_two_centroids_are_too_few():
    seen, _ = frame(CATALOGUE, random_attitude(0), 0)
    two = seen._replace(
        u=seen.u[:2], sigma_rad=seen.sigma_rad[:2], instrumental_mag=seen.instrumental_mag[:2]
    )
    assert identify_predicted(two, SKY, random_attitude(0), np.eye(3) * 1e-8, MATCHING) is None


def test_centroids_all_on_one_spot_give_no_attitude():
    seen, _ = frame(CATALOGUE, random_attitude(0), 0)
    spot = seen._replace(u=np.repeat(seen.u[:1], len(seen.u), axis=0))
    assert identify_predicted(spot, SKY, random_attitude(0), np.eye(3) * 1e-8, MATCHING) is None


def test_the_search_of_a_wide_prediction_ends_in_a_crowded_sky():
    """A thousand million distances and more would be compared, for some 10 s."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(3000, 3)) * [0.1, 0.1, 0.0] + [0.0, 0.0, 1.0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    sigma = np.full(200, 1e-5)
    centroids = Centroids(u[:200], sigma, np.zeros(200), np.zeros(3))
    best_nudge(np.eye(3), 1e-3, 1e-3, centroids, u[:10], 3.7, np.empty((3, 3)))  # compiles
    started = time.process_time()
    best_nudge(np.eye(3), 0.3, 0.3, centroids, u, 3.7, np.empty((3, 3)))
    assert time.process_time() - started < 2.0
