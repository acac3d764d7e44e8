"""Objects: their elements against formulas, longitudes against a textbook's sidereal time."""

import numpy as np
from scenes.made_nights import filled, reader_of

from epipole.tasks.report.objects import elements_of, read_objects

GM = 398600.4418


def test_elements_of_a_circle_and_of_an_ellipse():
    r = np.array([[42164.0, 0, 0], [7000.0, 0, 0]])
    speed = np.array([np.sqrt(GM / 42164.0), np.sqrt(GM * (2 / 7000.0 - 1 / 10_000.0))])
    v = np.stack([0 * speed, speed * np.cos(0.5), speed * np.sin(0.5)], axis=1)
    a, e, i = elements_of(r, v).T
    np.testing.assert_allclose(a, [42164.0, 10_000.0], rtol=1e-12)
    np.testing.assert_allclose(e, [0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(np.radians(i), [0.5, 0.5], atol=1e-12)


def test_longitude_is_right_ascension_less_sidereal_time():
    # Greenwich mean sidereal time on 2019-04-01, 0 h UT: 12 h 36 m 16.7 s (Meeus, 12.4), from an
    # equinox that precession has moved by 0.2459 degrees since 2000: that is in this number too.
    made = reader_of({
        "positions": filled("positions", object_id=["o"], x_km=[42164.0], n_sensors=[2],
                            time=[1_554_076_800_000_000_000])})  # fmt: skip
    (found,) = read_objects(made)
    expected = -(12 + 36 / 60 + 16.7 / 3600) * 15 + 0.2459
    assert abs((found.last[0] - expected + 180) % 360 - 180) < 0.01
    assert found.near_geostationary
    assert found.elements is None
