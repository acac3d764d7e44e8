"""Forces: against potentials written out, JPL's ephemeris, and tables of the air."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, NOON_NS

from epipole.tasks.algorithms.orbits.forces import (
    _add_earth,
    _air,
    _at_time,
    _sunlight,
    accelerate,
    gravity_gradient,
)
from epipole.tasks.algorithms.times import tt_julian_date

GM, RADIUS, C22, S22 = 398600.4418, 6378.137, 1.57446037e-6, -9.03803807e-7
ZONAL = {2: 1.08262668e-3, 3: -2.53265649e-6, 4: -1.61962159e-6}
PLACES = np.array([[5000.0, 4000.0, 2500.0], [-39359.9, 15125.8, 64.3], [120.0, -900.0, 6900.0]])


def geocentric(time_ns):
    """Return the positions of Sun and Moon [km] by JPL's DE421; TT serves as TDB."""
    jplephem, de421 = pytest.importorskip("jplephem"), pytest.importorskip("de421")
    sky = jplephem.Ephemeris(de421)
    date, share = tt_julian_date(np.array([time_ns]))
    moon = sky.position("moon", date + share)[:, 0]
    earth = sky.position("earthmoon", date + share)[:, 0] - moon / (1 + sky.EMRAT)
    return sky.position("sun", date + share)[:, 0] - earth, moon


def potential(x, angle, zonal, sectors=True):
    """Return the Earth's potential: Legendre polynomials by NumPy, the sectors by longitude."""
    r = np.linalg.norm(x)
    sine = x[2] / r
    total = 1.0
    for n, j in zonal.items():
        legendre = np.polynomial.legendre.Legendre.basis(n)(sine)
        total -= j * (RADIUS / r) ** n * legendre
    longitude = np.arctan2(x[1], x[0]) - angle
    sector = C22 * np.cos(2 * longitude) + S22 * np.sin(2 * longitude)
    return GM / r * (total + sectors * (RADIUS / r) ** 2 * 3 * (1 - sine**2) * sector)


def slope(of, x, step=0.5):
    """Return the gradient by differences of fourth order: right to 1e-13 of the attraction."""
    out = np.empty(3)
    for a, d in enumerate(np.eye(3) * step):
        out[a] = (8 * (of(x + d) - of(x - d)) - of(x + 2 * d) + of(x - 2 * d)) / (12 * step)
    return out


@pytest.mark.parametrize("x", PLACES)
@pytest.mark.parametrize("angle", [0.0, 1.3])
def test_the_earths_attraction_is_the_slope_of_its_potential(x, angle):
    found = np.zeros(3)
    _add_earth(x, angle, found)
    expected = slope(lambda p: potential(p, angle, ZONAL), x)
    # C22, the smallest term, is 1e-6 of the attraction of a low orbit.
    assert np.linalg.norm(found - expected) < 1e-9 * np.linalg.norm(expected)


@pytest.mark.parametrize("x", PLACES)
def test_the_gradient_is_that_of_mass_and_flattening(x):
    found = np.empty((3, 3))
    gravity_gradient(x, found)

    def attraction(p):
        return slope(lambda q: potential(q, 0.0, {2: ZONAL[2]}, sectors=False), p)

    expected = np.stack([(attraction(x + d) - attraction(x - d)) / 20 for d in 10 * np.eye(3)], 1)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_sun_and_moon_are_where_jpl_has_them():
    R, found = AROUND.R_night_from_gcrf, np.empty(3)
    for t_s in (-80_000.0, 1234.5, 80_000.0):
        sun, moon = geocentric(NOON_NS + int(t_s * 1e9))
        for nodes, expected, off_km in ((AROUND.sun, sun, 3000.0), (AROUND.moon, moon, 20.0)):
            _at_time(nodes, AROUND.start_s, AROUND.step_s, t_s, found)
            assert np.linalg.norm(R.T @ found - expected) < off_km


def test_sunlight_pushes_away_from_the_sun_and_not_in_the_shadow():
    sun, push = np.array([1.495978707e8, 0.0, 0.0]), np.empty(3)
    _sunlight(np.array([0.0, 42164.0, 0.0]), sun, push)
    # 4.54e-6 N/m^2 at 1 AU: Montenbruck and Gill (2000), section 3.4, have 4.56e-6.
    assert push[0] == pytest.approx(-4.54e-9, rel=0.002)
    _sunlight(np.array([-42164.0, 6300.0, 0.0]), sun, push)
    assert (push == 0.0).all()
    _sunlight(np.array([-42164.0, 6400.0, 0.0]), sun, push)
    assert push[0] < 0.0


def test_air_slows_what_moves_through_it():
    drag = np.empty(3)
    x, v = np.array([6378.137 + 400.0, 0.0, 0.0]), np.array([0.0, 7.668558, 0.0])
    _air(x, v, drag)
    # Vallado, table 8-4: 3.725e-12 kg/m^3 at 400 km; the air turns with the Earth.
    speed = 7.668558e3 - 7.292115e-5 * 6778137.0
    assert drag[1] == pytest.approx(-0.5 * 3.725e-12 * speed**2 / 1000, rel=1e-6)
    assert drag[0] == drag[2] == 0.0
    _air(x * 6.0, v, drag)
    assert np.abs(drag).max() < 1e-25


def test_the_pull_of_moon_and_sun_is_that_of_two_points():
    x, v = np.array([-39359.9, 15125.8, 64.3]), np.zeros(3)
    found, bare, work = np.empty(3), np.zeros(3), np.zeros((4, 3))
    accelerate(3600.0, x, v, np.zeros(2), AROUND, work, found)
    _add_earth(x, AROUND.era_rad + 7.292115146706979e-5 * 3600.0, bare)
    expected, body = np.zeros(3), np.empty(3)
    for nodes, gm in ((AROUND.sun, 1.32712440e11), (AROUND.moon, 4902.8001)):
        _at_time(nodes, AROUND.start_s, AROUND.step_s, 3600.0, body)
        to = body - x
        expected += gm * (to / np.linalg.norm(to) ** 3 - body / np.linalg.norm(body) ** 3)
    np.testing.assert_allclose(found - bare, expected, atol=1e-15)
