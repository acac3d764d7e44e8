"""The sky as a camera needs it."""

import numpy as np
import pytest
from scenes.random_stars import optics, random_catalogue

from epipole.tasks.algorithms.star_identification.sky.camera_sky import (
    MAX_PAIRS,
    PATTERN_STARS,
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

CATALOGUE = random_catalogue(20_000)


def test_a_sky_holds_the_stars_to_its_limit_and_their_mean_density():
    sky = sky_to_limit(CATALOGUE, 5.0)
    np.testing.assert_array_equal(
        sky.catalogue.magnitude, CATALOGUE.magnitude[CATALOGUE.magnitude <= 5]
    )
    assert sky.rho == pytest.approx(len(sky.catalogue.star_id) / (4 * np.pi))


def test_a_field_shows_about_as_many_pattern_stars_as_wanted():
    sky = sky_to_limit(CATALOGUE, 99.0)
    share = optics().solid_angle_sr / (4 * np.pi)
    assert pattern_size(sky, optics().solid_angle_sr) * share == pytest.approx(
        PATTERN_STARS, abs=0.1
    )
    assert pattern_size(sky, 1e-9) == 20_000


def test_pairs_of_a_dense_sky_stay_within_their_number():
    pairs = pattern_pairs(CATALOGUE.u_icrs, 1.0)
    assert 0.9 * MAX_PAIRS < len(pairs.first) < 1.1 * MAX_PAIRS


def test_the_grid_is_for_the_radius_asked():
    assert sky_grid(sky_to_limit(CATALOGUE, 4.0), 0.01).radius_rad == 0.01


def test_a_limit_brighter_than_every_star_leaves_an_empty_sky():
    sky = sky_to_limit(CATALOGUE, -30.0)
    assert len(sky.catalogue.star_id) == 0
    assert sky.rho > 0
