"""Planets: apparent directions against Astropy, error bounds as documented by ERFA."""

import astropy.units as units
import numpy as np
import pytest
from astropy.coordinates import GCRS, CartesianRepresentation, get_body, solar_system_ephemeris
from astropy.time import Time
from astropy.utils import iers

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import aberrate
from epipole.tasks.algorithms.orbits.planets import NUMBERS, planet_directions
from epipole.tasks.algorithms.times import earth_barycentric

NAMES = ("mercury", "venus", "mars", "jupiter", "saturn", "uranus", "neptune")
NOON = np.datetime64("2019-04-01T12:00:00", "ns").astype(np.int64)
TIMES = NOON + np.arange(5) * 11 * 3_600_000_000_000


@pytest.mark.parametrize("planet", range(7))
def test_directions_agree_with_astropy(planet):
    zero = np.zeros((5, 3))
    u, _ = planet_directions(TIMES, zero, zero)
    with iers.conf.set_temp("auto_download", False), solar_system_ephemeris.set("builtin"):
        body = get_body(NAMES[planet], Time(TIMES / 1e9, format="unix", scale="utc"))
    expected = body.cartesian.xyz.value.T
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    # Astropy bends light at the Sun and turns ecliptics its own way: 0.02 arcsec.
    assert np.linalg.norm(u[:, planet] - expected, axis=1).max() < 0.05 * ARCSEC


def test_the_observers_place_and_velocity_count():
    place, velocity = np.array([[0.0, 7000.0, 0.0]]), np.array([[7.5, 0.0, 0.0]])
    zero = np.zeros((1, 3))
    time = TIMES[:1]
    u, _ = planet_directions(time, place, velocity)
    with iers.conf.set_temp("auto_download", False), solar_system_ephemeris.set("builtin"):
        frame = GCRS(
            obstime=Time(time / 1e9, format="unix", scale="utc"),
            obsgeoloc=CartesianRepresentation(*(place.T * units.km)),
            obsgeovel=CartesianRepresentation(*(velocity.T * units.km / units.s)),
        )
        body = get_body("mars", frame.obstime).transform_to(frame)
    expected = body.cartesian.xyz.value.T
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    still, _ = planet_directions(time, zero, zero)
    assert np.linalg.norm(u[:, 2] - still[:, 2], axis=1) > 2 * ARCSEC
    assert np.linalg.norm(u[:, 2] - expected, axis=1) < 0.05 * ARCSEC


def test_aberration_is_the_barycentric_one():
    zero = np.zeros((1, 3))
    u, _ = planet_directions(TIMES[:1], zero, zero)
    _, v = earth_barycentric(TIMES[:1])
    assert np.linalg.norm(aberrate(u[:, 6], -v) - u[:, 6], axis=1) > 5 * ARCSEC


def test_bounds_are_arcseconds_to_a_minute_and_a_half():
    zero = np.zeros((5, 3))
    _, error = planet_directions(TIMES, zero, zero)
    assert error.shape == (5, len(NUMBERS))
    assert (error > 4 * ARCSEC).all()
    assert (error < 130 * ARCSEC).all()


def test_no_times_give_no_planets():
    u, error = planet_directions(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    assert u.shape == (0, 7, 3)
    assert error.shape == (0, 7)
