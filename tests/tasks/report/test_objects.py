"""Objects: longitudes by a textbook and astropy; what an object without positions has."""

import numpy as np
import pytest
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
from astropy.time import Time
from scenes.made_nights import START_NS, filled, reader_of

from epipole.schemas.columns import POSITION
from epipole.tasks.report.objects import read_objects


def test_longitude_is_right_ascension_less_sidereal_time():
    # Greenwich mean sidereal time on 2019-04-01, 0 h UT: 12 h 36 m 16.7 s (Meeus, 12.4), from an
    # equinox that precession has moved by 0.2459 degrees since 2000: that is in this number too.
    made = reader_of({
        "objects": filled("objects", object_id=["o"], n_positions=[1], verdict=["no_orbit"]),
        "positions": filled("positions", object_id=["o"], x_km=[42164.0], cov_xx=[12.0],
                            time=[1_554_076_800_000_000_000])})  # fmt: skip
    (found,) = read_objects(made)
    expected = -(12 + 36 / 60 + 16.7 / 3600) * 15 + 0.2459
    assert abs((found.ends[1][0] - expected + 180) % 360 - 180) < 0.01
    assert found.near_geostationary
    assert found.sigma_km == 12.0**0.5
    assert found.elements is None
    assert (found.status, found.name, found.verdict) == ("unknown", "", "no_orbit")


@pytest.mark.parametrize("place", [(0.0, 0.0), (100.0, 10.0), (-60.0, 60.0)])
def test_longitude_and_latitude_are_those_on_the_turning_earth(place):
    times = Time(2458574.5 + np.arange(4) * 0.25, format="jd")  # 2019-04-01
    longitude, latitude = np.radians(place)
    level = np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude)])
    r_km = 42164.0 * np.array([*level, np.sin(latitude)])
    fixed = ITRS(CartesianRepresentation(*np.tile(r_km[:, None], 4), unit="km"), obstime=times)
    inertial = fixed.transform_to(GCRS(obstime=times)).cartesian.xyz.to_value("km")
    names = ["a", "b", "c", "d"]
    made = reader_of({
        "objects": filled("objects", object_id=names, n_positions=[1] * 4),
        "positions": filled("positions", object_id=names,
                            time=times.datetime64.astype("M8[ns]").astype(np.int64),
                            **dict(zip(POSITION, inertial, strict=True)))})  # fmt: skip
    for found in read_objects(made):
        assert found.ends[0][:2] == pytest.approx(place, abs=0.006)


def test_an_object_without_positions_is_where_its_orbit_is():
    made = reader_of({
        "objects": filled("objects", object_id=["o", "p"], n_sensors=[2, 1], name=["SAT 7", None]),
        "identifications": filled("identifications", object_id=["o", None], status=["known"] * 2),
        "orbits": filled("orbits", object_id=["o"], z_km=[7000.0], cov_xx=[4.0], a_km=[7000.0],
                         e=[0.1], i_deg=[90.0], sigma_a_km=[8.0])})  # fmt: skip
    found, bare = read_objects(made)
    assert found.ends[0] == found.ends[1]
    assert found.ends[0][1:] == pytest.approx((90.0, 7000.0), abs=0.15)  # the pole has moved
    assert (found.status, found.name, found.positions) == ("known", "SAT 7", 0)
    assert (found.sigma_km, found.elements) == (2.0, (7000.0, 0.1, 90.0))
    assert found.element_sigmas == (8.0, 0.0, 0.0)
    assert (found.sensors, found.first_ns) == (2, START_NS)
    assert found.has_orbit
    assert bare.ends is None
    assert np.isnan(bare.sigma_km)
    assert not bare.has_orbit
    assert not bare.near_geostationary


def test_the_sigma_of_an_object_is_the_median_of_its_positions():
    variances = [1.0, 4.0, 9.0, 100.0, 400.0]
    made = reader_of({
        "objects": filled("objects", object_id=["o"], n_positions=[5]),
        "positions": filled("positions", object_id=["o"] * 5, x_km=[7e3] * 5, cov_yy=variances),
    }, in_group=2)  # fmt: skip
    assert read_objects(made)[0].sigma_km == 3.0
