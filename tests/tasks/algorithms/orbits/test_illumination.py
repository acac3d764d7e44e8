"""Illumination: against Astropy's Sun and Skyfield's geometry, and by hand."""

import numpy as np
import pytest
from astropy.coordinates import get_sun
from astropy.time import Time
from skyfield.geometry import intersect_line_and_sphere

from epipole.tasks.algorithms.orbits.illumination import illumination, reduced_magnitude

NOON_NS = 1_780_142_400_000_000_000  # 2026-05-30T12:00:00Z
EARTH_RADIUS_KM = 6378.137
DEGREE = np.radians(1.0)


def sun_km(time_ns):
    """The Sun from the Earth's centre, by Astropy."""
    sun = get_sun(Time(time_ns / 1e9, format="unix"))
    return sun.cartesian.xyz.to_value("km").T


def scene(seed, n=2000):
    """Objects around the Earth and sensors in low orbit, over a year."""
    rng = np.random.default_rng(seed)
    time_ns = NOON_NS + rng.integers(0, 365 * 86_400, n) * 10**9
    axis = rng.normal(size=(2, n, 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    return time_ns, axis[0] * rng.uniform(6700, 15_000, n)[:, None], axis[1] * 7000.0


def test_the_phase_is_the_angle_between_sun_and_sensor():
    time_ns, r_km, sensor_km = scene(1)
    to_sun, to_sensor = sun_km(time_ns) - r_km, sensor_km - r_km
    cosine = np.sum(to_sun * to_sensor, axis=1)
    cosine /= np.linalg.norm(to_sun, axis=1) * np.linalg.norm(to_sensor, axis=1)
    found = illumination(time_ns, r_km, sensor_km)
    # The Sun's direction is that of the nearest ten minutes, its distance the mean one; Astropy's
    # Sun has the aberration of 20 arcsec.
    np.testing.assert_allclose(found.phase_rad, np.arccos(cosine), atol=0.02 * DEGREE)
    np.testing.assert_allclose(found.range_km, np.linalg.norm(to_sensor, axis=1))


def test_objects_are_sunlit_where_skyfield_sees_the_sun_past_the_earth():
    time_ns, r_km, sensor_km = scene(2)
    sun = sun_km(time_ns)
    # As Skyfield's `is_sunlit`: the line to the Sun meets the Earth, or does not.
    near, far = intersect_line_and_sphere((sun - r_km).T, -r_km.T, EARTH_RADIUS_KM)
    dark = ~np.isnan(near) & (far > 0)
    found = illumination(time_ns, r_km, sensor_km)
    aside = np.linalg.norm(np.cross(r_km, sun), axis=1) / np.linalg.norm(sun, axis=1)
    clear = np.abs(aside - EARTH_RADIUS_KM) > 20.0  # the edge moves by 10 km in 0.02 degrees
    assert dark.sum() > 100
    np.testing.assert_array_equal(found.sunlit[clear], ~dark[clear])


@pytest.mark.parametrize(("side", "phase", "sunlit"), [(1.0, 180.0, True), (-1.0, 0.0, False)])
def test_before_and_behind_the_earth(side, phase, sunlit):
    time_ns = np.array([NOON_NS])
    sun = sun_km(time_ns)
    towards = sun / np.linalg.norm(sun)
    # The sensor is between the object and the Sun, or behind the object.
    found = illumination(time_ns, side * 7000.0 * towards, side * 7000.0 * towards - side * towards)
    assert np.degrees(found.phase_rad[0]) == pytest.approx(phase, abs=0.02)
    assert found.sunlit.tolist() == [sunlit]


def test_without_a_position_nothing_is_known():
    nothing = np.full((1, 3), np.nan)
    found = illumination(np.array([NOON_NS]), nothing, np.ones((1, 3)))
    assert np.isnan([found.range_km[0], found.phase_rad[0]]).all()
    assert len(illumination(np.zeros(0, np.int64), nothing[:0], nothing[:0]).range_km) == 0


def test_ten_times_as_far_is_five_magnitudes_fainter():
    at = np.array([100.0, 1000.0, 10_000.0])
    np.testing.assert_allclose(reduced_magnitude(np.array([1.0, 6.0, 11.0]), at), 6.0)
