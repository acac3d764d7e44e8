"""Gaia's stars joined with Hipparcos'."""

import astropy.units as units
import numpy as np
import pytest
from astropy.coordinates import Distance, SkyCoord
from astropy.time import Time

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import unit_from_radec
from epipole.tasks.algorithms.star_catalogue import (
    johnson_v_of_gaia,
    join,
    joined_magnitude,
    propagate_positions,
)

MAS = ARCSEC / 1000


def test_places_and_motions_move_as_astropy_moves_them():
    ra, dec = np.radians([10.0, 269.45, 37.95, 200.0]), np.radians([5.0, 4.69, 89.26, -85.0])
    pm_ra, pm_dec = np.array([300.0, -798.0, 44.0, 40.0]), np.array([-200.0, 10328.0, -11.0, -90.0])
    stars = SkyCoord(
        ra * units.rad,
        dec * units.rad,
        distance=Distance(parallax=np.array([50.0, 546.0, 7.5, 5.0]) * units.mas),
        pm_ra_cosdec=pm_ra * units.mas / units.yr,
        pm_dec=pm_dec * units.mas / units.yr,
        radial_velocity=np.zeros(4) * units.km / units.s,
        obstime=Time(1991.25, format="jyear"),
    ).apply_space_motion(new_obstime=Time(2016.0, format="jyear"))
    new_ra, new_dec, new_pm_ra, new_pm_dec = propagate_positions(ra, dec, pm_ra, pm_dec, 24.75)
    want = unit_from_radec(stars.ra.rad, stars.dec.rad)
    assert np.max(np.linalg.norm(unit_from_radec(new_ra, new_dec) - want, axis=1)) < MAS
    # The apparent transverse speed changes with perspective by parts in a million a century.
    np.testing.assert_allclose(new_pm_ra, stars.pm_ra_cosdec.to_value("mas/yr"), atol=0.05)
    np.testing.assert_allclose(new_pm_dec, stars.pm_dec.to_value("mas/yr"), atol=0.05)


def test_a_star_without_motion_stays():
    ra, dec, none = np.array([1.0]), np.array([-0.5]), np.zeros(1)
    np.testing.assert_allclose(
        np.concatenate(propagate_positions(ra, dec, none, none, 30.0)), [1, -0.5, 0, 0]
    )


def test_v_follows_from_g_and_colour():
    # The relation by hand at BP-RP = 1: -0.02704 + 0.01424 - 0.2156 + 0.01426.
    v = johnson_v_of_gaia(np.array([8.0, 8.0, 8.0]), np.array([8.5, np.nan, 8.5]), np.full(3, 7.5))
    np.testing.assert_allclose(v, 8.0 + 0.21414)
    red = johnson_v_of_gaia(np.array([8.0, 8.0]), np.array([12.0, 20.0]), np.array([7.0, 7.0]))
    assert red[0] == red[1]  # beyond its range the relation is constant


def at(*offsets_arcsec):
    """Return unit vectors this far along the equator."""
    angle = np.array(offsets_arcsec) * ARCSEC
    return unit_from_radec(angle, np.zeros(len(angle)))


def test_a_place_within_an_arcsecond_is_the_same_star_whatever_its_brightness():
    joined = join(at(0.0, 100.0), np.array([11.0, 8.0]), at(0.3, 101.2), np.array([8.0, 8.0]))
    assert joined.hipparcos_of.tolist() == [0, -1]
    assert joined.missing.tolist() == []


def test_of_two_that_claim_a_star_the_nearer_has_it():
    joined = join(at(0.0), np.array([7.0]), at(0.8, -0.2, 0.5), np.full(3, 7.0))
    assert joined.hipparcos_of.tolist() == [1]


def test_a_bright_star_with_nothing_like_it_near_is_missing():
    gaia, v_gaia = at(4.2, 200.0), np.array([7.4, 2.6])
    assert join(gaia, v_gaia, at(0.0), np.array([2.6])).missing.tolist() == [0]


def test_a_double_that_one_of_the_two_resolves_is_not_missing():
    gaia, v_gaia = at(-1.5, 1.5), np.array([6.5, 6.7])
    assert join(gaia, v_gaia, at(0.0), np.array([5.9])).missing.tolist() == []


def test_a_faint_star_may_lie_beyond_gaias_limit_and_is_not_added():
    assert join(
        at(500.0), np.array([5.0]), at(0.0, 1.0), np.array([9.5, 8.5])
    ).missing.tolist() == [1]


def test_no_stars_join_with_nothing():
    none, no_v = np.empty((0, 3)), np.empty(0)
    assert join(none, no_v, at(0.0), np.array([3.0])).missing.tolist() == [0]
    assert join(at(0.0), np.array([3.0]), none, no_v).hipparcos_of.tolist() == [-1]


@pytest.mark.parametrize(("gaia", "hipparcos", "v"), [(7.0, 6.5, 7.0), (11.0, 8.0, 8.0), (6, 8, 6)])
def test_where_hipparcos_is_much_brighter_its_magnitude_is_used(gaia, hipparcos, v):
    assert joined_magnitude(np.array([gaia]), np.array([hipparcos])).tolist() == [v]
