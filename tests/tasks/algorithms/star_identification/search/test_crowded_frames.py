"""Identification in a crowd without a prior."""

import numpy as np
import pytest
from scenes.random_stars import MATCHING, angle_between, frame, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frame import problem_of
from epipole.tasks.algorithms.star_identification.search.crowded_frames import (
    _pivots,
    _shares_inside,
    search_crowded,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    sky_grid,
    sky_to_limit,
)

CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 99.0)


@pytest.fixture(scope="module")
def tables():
    return sky_grid(SKY, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)


def searched(seen, tables, matching=MATCHING):
    """Return attitude, evidence and work over its bound."""
    problem, R = problem_of(seen, SKY, *tables, matching, crowded=True), np.zeros((3, 3))
    evidence, _, work = search_crowded(problem, R)
    return R, evidence, work / problem.limits.budget


@pytest.mark.parametrize(("zero_point", "flux"), [(20.0, True), (np.nan, True), (np.nan, False)])
def test_stars_among_a_thousand_points_are_found(zero_point, flux, tables):
    """Some 37 of 990 centroids."""
    found = 0
    for seed in range(6):
        R = random_attitude(seed)
        seen = frame(CATALOGUE, R, seed, n_false=950, flux=flux)[0]
        got, evidence, work = searched(seen, tables, MATCHING._replace(zero_point_mag=zero_point))
        found += evidence > MATCHING.threshold and angle_between(got, R) < 1e-3
        assert work < 1.1
    assert found >= 5


def test_few_stars_are_found_in_later_rounds(tables):
    """Some 18 of 520 centroids, of whose stars a third is paired."""
    found = 0
    for seed in range(6):
        R = random_attitude(seed)
        seen = frame(CATALOGUE, R, seed, n_false=500, missing=0.5)[0]
        got, evidence, _ = searched(seen, tables, MATCHING._replace(zero_point_mag=20.0))
        found += evidence > MATCHING.threshold and angle_between(got, R) < 1e-3
    assert found >= 4


def test_a_crowd_without_stars_has_no_evidence(tables):
    for seed in range(4):
        crowd = frame(CATALOGUE, random_attitude(seed), seed, 0.3, 700, 1.0)[0]
        assert searched(crowd, tables)[1] < MATCHING.threshold - 10


def test_pivots_with_all_their_surroundings_in_the_image_come_first():
    """Points of the middle, of an edge and of a corner: all, half and a quarter is inside."""
    xy = np.array([[0.3, 0.3], [0.0, 0.0], [0.3, 0.0], [0.02, 0.01]])
    u = np.column_stack([xy, np.ones(4)]) / np.sqrt(1 + np.sum(xy**2, axis=1))[:, None]
    inside = _shares_inside(u, np.array([-0.3, 0.3, -0.3, 0.3]), 0.1)
    np.testing.assert_allclose(inside, [0.25, 1.0, 0.5, 1.0], atol=0.05)
    order = _pivots(inside)
    assert set(order[:2]) == {1, 3}
    np.testing.assert_array_equal(order[2:], [2, 0])


def test_the_same_answer_comes_again_and_ends_at_the_bound(tables):
    seen = frame(CATALOGUE, random_attitude(3), 3, n_false=800, missing=0.8)[0]
    first, second = (searched(seen, tables, MATCHING._replace(time_limit_s=0.01)) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1:] == second[1:]
    assert 1 < first[2] < 2
