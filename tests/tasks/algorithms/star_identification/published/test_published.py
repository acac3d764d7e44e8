"""The published methods side by side: the contest's eight maps, and whole frames."""

import numpy as np
import pytest
from scenes.random_stars import (
    CAMERA,
    MATCHING,
    angle_between,
    frame,
    join_centroids,
    optics,
    random_attitude,
)
from scenes.random_stars import random_catalogue as random_sky
from scenes.star_maps import SEEDS, contest_maps, hipparcos_at_epoch

from epipole.tasks.algorithms.geometry.camera import pixel_angle
from epipole.tasks.algorithms.star_catalogue import NavigationCatalogue, navigation_catalogue
from epipole.tasks.algorithms.star_identification.frame import FrameCentroids, search_frame
from epipole.tasks.algorithms.star_identification.published import (
    four_base_stars,
    match_group,
    radial_cyclic,
)
from epipole.tasks.algorithms.star_identification.published.common import solve_matches
from epipole.tasks.algorithms.star_identification.sequence import no_priors
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

METHODS = [
    four_base_stars.identify_by_four_base_stars,
    match_group.identify_by_match_group,
    radial_cyclic.identify_by_radial_cyclic,
]
NEEDS_MAPS = pytest.mark.skipif(not SEEDS.is_file(), reason="the shared star maps are not here")


@pytest.fixture(scope="module")
def maps():
    return contest_maps()


@pytest.fixture(scope="module")
def skies(maps):
    """Return the sky of each map: all stars to magnitude 6, as its camera merges them."""
    stars = hipparcos_at_epoch(7.0)
    made = {}
    for number in (1, 7):
        merged = navigation_catalogue(*stars, 2 * maps[number][0].camera.pixel_rad)
        made[number] = sky_to_limit(merged, 6.0)
    return {number: made[1 if number < 7 else 7] for number in maps}


def as_frame(kind, u, sigma_rad, magnitude=None):
    mag = np.full(len(u), np.nan) if magnitude is None else magnitude
    return FrameCentroids(u, sigma_rad, mag, np.zeros(3), optics(kind.camera))


def solved(maps, skies, method):
    """Return the numbers of the maps whose attitude and stars a method gets right."""
    right = set()
    for number, (kind, u, sigma_rad, star_id, R) in maps.items():
        sky, seen = skies[number], as_frame(kind, u, sigma_rad)
        star = method.make_matcher(sky, seen.optics)(u, sigma_rad)
        solution = solve_matches(seen, sky, star, MATCHING.gate_sigma)
        if solution is None:
            continue
        found = solution.star >= 0
        named = np.mean(sky.catalogue.star_id[solution.star[found]] == star_id[found])
        if named == 1 and angle_between(solution.R_sensor_from_icrs, R) < np.radians(0.05):
            right.add(number)
    return right


@pytest.mark.long
@NEEDS_MAPS
def test_the_match_group_fails_on_the_noisy_maps_3_and_6_as_published(maps, skies):
    assert solved(maps, skies, match_group) == {1, 2, 4, 5, 7, 8}


@pytest.mark.long
@NEEDS_MAPS
def test_radial_and_cyclic_features_fail_where_stars_are_missing_as_published(maps, skies):
    # Published: 4, 5 and 8 fail. Here the noisy maps 3 and 6 fail as well: in their fields, too few
    # stars have all their neighbours in view.
    assert solved(maps, skies, radial_cyclic) == {1, 2, 7}


@NEEDS_MAPS
def test_four_base_stars_need_a_fifth_that_agrees(maps, skies):
    # Map 3 has only four stars in place.
    assert solved(maps, skies, four_base_stars) == {1, 2, 4, 5, 6, 7, 8}


def by_default(maps, skies, number):
    """Return the default's solution of a map without brightness."""
    kind, u, sigma_rad, _, _ = maps[number]
    sky, seen = skies[number], as_frame(kind, u, sigma_rad)
    stars = sky.catalogue.u_icrs[: pattern_size(sky, seen.optics.solid_angle_sr)]
    pairs = pattern_pairs(stars, 2 * kind.camera.half_diagonal_rad)
    return search_frame(seen, sky, sky_grid(sky, 0.01), pairs, MATCHING).solution


def assert_right(map_, sky, solution):
    _, _, _, star_id, R = map_
    assert angle_between(solution.R_sensor_from_icrs, R) < np.radians(0.05)
    named = solution.star >= 0
    np.testing.assert_array_equal(sky.catalogue.star_id[solution.star[named]], star_id[named])


@NEEDS_MAPS
@pytest.mark.parametrize("seed", [0, 1])
def test_the_default_solves_all_eight_maps_without_brightness(skies, seed):
    maps = contest_maps(seed, sigma_px=0.03)
    for number in maps:
        solution = by_default(maps, skies, number)
        assert solution is not None, number
        assert_right(maps[number], skies[number], solution)


@NEEDS_MAPS
def test_with_ten_times_the_error_only_map_3_may_be_refused(maps, skies):
    # Four of its seven stars are in place: without brightness, these are too few at a false-alarm
    # probability of one in a million.
    for number in maps:
        solution = by_default(maps, skies, number)
        assert solution is not None or number == 3, number
        if solution is not None:
            assert_right(maps[number], skies[number], solution)


class OneSky:
    """Skies of one catalogue, whatever the limit."""

    def __init__(self, catalogue: NavigationCatalogue):
        self.whole = sky_to_limit(catalogue, 99.0)

    def limit_for(self, stars_per_sr):
        return 99.0

    def sky(self, limit):
        return self.whole


def centroids(frames, camera):
    pixel_rad = [pixel_angle(camera, f.u) for f in frames]
    sigma_px = [f.sigma_rad / p for f, p in zip(frames, pixel_rad, strict=True)]
    return join_centroids(frames, sigma_px, pixel_rad)


def identify(method, frames, catalogue):
    n = len(frames.counts)
    return method(np.arange(n) * 1.0, frames, no_priors(n), OneSky(catalogue), None, MATCHING)


@pytest.mark.parametrize("method", METHODS)
def test_frames_get_their_attitude_and_a_status(method):
    catalogue = random_sky(3000)
    frames = [frame(catalogue, random_attitude(k), k)[0] for k in range(12)]
    empty = frames[0]._replace(
        u=np.empty((0, 3)), sigma_rad=np.empty(0), instrumental_mag=np.empty(0)
    )
    found = identify(method, centroids([*frames, empty], CAMERA), catalogue)
    off = [
        angle_between(s.R_sensor_from_icrs, random_attitude(k))
        for k, s in enumerate(found.solutions.each())
        if s is not None
    ]
    assert len(off) >= 11
    assert np.degrees(max(off)) < 0.5
    assert found.status[-1] == "no_centroids"
    assert not found.solutions.solved[-1]


@pytest.mark.parametrize("method", METHODS)
def test_errors_that_are_not_stated_follow_from_the_residuals(method):
    catalogue = random_sky(3000)
    frames = [frame(catalogue, random_attitude(k), k, sigma_px=0.3)[0] for k in range(12)]
    given = centroids(frames, CAMERA)
    unknown = given._replace(sigma_px=np.full(len(given.u), np.nan))
    found = identify(method, unknown, catalogue)
    assert 0.25 < found.sigma_scale.min() <= found.sigma_scale.max() < 0.35


@pytest.mark.parametrize("method", METHODS)
def test_centroids_all_on_one_spot_are_refused(method):
    catalogue = random_sky(3000)
    seen = frame(catalogue, random_attitude(0), 0)[0]
    spot = centroids([seen._replace(u=np.repeat(seen.u[:1], len(seen.u), axis=0))], CAMERA)
    found = identify(method, spot, catalogue)
    assert not found.solutions.solved.any()
    assert found.status == ["no_match"]
