"""The navigation catalogue: places at a date, doubles merged."""

import astropy.units as units
import numpy as np
from astropy.coordinates import Distance, SkyCoord
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from epipole.tasks.algorithms.constants import AU_KM
from epipole.tasks.algorithms.star_catalogue import (
    limit_for_density,
    navigation_catalogue,
    star_directions,
)

ARCSEC = np.pi / 648000


def _random_sky(n, seed):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True), rng.uniform(0, 9, n)


def test_proper_motion_agrees_with_astropy():
    ra, dec = np.radians([10.0, 269.45, 200.0]), np.radians([5.0, 4.69, -85.0])
    plx, pm_ra, pm_dec = (
        np.array([50.0, 546.0, 5.0]),
        np.array([300.0, -798.0, 40.0]),
        np.array([-200.0, 10328.0, -90.0]),
    )
    u = star_directions(ra, dec, np.zeros(3), pm_ra, pm_dec, 28.0, np.zeros(3))
    stars = SkyCoord(
        ra * units.rad,
        dec * units.rad,
        distance=Distance(parallax=plx * units.mas),
        pm_ra_cosdec=pm_ra * units.mas / units.yr,
        pm_dec=pm_dec * units.mas / units.yr,
        radial_velocity=np.zeros(3) * units.km / units.s,
        obstime=Time(1991.25, format="jyear"),
    ).apply_space_motion(new_obstime=Time(2019.25, format="jyear"))
    want = np.moveaxis(stars.cartesian.xyz.value / stars.distance.value, 0, -1)
    assert np.max(np.linalg.norm(u - want, axis=1)) < 1e-3 * ARCSEC


def test_parallax_moves_a_star_away_from_the_observer_by_its_size():
    # Star at the pole, observer 1 au along +x: the star is seen shifted to -x by its parallax.
    u = star_directions(
        np.zeros(1), np.full(1, np.pi / 2), np.array([742.0]), np.zeros(1), np.zeros(1), 0.0,
        np.array([AU_KM, 0.0, 0.0]),
    )  # fmt: skip
    assert abs(u[0, 0] + 0.742 * ARCSEC) < 1e-6 * ARCSEC


def test_a_negative_parallax_moves_nothing():
    args = (np.zeros(1), np.zeros(1), np.array([-5.0]), np.zeros(1), np.zeros(1), 10.0)
    np.testing.assert_array_equal(star_directions(*args, np.full(3, AU_KM)), [[1.0, 0.0, 0.0]])


def test_a_close_double_becomes_one_star_with_the_light_of_both():
    u = np.array([[1.0, 0, 0], [1.0, 10 * ARCSEC, 0], [0, 1.0, 0]])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    found = navigation_catalogue(np.array([7, 3, 9]), u, np.array([6.0, 5.0, 1.0]), 20 * ARCSEC)
    np.testing.assert_array_equal(found.star_id, [9, 3])
    light = 10**-2.4 + 10**-2.0
    assert abs(found.magnitude[1] + 2.5 * np.log10(light)) < 1e-12
    assert abs(found.u_icrs[1, 1] - 10 * ARCSEC * 10**-2.0 / light) < 1e-6 * ARCSEC


def test_a_chain_of_stars_is_not_one_star():
    # Each within 20" of the next, the ends 30" apart: the faint end is too far from the brightest.
    u = np.array([[1.0, 0, 0], [1.0, 15 * ARCSEC, 0], [1.0, 30 * ARCSEC, 0]])
    found = navigation_catalogue(np.arange(3), u, np.array([1.0, 2.0, 3.0]), 20 * ARCSEC)
    np.testing.assert_array_equal(found.star_id, [0, 2])


@given(seed=st.integers(0, 2**32 - 1))
def test_stars_far_apart_are_kept_as_they_are_brightest_first(seed):
    u, magnitude = _random_sky(50, seed)
    found = navigation_catalogue(np.arange(50), u, magnitude, 1e-6)
    np.testing.assert_array_equal(found.u_icrs, u[found.star_id])
    assert np.all(np.diff(found.magnitude) >= 0)


def test_the_limit_for_a_density_has_that_density():
    magnitude = np.linspace(0, 10, 1001)
    limit = limit_for_density(magnitude, 100 / (4 * np.pi))
    assert np.sum(magnitude <= limit) == 100


def test_an_empty_catalogue_gives_an_empty_one():
    found = navigation_catalogue(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0), 1e-4)
    assert len(found.star_id) == len(found.u_icrs) == 0
    assert np.isfinite(limit_for_density(found.magnitude, 100.0))
