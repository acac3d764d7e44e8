"""Time scales and Earth's motion, against astropy."""

import warnings

import astropy.units as units
import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric_posvel
from astropy.time import Time

from epipole.tasks.algorithms.constants import DAY_NS
from epipole.tasks.algorithms.time.time_scales import (
    earth_barycentric,
    earth_velocity,
    julian_year,
    tai_minus_utc_s,
    tt_julian_date,
    utc_julian_date,
)

TIMES_NS = np.array(
    [10**18, 1_554_091_200_123_456_789, 1_483_228_800_000_000_000, 1_750_000_000_000_000_000]
)


def _astropy():
    seconds, rest = np.divmod(TIMES_NS, 10**9)
    return Time(seconds, rest * 1e-9, format="unix", scale="utc")


def test_utc_days_are_whole_and_fractions_exact():
    day, fraction = utc_julian_date(TIMES_NS)
    assert np.all(day % 1 == 0.5)
    assert day[1] == 2458574.5  # 2019-04-01
    assert fraction[1] == pytest.approx((4 * 3600 + 0.123456789) / 86400, abs=1e-15)


def test_terrestrial_time_is_astropys_to_a_nanosecond():
    jd1, jd2 = tt_julian_date(TIMES_NS)
    want = _astropy().tt
    difference_ns = ((jd1 - want.jd1) + (jd2 - want.jd2)) * DAY_NS
    assert np.max(np.abs(difference_ns)) < 1


@pytest.mark.parametrize(
    "day", ["2016-12-31", "2015-06-30", "1972-06-30", "2017-01-01", "1999-01-01"]
)
def test_terrestrial_time_is_right_on_days_with_a_leap_second(day):
    clock = ["00:00:00", "00:00:01.5", "11:59:59.25", "23:59:59", "23:59:59.999999999"]
    texts = [f"{day}T{time}" for time in clock]
    jd1, jd2 = tt_julian_date(np.array(texts, "datetime64[ns]").astype(np.int64))
    want = Time(texts, scale="utc").tt
    difference_ns = ((jd1 - want.jd1) + (jd2 - want.jd2)) * DAY_NS
    assert np.max(np.abs(difference_ns)) < 1


def test_a_date_far_ahead_brings_no_warning():
    far_ns = np.datetime64("2095-01-01", "ns").astype(np.int64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert julian_year(far_ns) == pytest.approx(2095.0, abs=0.01)
        earth_barycentric(far_ns)


def test_before_the_first_leap_second_the_first_value_is_used():
    assert tai_minus_utc_s(np.array([2440587.5, 2441317.5, 2441499.5])).tolist() == [10, 10, 11]


def test_the_julian_year_is_astropys():
    np.testing.assert_allclose(julian_year(TIMES_NS), _astropy().tt.jyear, atol=1e-11)


def test_earth_moves_as_astropy_says_in_its_own_time_scale():
    r_km, v_km_s = earth_barycentric(TIMES_NS)
    r, v = get_body_barycentric_posvel("earth", _astropy())
    np.testing.assert_allclose(r_km.T, r.xyz.to_value(units.km), atol=1.0)
    np.testing.assert_allclose(v_km_s.T, v.xyz.to_value(units.km / units.s), atol=1e-7)


def test_one_time_gives_one_vector():
    r_km, v_km_s = earth_barycentric(np.int64(0))
    assert r_km.shape == v_km_s.shape == (3,)


def test_the_interpolated_velocity_of_earth_is_the_exact_one_and_that_of_its_time_alone():
    rng = np.random.default_rng(0)
    times = 1_500_000_000_000_000_000 + rng.integers(0, 86_400_000_000_000 * 400, 500)
    got = earth_velocity(times)
    np.testing.assert_allclose(got, earth_barycentric(times)[1], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(earth_velocity(times[7:9]), got[7:9])
    assert earth_velocity(times[:0]).shape == (0, 3)
