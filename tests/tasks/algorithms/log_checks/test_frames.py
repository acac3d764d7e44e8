"""Frames: cut times, shifted times, two counters, cameras and fluxes."""

import numpy as np
import pytest

from epipole.tasks.algorithms.log_checks.findings import SOUND, UNKNOWN, WRONG
from epipole.tasks.algorithms.log_checks.frames import (
    LogCamera,
    LogFrames,
    check_coverage,
    check_exposures,
    check_flux,
    check_frames,
    check_image_size,
    check_night,
    check_numbers,
    check_principal_point,
    check_star_scatter,
    check_times,
    known_offset,
)

START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
CAMERA = LogCamera(1024, 800, 1000.0, 1000.0, 511.0, 400.0, 0)


def ns(t_s):
    return START_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64)


def frames(t_s, number=None, **more):
    """Return frames; of those of one time the first is used."""
    time_ns = ns(t_s)
    number = np.arange(len(time_ns)) if number is None else np.asarray(number)
    used = np.diff(time_ns, prepend=0) > 0
    empty = dict.fromkeys(("x_px", "y_px", "flux", "sigma_px", "exposure_s"), np.zeros(0))
    return LogFrames(time_ns[used], number[used], number, **empty | more)


def judged(found):
    return (found.verdict, found.cause)


@pytest.mark.parametrize("cadence_s", [0.1, 0.25, 0.7, 1.3, 2.5])
def test_times_that_are_cut_to_seconds_are_named(cadence_s):
    t = 0.37 + cadence_s * np.arange(200)
    assert judged(check_times(frames(np.floor(t)))) == (WRONG, "times_cut")
    assert check_times(frames(t)).verdict in (SOUND, UNKNOWN)


def test_frames_in_step_with_the_second_may_be_cut_or_not():
    assert judged(check_times(frames(np.arange(60.0)))) == (UNKNOWN, "whole_times")
    gaps = np.delete(np.arange(60.0), [3, 17, 18, 40])
    assert judged(check_times(frames(gaps))) == (UNKNOWN, "whole_times")
    numbered = frames(gaps, number=gaps.astype(int))
    assert judged(check_times(numbered)) == (UNKNOWN, "whole_times")


def test_jitter_of_a_millisecond_is_no_rounding():
    rng = np.random.default_rng(1)
    assert check_times(frames(np.arange(60.0) + rng.normal(0, 1e-3, 60))).verdict == SOUND


@pytest.mark.parametrize("offset_s", [18.0, -18.0, 19.0, 37.0, -37.0, 3600.0, -7200.0])
@pytest.mark.parametrize("length_s", [22.0, 60.0, 7200.0])
def test_a_shift_of_frames_and_states_is_named_by_its_time_scale(offset_s, length_s):
    frame_ns, state_ns = (
        ns(np.arange(2.6, length_s, 0.5) + offset_s),
        ns(np.arange(0, length_s + 3)),
    )
    (found,) = check_coverage(frame_ns, state_ns, 10.0)
    assert judged(found) == (WRONG, "frames_and_states_shifted")
    assert found.facts["offset_s"] == offset_s


@pytest.mark.parametrize("first_s", [-600.0, -30.0, -2.0, 0.0])
@pytest.mark.parametrize("last_s", [0.0, 2.0, 30.0, 600.0])
@pytest.mark.parametrize("step_s", [0.1, 1.0, 10.0])
def test_states_that_last_longer_are_no_mistake(first_s, last_s, step_s):
    state_ns = ns(np.arange(first_s, 60.0 + last_s + step_s, step_s))
    (found,) = check_coverage(ns(np.arange(0.3, 60)), state_ns, 10.0)
    assert found.verdict == SOUND


def test_frames_without_a_state_near_are_named_and_few_are_unknown():
    (found,) = check_coverage(ns(np.arange(0, 60.0)), ns(np.arange(1e6, 1e6 + 60)), 10.0)
    assert judged(found) == (WRONG, "no_state_near")
    (found,) = check_coverage(ns(np.arange(0, 60.0)), ns(np.arange(0, 30.0)), 10.0)
    assert judged(found) == (UNKNOWN, "few_states_near")


def test_offsets_of_time_scales():
    assert [known_offset(t) for t in (0.0, 9.0, 18.2, 18.9, -36.4, 3601.0, 1800.0)] == [
        0.0, 0.0, 18.0, 19.0, -37.0, 3600.0, 0.0
    ]  # fmt: skip


def test_two_counters_are_two_sensors_and_one_that_starts_again_is_not():
    two = np.stack([np.arange(40), np.arange(40) + 1000], axis=1).ravel()
    (found,) = check_numbers(frames(np.arange(80) * 0.5, number=two), CAMERA)
    assert judged(found) == (WRONG, "numbers_alternate")
    assert check_numbers(frames(np.arange(80.0), number=np.arange(80) % 16), CAMERA) == []
    assert check_numbers(frames(np.arange(80.0), number=80 - np.arange(80)), CAMERA) == []
    (found,) = check_numbers(frames(np.arange(80.0)), CAMERA._replace(others=1))
    assert judged(found) == (WRONG, "two_calibrations")


def test_a_number_that_stays_is_named():
    (found,) = check_numbers(frames(np.arange(80.0), number=np.zeros(80, int)), CAMERA)
    assert judged(found) == (WRONG, "numbers_stay")
    assert (found.facts["count"], found.facts["frames"]) == (79, 80)


def test_a_principal_point_of_zero_is_named():
    assert check_principal_point(CAMERA).verdict == SOUND
    zero = CAMERA._replace(cx_px=0.0, cy_px=0.0)
    assert judged(check_principal_point(zero)) == (WRONG, "principal_point_zero")


def test_centroids_tell_the_size_of_the_image():
    x, y = np.random.default_rng(1).uniform(0, [1023, 799], (500, 2)).T
    seen = frames(np.arange(5.0), x_px=x, y_px=y)
    assert check_image_size(seen, CAMERA).verdict == SOUND
    exchanged = CAMERA._replace(width=800, height=1024)
    assert judged(check_image_size(seen, exchanged)) == (WRONG, "width_and_height_exchanged")
    small = CAMERA._replace(width=512, height=400)
    assert judged(check_image_size(seen, small)) == (WRONG, "image_too_small")
    large = CAMERA._replace(width=4096, height=4096)
    assert judged(check_image_size(seen, large)) == (UNKNOWN, "image_not_filled")


def test_magnitudes_are_no_fluxes():
    magnitude = 6.5 - np.random.default_rng(1).exponential(1 / (0.45 * np.log(10)), 400)
    assert judged(check_flux(magnitude)) == (WRONG, "flux_is_magnitude")
    for unit in (1.0, 100.0, 1e5):
        assert check_flux(unit * 10 ** (-0.4 * (magnitude - 6.5))).verdict == SOUND


def test_no_frames_have_no_findings():
    assert check_frames(frames([]), ns(np.arange(5)), CAMERA, 10.0) == []


@pytest.mark.parametrize(
    ("kept", "lost", "longest"),
    [
        (slice(0, 107), 180, (106, 286)),  # it stops
        (slice(107, None), 107, (0, 107)),  # it begins late
        (np.r_[0:50, 90:287], 41, (49, 90)),
        (slice(None, None, 9), 0, None),  # slow, but all night
    ],
)
def test_a_sensor_without_frames_for_a_part_of_the_night_is_found(kept, lost, longest):
    time_ns = np.arange(287) * SECOND_NS
    found = check_night(time_ns[kept], 0, int(time_ns[-1]), 0.02)
    assert abs(found.value - lost / 286) < 1e-9
    assert found.verdict == ("wrong" if lost else "sound")
    if longest:
        assert (found.facts["from_s"], found.facts["to_s"]) == longest
    assert check_night(time_ns[:0], 0, int(time_ns[-1]), 0.02) is None


@pytest.mark.parametrize(("exposure_s", "verdict"), [(0.9, SOUND), (1.0, SOUND), (200.0, WRONG)])
def test_exposures_end_before_the_next_frame(exposure_s, verdict):
    (found,) = check_exposures(frames(np.arange(30.0), exposure_s=np.full(9, exposure_s)))
    assert found.verdict == verdict


def test_exposures_that_are_unknown_are_not_judged():
    assert check_exposures(frames(np.arange(30.0), exposure_s=np.zeros(9))) == []


@pytest.mark.parametrize(
    ("stated_px", "cause"),
    [(0.1, ""), (0.3, ""), (0.03, ""), (1e-3, "centroid_sigma_too_small"),
     (2.0, "centroid_sigma_too_large")],
)  # fmt: skip
def test_stated_errors_are_held_against_the_scatter_of_stars(stated_px, cause):
    dx, dy = np.random.default_rng(0).normal(0, 0.1, (2, 400))
    found = check_star_scatter(dx, dy, np.full(400, stated_px), 20)
    assert found.cause == cause
    assert found.value == pytest.approx(0.1, rel=0.1)
    assert check_star_scatter(dx[:9], dy[:9], np.full(9, stated_px), 1) is None


def test_exposures_are_checked_where_the_times_of_states_are_wrong_too():
    long = frames(0.2 * np.arange(100), exposure_s=np.full(50, 100.0))
    found = check_frames(long, ns(18.0 + np.arange(20)), CAMERA, 30.0)
    causes = {each.cause for each in found if each.verdict == WRONG}
    assert causes == {"frames_and_states_shifted", "exposure_too_long"}
