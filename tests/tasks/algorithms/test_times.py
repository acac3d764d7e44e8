"""Time scales and Earth's motion, against astropy."""

import warnings

import astropy.units as units
import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric_posvel
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from epipole.tasks.algorithms.constants import DAY_NS
from epipole.tasks.algorithms.times import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    earth_barycentric,
    earth_velocity,
    epoch_grid,
    epoch_interval_ns,
    frame_interval_ns,
    frame_intervals_ns,
    julian_year,
    nearest_frame,
    order_frames,
    order_states,
    restart_shifts,
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


NIGHT = 1_554_076_800_000_000_000  # 2019-04-01 00:00 UTC
SECOND = 1_000_000_000


@given(st.integers(0, 3 * DAY_NS), st.integers(0, 2 * DAY_NS), st.integers(10 * SECOND, DAY_NS))
def test_the_grid_holds_every_multiple_since_midnight_and_no_other(start, length, step):
    first, last = NIGHT + start, NIGHT + start + length
    epochs = epoch_grid(first, last, step)
    assert ((epochs >= first) & (epochs <= last)).all()
    assert (np.diff(epochs) > 0).all()
    assert ((epochs - NIGHT) % DAY_NS % step == 0).all()
    days = range(start // DAY_NS, (start + length) // DAY_NS + 1)
    everything = [NIGHT + d * DAY_NS + k for d in days for k in range(0, DAY_NS, step)]
    assert epochs.tolist() == [t for t in everything if first <= t <= last]


def test_the_slowest_sensor_sets_the_interval_and_jitter_does_not_move_it():
    rng = np.random.default_rng(0)
    slow = np.arange(100) * SECOND + rng.integers(-1000, 1000, 100)
    fast = np.arange(1000) * SECOND // 5
    assert epoch_interval_ns([frame_interval_ns(t) for t in (fast, slow)]) == SECOND
    assert epoch_interval_ns([frame_interval_ns(fast)]) == SECOND // 5


def test_a_single_frame_still_has_an_interval():
    assert frame_interval_ns(np.array([NIGHT])) == 0
    assert epoch_interval_ns([0]) > 0
    assert epoch_interval_ns([]) > 0


@given(st.lists(st.integers(0, 1000), min_size=1, unique=True), st.lists(st.integers(-100, 1100)))
def test_the_nearest_frame_is_nearest_and_the_earlier_of_two(times, wanted):
    times, wanted = np.sort(np.array(times)), np.array(wanted, np.int64)
    got = nearest_frame(wanted, times)
    for epoch, frame in zip(wanted, got, strict=True):
        assert frame == np.argmin(np.abs(times - epoch))


def test_no_time_gives_no_epoch():
    assert len(epoch_grid(NIGHT + 1, NIGHT + 2, SECOND)) == 0


@pytest.mark.parametrize("n", [1, 2])
def test_a_frame_twice_counts_once_for_the_interval(n):
    assert frame_interval_ns(np.repeat(np.arange(5) * SECOND, n)) == SECOND


def verdicts(*frames):
    """Return (sensor, time, number, verdict) of frames, in the order found."""
    columns = np.array(frames, np.int64).reshape(-1, 3).T
    order, verdict = order_frames(*columns)
    return [(*frames[i], int(v)) for i, v in zip(order, verdict, strict=True)]


def test_frames_are_sorted_by_sensor_then_time():
    assert verdicts((1, 5, 0), (0, 9, 8), (0, 7, 6)) == [
        (0, 7, 6, KEEP),
        (0, 9, 8, KEEP),
        (1, 5, 0, KEEP),
    ]


def test_a_frame_that_comes_three_times_counts_once():
    found = verdicts((0, 7, 6), (0, 7, 6), (0, 7, 6), (0, 8, 7))
    assert [f[3] for f in found] == [KEEP, DUPLICATE_FRAME, DUPLICATE_FRAME, KEEP]


def test_of_one_number_at_two_times_the_first_in_time_is_kept():
    found = verdicts((0, 9, 1), (0, 8, 0), (0, 3, 1), (1, 9, 1))
    assert found == [
        (0, 3, 1, KEEP),
        (0, 8, 0, KEEP),
        (0, 9, 1, DUPLICATE_NUMBER),
        (1, 9, 1, KEEP),
    ]


def test_copies_of_a_frame_that_repeats_a_number_repeat_it_too():
    found = verdicts((0, 3, 1), (0, 9, 1), (0, 9, 1))
    assert [f[3] for f in found] == [KEEP, DUPLICATE_NUMBER, DUPLICATE_NUMBER]


def test_two_numbers_at_one_time_are_one_exposure():
    found = verdicts((0, 3, 2), (0, 3, 1), (0, 3, 2))
    assert [f[2:] for f in found] == [(1, KEEP), (2, DUPLICATE_TIME), (2, DUPLICATE_TIME)]


FRAMES = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.integers(0, 5)), max_size=30)


@given(FRAMES, st.randoms(use_true_random=False))
def test_kept_frames_are_unique_and_do_not_depend_on_the_order_given(frames, random):
    shuffled = list(frames)
    random.shuffle(shuffled)
    found = verdicts(*frames)
    assert found == verdicts(*shuffled)
    kept = [f[:3] for f in found if f[3] == KEEP]
    assert kept == sorted(kept)
    assert len({(s, t) for s, t, _ in kept}) == len(kept) == len({(s, n) for s, _, n in kept})
    assert {s for s, *_ in kept} == {s for s, *_ in frames}


def test_the_interval_about_each_frame_is_that_of_its_rate_of_frames():
    slow, fast = SECOND * np.arange(100), SECOND * 100 + SECOND // 5 * np.arange(1000)
    about = frame_intervals_ns(np.concatenate([slow, fast]))
    assert (about[:91] == SECOND).all()
    assert (about[111:] == SECOND // 5).all()
    assert (np.diff(about) <= 0).all()


def test_the_interval_about_each_frame_is_the_usual_one_where_that_is_longer():
    slow, fast = SECOND * np.arange(1000), SECOND * 1000 + SECOND // 5 * np.arange(100)
    assert (frame_intervals_ns(np.concatenate([slow, fast])) == SECOND).all()


@pytest.mark.parametrize("n", [0, 1, 2, 5, 21, 22, 300])
def test_the_interval_about_each_frame_of_an_even_series_is_that_of_the_series(n):
    assert frame_intervals_ns(SECOND * np.arange(n)).tolist() == [SECOND * (n > 1)] * n
    with_gaps = SECOND * (np.arange(n) + 50 * (np.arange(n) // 30))
    assert frame_intervals_ns(with_gaps).tolist() == [SECOND * (n > 1)] * n


@pytest.mark.parametrize("n", [100, 101])
def test_the_interval_about_each_of_many_pairs_of_exposures_is_half_that_of_the_pairs(n):
    pairs = SECOND * 2 * np.arange(n)[:, None] + np.array([0, SECOND // 10])
    for time_ns in (pairs.ravel(), pairs.ravel()[:-1]):
        assert set(frame_intervals_ns(time_ns).tolist()) == {SECOND}


def test_states_of_one_time_count_once_and_the_first_given_is_kept():
    alike = np.ones(4, bool), np.full(4, 0.1)
    order, repeats = order_states(np.array([1, 0, 1, 1]), np.array([5, 9, 5, 4]), *alike)
    assert list(order) == [1, 3, 0, 2]
    assert list(repeats) == [False, False, False, True]


def test_of_states_of_one_time_the_one_with_an_attitude_and_the_best_position_is_kept():
    sigma_km = np.array([0.01, 0.0, 5.0, 0.1, 0.1])  # 0: unknown
    has_attitude = np.array([False, True, True, True, True])
    order, repeats = order_states(np.zeros(5, int), np.zeros(5, int), has_attitude, sigma_km)
    assert list(order) == [3, 4, 2, 1, 0]
    assert list(repeats) == [False, True, True, True, True]


@pytest.mark.parametrize(
    ("number", "shift"),
    [
        ([], []),
        ([5], [0]),
        ([0, 1, 2, 0, 1, 2, 3], [0, 0, 0, 3, 3, 3, 3]),  # a restart
        (
            [6, 7, 0, 1, 2, 6, 7, 8],
            [0, 0, 8, 8, 8, 8, 8, 8],
        ),  # a restart: lower numbers, used later
        ([6, 7, 8, 1, 2, 3, 4, 5], [0] * 8),  # lower numbers that never come again
        ([6, 7, 8, 1, 2, 3, 7, 9], [0] * 8),  # and one that does
        ([0, 1, 2, 6, 7, 8, 3, 4, 5, 9], [0] * 10),  # out of order
        ([0, 1, 2, 3, 1, 5, 6], [0] * 7),  # one wrong number
        ([0, 1, 2, 9, 3, 4, 5], [0] * 7),  # one wrong number, no other comes again
        ([0, 0, 1, 1, 2, 2, 3, 3], [0] * 8),  # two sensors with one id
        ([2**62 + 1, 2**62 + 2, 2**62 + 1, 2**62 + 2], [0] * 4),  # no room for more
        ([0] * 5, [0, 1, 2, 3, 4]),  # never written
        ([7] * 3, [0, 1, 2]),
        ([7] * 2, [0] * 2),  # perhaps a copy
        ([2**63 - 1] * 3, [0] * 3),  # no room for more
    ],
)
def test_numbers_go_on_where_a_counter_restarted(number, shift):
    number = np.repeat(number, 3).astype(np.int64)  # in three logs
    time_ns = np.repeat(np.arange(len(shift)), 3)
    mixed = np.random.default_rng(1).permutation(len(number))
    found = np.empty(len(number), np.int64)
    found[mixed] = restart_shifts(time_ns[mixed], number[mixed])
    np.testing.assert_array_equal(found, np.repeat(shift, 3).astype(np.int64))


def test_a_counter_of_eight_bits_never_gives_a_number_twice():
    number = np.arange(5000) % 256
    number[2500:] = np.arange(2500) % 256  # restarted once more
    numbered = number + restart_shifts(np.arange(5000), number)
    assert (np.diff(numbered) == 1).all()


@pytest.mark.parametrize("first", [0, 3, 200, 254])
def test_a_counter_that_begins_anywhere_never_gives_a_number_twice(first):
    number = (np.arange(5000) + first) % 256
    numbered = number + restart_shifts(np.arange(5000), number)
    assert (np.diff(numbered) > 0).all()


def test_wrong_numbers_do_not_hide_that_a_counter_began_again():
    number = (np.arange(5000) + 200) % 1024
    number[[900, 950, 3000]] = [9999, 5, 8888]
    numbered = number + restart_shifts(np.arange(5000), number)
    sound = np.delete(np.arange(5000), [900, 950, 3000])
    assert (np.diff(numbered[sound]) > 0).all()


@pytest.mark.parametrize("n_frames", [2, 3, 5, 9, 12])
def test_short_bursts_that_count_from_zero_give_no_number_twice(n_frames):
    number = np.arange(6000) % n_frames
    numbered = number + restart_shifts(np.arange(6000), number)
    assert (np.diff(numbered) == 1).all()


def test_bursts_of_which_frames_are_missing_give_no_number_twice():
    there = np.random.default_rng(3).random(6000) < 0.9
    number = (np.arange(6000) % 12)[there]
    numbered = number + restart_shifts(np.arange(len(number)), number)
    assert (np.diff(numbered) > 0).all()


def test_the_largest_number_after_a_restart_stays_as_it_is():
    number = np.concatenate([np.arange(100), np.arange(50), [2**63 - 1], np.arange(51, 100)])
    shift = restart_shifts(np.arange(200), number)
    assert shift[150] == 0
    assert (shift[100:150] == 100).all()
    assert (shift[151:] == 100).all()


def test_numbers_of_two_sensors_with_one_id_do_not_change():
    rng = np.random.default_rng(2)
    number = np.stack([np.arange(400), np.arange(400) + 57], axis=1)
    time_ns = 10 * np.arange(400)[:, None] + rng.integers(0, 10, 2)
    assert not restart_shifts(time_ns.ravel(), number.ravel()).any()
