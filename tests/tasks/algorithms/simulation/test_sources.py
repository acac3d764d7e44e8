"""Stars in a cone, against a search of all stars."""

import numpy as np
import pytest

from epipole.tasks.algorithms.simulation.element_sets import directions_to_sun
from epipole.tasks.algorithms.simulation.sources import (
    detection_probability,
    in_earth_shadow,
    lambert_dimming,
    magnitude_at,
    star_field,
    stars_in_cones,
)


@pytest.mark.parametrize("radius_deg", [0.5, 7.0, 40.0])
def test_stars_in_cones_are_those_that_a_search_of_all_stars_finds(radius_deg):
    rng = np.random.default_rng(2)
    z = rng.uniform(-1, 1, 3000)
    zeros = np.zeros(3000)
    field = star_field(
        np.arange(3000), rng.uniform(0, 2 * np.pi, 3000), np.arcsin(z), zeros, zeros, zeros,
        zeros, epoch=1991.25, radius_rad=np.radians(radius_deg),
    )  # fmt: skip
    u = rng.normal(size=(40, 3))
    u = np.concatenate([u / np.linalg.norm(u, axis=1)[:, None], np.eye(3), -np.eye(3)])
    cone, star = stars_in_cones(field, u, np.radians(radius_deg))
    expected = np.argwhere(u @ field.u_icrs.T >= np.cos(np.radians(radius_deg)))
    order = np.lexsort((star, cone))
    np.testing.assert_array_equal(np.stack([cone, star], axis=1)[order], expected)


X = np.array([[1.0, 0.0, 0.0]])


def test_ten_times_as_far_is_five_magnitudes_fainter():
    np.testing.assert_allclose(magnitude_at(np.array([3.0, 3.0]), np.array([1e3, 1e4])), [3, 8])


@pytest.mark.parametrize(("phase_deg", "lit"), [(0.0, 1.0), (90.0, 1 / np.pi), (60.0, 0.6090)])
def test_a_diffuse_sphere_dims_by_lamberts_law(phase_deg, lit):
    a = np.radians(phase_deg)
    seen = np.array([[-np.cos(a), np.sin(a), 0.0]])
    assert lambert_dimming(X, seen)[0] == pytest.approx(-2.5 * np.log10(lit), abs=1e-3)


def test_a_sphere_in_front_of_the_sun_is_not_seen():
    assert lambert_dimming(X, X)[0] > 30  # rounding leaves 1e-16 of the light


def test_the_shadow_is_behind_the_earth():
    places = np.array([[-7000.0, 0, 0], [7000.0, 0, 0], [-42164.0, 6300, 0], [-42164.0, 6400, 0]])
    shadow = in_earth_shadow(places, np.repeat(X, 4, axis=0))
    assert shadow.tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("date", "ra_deg", "dec_deg"),
    # Astronomical Almanac: March equinox and June solstice of 2019, the Sun of date; the ICRS
    # differs by 19 years of precession, 0.27 degrees.
    [("2019-03-20T21:58:00", 0.0, 0.0), ("2019-06-21T15:54:00", 90.0, 23.44)],
)
def test_the_sun_is_where_the_seasons_put_it(date, ra_deg, dec_deg):
    t = np.array([np.datetime64(date, "ns").astype(np.int64)])
    (x, y, z), = directions_to_sun(t)  # fmt: skip
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(ra_deg, abs=0.35)
    assert np.degrees(np.arcsin(z)) == pytest.approx(dec_deg, abs=0.15)


def test_half_of_the_objects_at_the_limit_are_detected():
    magnitude = np.array([6.0, 7.0, 7.2, 8.0, np.inf])
    chance = detection_probability(magnitude, 7.0, 0.2)
    np.testing.assert_allclose(chance, [1.0, 0.5, 0.158655, 2.9e-7, 0.0], atol=1e-6)
    assert detection_probability(magnitude, 7.0, 0.0).tolist() == [1, 1, 0, 0, 0]
