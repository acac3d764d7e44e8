"""Four base stars and the quadrilateral rule."""

import numpy as np
import pytest
from scenes.star_maps import WIDE, orbit_maps

from epipole.tasks.algorithms.star_identification.published.four_base_stars import (
    match_four_base_stars,
)
from epipole.tasks.algorithms.star_identification.star_pairs import build_pair_table


@pytest.fixture(scope="module")
def orbit():
    seen, maps = orbit_maps(300)
    return seen, build_pair_table(seen.u_icrs, 2 * WIDE.camera.half_diagonal_rad), maps


def test_the_catalogue_is_as_large_as_the_published_one(orbit):
    seen, pairs, _ = orbit
    assert abs(len(seen.star_id) - 2827) < 50
    assert abs(len(pairs.first) - 269_421) < 5_000


def test_all_300_maps_of_one_orbit_are_identified_as_published(orbit):
    seen, pairs, maps = orbit
    matched = stars = 0
    for u, sigma_rad, star_id, _ in maps:
        star = match_four_base_stars(u, sigma_rad, seen.u_icrs, pairs)
        found = star >= 0
        assert found.sum() >= 5
        np.testing.assert_array_equal(seen.star_id[star[found]], star_id[found])
        matched, stars = matched + found.sum(), stars + len(u)
    assert matched > 0.98 * stars


def test_false_spots_get_no_star(orbit):
    seen, pairs, maps = orbit
    rng = np.random.default_rng(3)
    answered = 0
    for u, sigma_rad, star_id, _ in maps[::10]:
        false = rng.normal([0, 0, 6.0], 1.0, (5, 3)) * [1, 1, 0] + [0, 0, 6.0]
        false /= np.linalg.norm(false, axis=1, keepdims=True)
        order = rng.permutation(len(u) + 5)
        u, true = np.concatenate([u, false])[order], np.concatenate([star_id, [-1] * 5])[order]
        sigma = np.full(len(u), np.median(sigma_rad))
        star = match_four_base_stars(u, sigma, seen.u_icrs, pairs)
        found = star >= 0
        answered += found.any()
        # A spot may fall on a star of the catalogue that the map does not show: rarely.
        assert np.sum(seen.star_id[star[found]] != true[found]) <= 1
    assert answered >= 27


def test_a_mirrored_map_is_refused(orbit):
    seen, pairs, maps = orbit
    for u, sigma_rad, _, _ in maps[::30]:
        star = match_four_base_stars(u * [-1.0, 1.0, 1.0], sigma_rad, seen.u_icrs, pairs)
        assert np.sum(star >= 0) <= 5  # chance at most: never the map


@pytest.mark.parametrize("n", [0, 1, 3])
def test_fewer_than_four_centroids_are_nothing(orbit, n):
    seen, pairs, maps = orbit
    u, sigma_rad, _, _ = maps[0]
    assert np.all(match_four_base_stars(u[:n], sigma_rad[:n], seen.u_icrs, pairs) == -1)
