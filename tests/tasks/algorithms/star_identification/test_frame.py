"""One frame and its field."""

import numpy as np
import pytest
from scenes.random_stars import (
    BETA,
    CAMERA,
    MATCHING,
    angle_between,
    frame,
    optics,
    random_attitude,
    random_catalogue,
)

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.directions import aberrate
from epipole.tasks.algorithms.star_identification.frame import (
    N_PATTERN,
    N_SEARCHED,
    aberrate_all,
    field_of_view,
    identify_predicted,
    search_frame,
    search_lost,
    without_clusters,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    sky_grid,
    sky_to_limit,
)

CATALOGUE = random_catalogue()


def test_aberration_is_the_one_of_sky():
    got = aberrate_all(CATALOGUE.u_icrs, BETA)
    np.testing.assert_allclose(
        got, aberrate(CATALOGUE.u_icrs, BETA * SPEED_OF_LIGHT_KM_S), atol=1e-15
    )


def test_the_solid_angle_is_that_of_the_image():
    side = 2 * np.arctan(512 / 3660)
    assert optics(CAMERA).solid_angle_sr == pytest.approx(side**2, rel=0.03)


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("fold_px", [530.0, 563.0, 640.0, 700.0])
def test_the_field_of_a_lens_that_folds_before_the_corners_reaches_to_the_fold(fold_px, fisheye):
    # With k1 alone, the image of the fold is at two thirds of its ideal distance.
    k1 = -1 / (3 * (1.5 * fold_px / 900.0) ** 2)
    lens = Camera(1024, 1024, 900.0, 900.0, 511.5, 511.5, k1=k1, fisheye=fisheye)
    # All around, to the end of the image or just before the fold.
    turn = np.linspace(0, 2 * np.pi, 3000)
    to_edge = 511.9 / np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn)))
    r_px = np.minimum(to_edge, fold_px - 0.01)
    u = unproject(lens, 511.5 + r_px * np.cos(turn), 511.5 + r_px * np.sin(turn))
    field = field_of_view(lens)
    widest = np.arccos(u[:, 2].min())
    assert widest < field.half_diagonal_rad < widest + 0.005
    x, y = u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]
    np.testing.assert_allclose(field.box, [x.min(), x.max(), y.min(), y.max()], atol=0.02)


def test_only_the_brightest_centroids_are_searched():
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    seen, _ = frame(CATALOGUE, random_attitude(0), 0)
    rng = np.random.default_rng(0)
    more = frame(CATALOGUE, random_attitude(0), 0, n_false=3000)[0]
    # 3,000 false centroids, all fainter than the stars: most of them are not used.
    n = len(seen.u)
    crowded = more._replace(
        u=np.concatenate([seen.u, more.u[rng.permutation(len(more.u))[:3000]]]),
        sigma_rad=np.concatenate([seen.sigma_rad, np.full(3000, seen.sigma_rad[0])]),
        instrumental_mag=np.concatenate([seen.instrumental_mag, np.full(3000, -13.0)]),
    )
    assert n < N_SEARCHED
    assert search_lost(crowded, sky, grid, pairs, MATCHING).is_clear


def dense(seed, sigma_px, n_faint=2900):
    """Return a frame of stars, 15 hot pixels as bright as they, and points fainter than all."""
    seen = frame(CATALOGUE, random_attitude(seed), seed, sigma_px, n_false=15)[0]
    faint = frame(CATALOGUE, random_attitude(seed), 99 + seed, sigma_px, n_faint, missing=1.0)[0]
    return seen._replace(
        u=np.concatenate([seen.u, faint.u]),
        sigma_rad=np.concatenate([seen.sigma_rad, faint.sigma_rad]),
        instrumental_mag=np.concatenate([seen.instrumental_mag, faint.instrumental_mag + 4.0]),
    )


@pytest.mark.parametrize("sigma_px", [0.3, 2.0])
def test_a_dense_frame_is_identified_by_its_brightest_centroids(sigma_px):
    """Two or three thousand are no stars of the catalogue; with 2 px, they hide those that are."""
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.02), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    right = 0
    for seed in range(6):
        seen = dense(seed, sigma_px)
        found = search_frame(seen, sky, grid, pairs, MATCHING._replace(budget_s=0.4))
        if found.solution is None:
            continue
        off = angle_between(found.solution.R_sensor_from_icrs, random_attitude(seed))
        assert off < 3e-3
        assert len(found.solution.star) == len(seen.u)
        right += 1
    assert right == 6


def test_a_dense_frame_without_stars_is_refused():
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    for seed in range(3):
        seen = frame(CATALOGUE, random_attitude(seed), seed, 0.3, 3000, missing=1.0)[0]
        found = search_frame(seen, sky, grid, pairs, MATCHING._replace(budget_s=0.2))
        assert found.solution is None
        assert found.over_budget
        assert found.cost_s < 0.3


def test_few_stars_among_many_other_centroids_are_found():
    """Some 37 stars among 500 false points of the same brightness."""
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    found = {True: 0, False: 0}
    for seed in range(8):
        R = random_attitude(seed)
        seen = frame(CATALOGUE, R, seed, n_false=500)[0]
        for crowded in found:
            verdict = search_lost(seen, sky, grid, pairs, MATCHING._replace(crowded=crowded))
            if verdict.is_clear:
                assert angle_between(verdict.R_sensor_from_icrs, R) < 1e-3
                found[crowded] += 1
    assert found[True] >= 7
    assert found[False] <= 2


def test_many_centroids_without_any_star_are_refused():
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    for seed in range(8):
        seen = frame(CATALOGUE, random_attitude(seed), seed, n_false=300, missing=1.0)[0]
        assert not search_lost(seen, sky, grid, pairs, MATCHING).is_clear


def test_odds_of_stars_lower_the_threshold_of_a_search_within_limits():
    least = MATCHING.min_evidence_lost
    assert MATCHING._replace(starlit=2.0).min_evidence_lost == pytest.approx(least - 2.0)
    assert MATCHING._replace(starlit=-3.0).min_evidence_lost == least
    assert (
        MATCHING._replace(starlit=9.0).min_evidence_lost
        == MATCHING._replace(starlit=6.0).min_evidence_lost
    )


def test_a_frame_that_is_no_crowd_has_the_same_solution_in_one_call():
    sky = sky_to_limit(CATALOGUE, 99.0)
    grid, pairs = sky_grid(sky, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)
    solved = 0
    for seed in range(12):
        seen = frame(CATALOGUE, random_attitude(seed), seed, n_false=3, missing=0.1 * seed)[0]
        if not 3 <= len(seen.u) <= N_PATTERN:
            continue
        found = search_frame(seen, sky, grid, pairs, MATCHING).solution
        verdict = search_lost(seen, sky, grid, pairs, MATCHING)
        if not verdict.is_clear:
            assert found is None
            continue
        near = np.eye(3) * (2 * np.sort(seen.sigma_rad)[len(seen.u) // 2]) ** 2
        R = verdict.R_sensor_from_icrs
        for one, other in zip(
            found, identify_predicted(seen, sky, R, near, MATCHING, lost=True), strict=True
        ):
            np.testing.assert_array_equal(one, other)
        solved += 1
    assert solved > 4


BOX = np.array([-0.1, 0.1, -0.1, 0.1])


def directions(x, y):
    u = np.stack([x, y, np.ones_like(x)], axis=-1)
    return u / np.linalg.norm(u, axis=-1, keepdims=True)


def test_of_a_cluster_the_brightest_few_are_kept_and_all_that_is_elsewhere():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.1, 0.1, (2, 30))
    cluster = rng.normal(0.0625, 0.003, (2, 200))
    mixed = rng.permutation(230)
    u = directions(np.append(x, cluster[0]), np.append(y, cluster[1]))[mixed]
    kept = without_clusters(u, BOX)
    assert np.isin(np.flatnonzero(mixed < 30), kept).mean() > 0.9
    assert (mixed[kept] >= 30).sum() <= 16
    first_of_cluster = np.flatnonzero(mixed >= 30)[0]
    assert first_of_cluster in kept


def test_a_crowd_that_is_everywhere_is_no_cluster():
    u = directions(*np.random.default_rng(1).uniform(-0.1, 0.1, (2, 900)))
    assert len(without_clusters(u, BOX)) == 900


def test_few_none_and_those_outside_are_kept():
    assert len(without_clusters(np.empty((0, 3)), BOX)) == 0
    assert without_clusters(
        directions(np.array([0.0, 5.0]), np.array([0.0, -9.0])), BOX
    ).tolist() == [0, 1]
