"""Hot pixels: found where light cannot do the same; objects that the sensor follows are not."""

import numpy as np
import pytest

from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.directions import multiply, quaternion_from_rotation_vector
from epipole.tasks.algorithms.tracking.hot_pixels import CERTAIN, LIKELY, fixed_positions

CAMERA = Camera(512, 512, 14667.0, 14667.0, 255.5, 255.5)
SIGMA = 0.15


def turning(rate_rad_s, time_s, axis=(1.0, 0.0, 0.0)):
    return quaternion_from_rotation_vector(np.outer(time_s * rate_rad_s, axis))


def image(seed, n_frames, fixed, n_false=5, noise=SIGMA):
    """Return detections at fixed places and false alarms: frame, x, y, and which are fixed."""
    rng = np.random.default_rng(seed)
    frame, x, y, is_fixed = [], [], [], []
    for f in range(n_frames):
        shown = [place for place in fixed if rng.random() > 0.05]
        for place in shown:
            frame.append(f)
            x.append(place[0] + rng.normal() * noise)
            y.append(place[1] + rng.normal() * noise)
            is_fixed.append(True)
        for _ in range(n_false):
            frame.append(f)
            x.append(rng.uniform(0, 511))
            y.append(rng.uniform(0, 511))
            is_fixed.append(False)
    return np.array(frame), np.array(x), np.array(y), np.array(is_fixed)


def find(frame, x, y, time_s, q, least=CERTAIN):
    places = fixed_positions(frame, x, y, np.full(len(x), SIGMA), time_s, q, CAMERA)
    return places.with_odds(least)


OFF_MIDDLE = [(100.3, 200.4), (401.6, 55.7)]
MIDDLE = [(100.0, 200.0), (401.0, 55.0), (7.0, 480.0)]


def test_what_stays_through_repointings_is_a_hot_pixel_wherever_it_lies():
    t = np.arange(40.0)
    turns = np.repeat(np.random.default_rng(1).normal(size=(8, 3)), 5, axis=0)
    frame, x, y, fixed = image(1, 40, OFF_MIDDLE)
    assert (find(frame, x, y, t, quaternion_from_rotation_vector(turns)) == fixed).all()


def test_what_stays_through_a_fast_half_turn_is_a_hot_pixel():
    t = np.arange(0.0, 700.0, 5.0)
    frame, x, y, fixed = image(2, len(t), OFF_MIDDLE)
    assert (find(frame, x, y, t, turning(np.radians(0.3), t)) == fixed).all()


def test_what_stays_more_exactly_than_light_is_a_hot_pixel():
    t = np.arange(30.0)
    frame, x, y, fixed = image(3, len(t), OFF_MIDDLE, noise=0.01)
    assert (find(frame, x, y, t, turning(2e-4, t)) == fixed).all()


@pytest.mark.parametrize("rate", [0.0, 2e-4, 1e-3])
@pytest.mark.parametrize("seed", range(4))
def test_several_that_scatter_as_light_on_the_middle_of_pixels_are_likely_hot_pixels(rate, seed):
    t = np.arange(60.0)
    frame, x, y, fixed = image(seed, len(t), MIDDLE)
    assert (find(frame, x, y, t, turning(rate, t), LIKELY) == fixed).all()
    assert not find(frame, x, y, t, turning(rate, t), CERTAIN).any()  # other sensors may object


@pytest.mark.parametrize("off_px", [0.0, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("place", [(255.0, 256.0), (100.0, 200.0)])
@pytest.mark.parametrize("seed", range(5))
def test_a_followed_object_on_the_middle_of_a_pixel_is_no_hot_pixel(off_px, place, seed):
    """It scatters as light does; one place alone may be on a middle by chance."""
    t = np.arange(60.0)
    frame, x, y, _ = image(seed, len(t), [(place[0] + off_px, place[1])])
    assert not find(frame, x, y, t, turning(2e-4, t), LIKELY).any()


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
@pytest.mark.parametrize("seed", range(3))
def test_a_followed_object_is_told_from_hot_pixels_beside_it(noise, seed):
    t = np.arange(60.0)
    frame, x, y, fixed = image(seed, len(t), MIDDLE, noise=noise)
    rng = np.random.default_rng(seed + 50)
    frame, fixed = np.append(frame, np.arange(60)), np.append(fixed, np.zeros(60, bool))
    x = np.append(x, 256.0 + rng.normal(size=60) * SIGMA)
    y = np.append(y, 250.0 + rng.normal(size=60) * SIGMA)
    order = np.argsort(frame, kind="stable")
    found = find(frame[order], x[order], y[order], t, turning(2e-4, t))
    assert (found == fixed[order]).all()


@pytest.mark.parametrize("seed", range(3))
def test_what_drifts_is_no_hot_pixel_however_steady(seed):
    t = np.arange(60.0)
    frame, x, y, fixed = image(seed, len(t), MIDDLE, noise=0.05)
    x[fixed] += 0.25 * (frame[fixed] / 30.0 - 1)
    assert not find(frame, x, y, t, turning(2e-4, t), LIKELY).any()


@pytest.mark.parametrize("rate", [0.0, 2e-4, 1e-3])
def test_what_the_sensor_follows_is_no_hot_pixel(rate):
    t = np.arange(60.0)
    frame, x, y, _ = image(5, len(t), OFF_MIDDLE)
    assert not find(frame, x, y, t, turning(rate, t), LIKELY).any()


def test_what_is_seen_in_one_of_two_pointings_is_no_hot_pixel():
    t = np.arange(40.0)
    turn = np.where(t < 20, 0.0, 0.5)
    frame, x, y, fixed = image(6, 40, OFF_MIDDLE)
    kept = ~(fixed & (frame >= 20))
    q = quaternion_from_rotation_vector(np.outer(turn, [1.0, 0.0, 0.0]))
    assert not find(frame[kept], x[kept], y[kept], t, q).any()


@pytest.mark.parametrize("slew_s", [1, 2, 3])
@pytest.mark.parametrize("first", [10, 20, 25])
def test_an_object_that_is_followed_after_a_slew_is_no_hot_pixel(first, slew_s):
    t = np.arange(60.0)
    after = t - first
    turn = np.interp(after, [-slew_s, 0.0], [0.0, 0.35]) + 4e-4 * np.maximum(after, 0.0)
    q = quaternion_from_rotation_vector(np.outer(turn, [0.0, 1.0, 0.0]))
    frame, x, y, fixed = image(8, 60, OFF_MIDDLE)
    kept = ~fixed | (frame >= first)
    assert not find(frame[kept], x[kept], y[kept], t, q).any()


def test_pointing_jitter_is_no_repointing():
    rng = np.random.default_rng(7)
    t = np.arange(60.0)
    jitter = quaternion_from_rotation_vector(rng.normal(size=(60, 3)) * 2 / 14667.0)
    frame, x, y, _ = image(7, 60, OFF_MIDDLE)
    assert not find(frame, x, y, t, multiply(jitter, turning(2e-4, t))).any()


def test_strays_alone_make_no_hot_pixel():
    t = np.arange(100.0)
    turns = np.random.default_rng(8).normal(size=(100, 3))
    frame, x, y, _ = image(8, 100, [], n_false=1000)
    assert not find(frame, x, y, t, quaternion_from_rotation_vector(turns)).any()


@pytest.mark.parametrize("n_frames", [0, 1, 4])
def test_few_frames_show_no_hot_pixel(n_frames):
    t = np.arange(float(n_frames))
    frame, x, y, _ = image(9, n_frames, MIDDLE)
    found = find(frame.astype(int), x.astype(float), y.astype(float), t, turning(0.5, t))
    assert not found.any()
