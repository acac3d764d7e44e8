"""Directions on the sky, against pyerfa and astropy."""

import astropy.units as units
import erfa
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import given, settings
from hypothesis import strategies as st

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    boresight_angles,
    east_north,
    radec_from_unit,
    tangent_basis,
    unit_from_radec,
)

ARCSEC = np.pi / 648000
seeds = st.integers(0, 2**32 - 1)


def _units(seed, n=10):
    u = np.random.default_rng(seed).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


@settings(deadline=None)
@given(seeds)
def test_aberration_is_erfas_but_for_the_suns_gravity(seed):
    u = _units(seed)
    v = _units(seed + 1)[0] * 31.0
    beta = v / SPEED_OF_LIGHT_KM_S
    want = erfa.ab(u, beta, 1e9, np.sqrt(1 - beta @ beta))  # the Sun at 1e9 au bends nothing
    assert np.max(np.linalg.norm(aberrate(u, v) - want, axis=1)) < 1e-6 * ARCSEC


@settings(deadline=None)
@given(seeds)
def test_aberration_with_the_opposite_velocity_undoes_it(seed):
    u, v = _units(seed), _units(seed + 1)[0] * 30.0
    np.testing.assert_allclose(aberrate(aberrate(u, v), -v), u, atol=1e-15)


def test_a_star_across_the_motion_is_displaced_forward_by_v_over_c():
    seen = aberrate(np.array([1.0, 0, 0]), np.array([0.0, 29.79, 0.0]))
    assert np.arctan2(seen[1], seen[0]) / ARCSEC == pytest.approx(20.5, abs=0.01)


@settings(deadline=None)
@given(seeds)
def test_angles_and_unit_vectors_are_each_others_inverse(seed):
    u = _units(seed)
    ra, dec = radec_from_unit(u)
    assert np.all((ra >= 0) & (ra < 2 * np.pi))
    np.testing.assert_allclose(unit_from_radec(ra, dec), u, atol=1e-15)


@pytest.mark.parametrize("y", [-1e-17, -0.0, 0.0, -1e-15])
def test_right_ascension_and_roll_stay_below_a_full_turn(y):
    u = np.array([1.0, y, 0.0])
    ra, _ = radec_from_unit(u)
    assert 0.0 <= ra < 2 * np.pi
    # East is y at this boresight, and the image's upper side is nearly north.
    R = np.array([[0.0, 1.0, -y], [0.0, -y, -1.0], u])
    for angle in (boresight_angles(R)[0], boresight_angles(R)[2]):
        assert 0.0 <= angle < 2 * np.pi


@settings(deadline=None)
@given(seeds)
def test_the_tangent_basis_is_a_right_handed_triad(seed):
    u = np.concatenate([_units(seed), np.eye(3), -np.eye(3)])
    basis = tangent_basis(u)
    triad = np.concatenate([basis, u[:, None]], axis=1)
    np.testing.assert_allclose(
        triad @ np.swapaxes(triad, 1, 2), np.eye(3)[None].repeat(16, 0), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(triad), 1.0)


@pytest.mark.parametrize("x", [0.0, -0.0])
@pytest.mark.parametrize("pole", [1.0, -1.0])
def test_at_a_pole_east_and_north_go_with_the_right_ascension(x, pole):
    u = np.array([[x, 0.0, pole]])
    ra, _ = radec_from_unit(u)
    east, north = east_north(u)[0]
    np.testing.assert_allclose(east, [-np.sin(ra[0]), np.cos(ra[0]), 0.0], atol=1e-15)
    np.testing.assert_allclose(np.cross(east, north), u[0], atol=1e-15)


@settings(deadline=None)
@given(seeds)
def test_boresight_and_roll_agree_with_astropys_position_angle(seed):
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    ra, dec, roll = boresight_angles(R[None])
    ra_up, dec_up = radec_from_unit(R[2:] - 1e-4 * R[1:2])
    boresight = SkyCoord(ra * units.rad, dec * units.rad)
    want = boresight.position_angle(SkyCoord(ra_up * units.rad, dec_up * units.rad)).rad
    turn = (roll - want + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn[0]) < 2e-3 / np.cos(dec[0])  # the meridians converge over 1e-4 rad
    assert 0 <= roll[0] < 2 * np.pi
