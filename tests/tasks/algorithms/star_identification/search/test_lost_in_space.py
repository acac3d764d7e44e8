"""Identification without a prior."""

import numpy as np
import pytest
from scenes.random_stars import MATCHING, angle_between, frame, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frame import (
    problem_of,
    search_frame,
    search_lost,
)
from epipole.tasks.algorithms.star_identification.search.lost_in_space import try_brightest
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    is_clear,
    keep,
    make_scratch,
    no_attitude,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

ARCSEC = np.pi / 648000
CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 99.0)


@pytest.fixture(scope="module")
def pairs():
    optics = frame(CATALOGUE, np.eye(3), 0)[0].optics
    n = pattern_size(SKY, optics.solid_angle_sr)
    return pattern_pairs(CATALOGUE.u_icrs[:n], 2 * optics.half_diagonal_rad)


@pytest.fixture(scope="module")
def grid():
    return sky_grid(SKY, 0.005)


@pytest.mark.parametrize(
    ("sigma_px", "n_false", "missing", "flux"),
    [(0.3, 0, 0.0, True), (0.3, 0, 0.0, False), (1.0, 10, 0.2, True), (0.3, 30, 0.3, True)],
)
def test_any_attitude_is_found(sigma_px, n_false, missing, flux, grid, pairs):
    for seed in range(20):
        R = random_attitude(seed)
        seen, true = frame(CATALOGUE, R, seed, sigma_px, n_false, missing, flux)
        found = search_frame(seen, SKY, grid, pairs, MATCHING).solution
        assert found is not None
        assert angle_between(found.R_sensor_from_icrs, R) < 1200 * ARCSEC * sigma_px
        claimed = found.star >= 0
        assert np.mean(found.star[claimed] == true[claimed]) > 0.97


def by_the_brightest(seen, grid, pairs):
    """Return whether pairs of the brightest centroids give a clear attitude, which, and the
    work."""
    problem = problem_of(seen, SKY, grid, pairs, MATCHING, crowded=False)
    best, n = no_attitude(np.zeros((3, 3))), len(seen.u)
    work = try_brightest(problem, make_scratch(n, min(n, 64)), best)
    return is_clear(best, problem.rule), best.R, work


def test_in_most_frames_pairs_of_the_brightest_centroids_are_enough(grid, pairs):
    found = 0
    for seed in range(40):
        R = random_attitude(seed)
        seen, _ = frame(CATALOGUE, R, seed, 0.5, 3, 0.1)
        clear, R_best, _ = by_the_brightest(seen, grid, pairs)
        found += clear
        assert not clear or angle_between(R_best, R) < 1e-3
    assert found > 30


def test_without_brightness_no_pair_is_tried_for_being_bright(grid, pairs):
    seen, _ = frame(CATALOGUE, random_attitude(0), 0, 0.5, 0, 0.0, False)
    assert by_the_brightest(seen, grid, pairs)[::2] == (False, 0)


def test_a_search_goes_on_where_most_matches_are_in_one_place(grid, pairs):
    """In a cluster of stars, a wrong attitude may match many of them, and little else."""
    seen, _ = frame(CATALOGUE, random_attitude(0), 0, 0.3)
    problem = problem_of(seen, SKY, grid, pairs, MATCHING, crowded=False)
    n = len(seen.u)
    by_distance = np.argsort(np.linalg.norm(seen.u - seen.u[0], axis=1))
    side = problem.image.box[1] - problem.image.box[0]
    n_near = int(np.sum(np.linalg.norm(seen.u - seen.u[0], axis=1) < 0.1 * side))
    for matched, clear in ((by_distance[: 2 * n_near - 1], False), (np.arange(n), True)):
        room, best = make_scratch(n, min(n, 64)), no_attitude(np.zeros((3, 3)))
        room.row_of[matched] = np.arange(len(matched))
        room.R[:] = np.eye(3)
        keep(100.0, problem, room, best)
        assert is_clear(best, problem.rule) == clear


def test_frames_without_stars_are_refused(grid, pairs):
    rng = np.random.default_rng(0)
    for seed in range(20):
        seen, _ = frame(CATALOGUE, random_attitude(seed), seed, 0.5, int(rng.integers(3, 15)), 1.0)
        found = search_frame(seen, SKY, grid, pairs, MATCHING).solution
        assert found is None


def test_the_search_gives_the_same_bits_again(grid, pairs):
    seen, _ = frame(CATALOGUE, random_attitude(5), 5, 1.0, 10, 0.2)
    first, second = (search_lost(seen, SKY, grid, pairs, MATCHING) for _ in range(2))
    assert first.evidence == second.evidence
    np.testing.assert_array_equal(first.R_sensor_from_icrs, second.R_sensor_from_icrs)


def test_a_search_ends_when_its_bound_is_reached(grid, pairs):
    seen, _ = frame(CATALOGUE, random_attitude(0), 0, 1.0, 60, 1.0)
    verdict = search_lost(seen, SKY, grid, pairs, MATCHING._replace(time_limit_s=1e-3))
    assert verdict.exhausted
    assert not verdict.is_clear


def test_centroids_all_on_one_spot_are_refused(grid, pairs):
    seen, _ = frame(CATALOGUE, random_attitude(0), 0)
    spot = seen._replace(u=np.repeat(seen.u[:1], len(seen.u), axis=0))
    assert search_frame(spot, SKY, grid, pairs, MATCHING)[:2] == (None, False)


def test_a_handful_of_centroids_is_never_answered_wrongly(grid, pairs):
    for seed in range(40):
        R = random_attitude(seed)
        seen, _ = frame(CATALOGUE, R, seed, 0.3)
        few = seen._replace(
            u=seen.u[:4], sigma_rad=seen.sigma_rad[:4], instrumental_mag=seen.instrumental_mag[:4]
        )
        found = search_frame(few, SKY, grid, pairs, MATCHING).solution
        assert found is None or angle_between(found.R_sensor_from_icrs, R) < 0.01


def test_a_place_that_is_none_is_left_aside(grid, pairs):
    seen, _ = frame(CATALOGUE, random_attitude(3), 3)
    seen.u[[1, 4]] = np.nan
    found = search_frame(seen, SKY, grid, pairs, MATCHING).solution
    assert angle_between(found.R_sensor_from_icrs, random_attitude(3)) < 1200 * ARCSEC
    assert np.all(found.star[[1, 4]] == -1)
    seen.u[:] = np.nan
    assert search_frame(seen, SKY, grid, pairs, MATCHING)[:2] == (None, False)


@pytest.mark.long
@pytest.mark.parametrize("sigma_px", [0.05, 0.5, 4.0])
def test_thousands_of_false_centroids_end_without_an_answer(sigma_px, grid, pairs):
    crowd, _ = frame(CATALOGUE, random_attitude(0), 0, sigma_px, 4000, 1.0)
    found = search_frame(crowd, SKY, grid, pairs, MATCHING).solution
    assert found is None


def test_the_work_of_a_search_is_bounded_by_the_time_it_is_given(grid, pairs):
    # The benchmark measures the time of a unit of work: tests assert no time.
    crowd, _ = frame(CATALOGUE, random_attitude(0), 0, 4.0, 100, 1.0)
    exhausted = [
        search_lost(crowd, SKY, grid, pairs, MATCHING._replace(time_limit_s=t)).exhausted
        for t in (1e-3, 1e3)
    ]
    assert exhausted == [True, False]
