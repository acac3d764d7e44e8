"""Magnitudes: zero points and their errors are right, over many seeds; odd input."""

import numpy as np
import pytest

from epipole.tasks.algorithms.photometry import flux_scale

N_FRAMES = 100


def measured(seed, per_frame, colour, floor, photon):
    """Star images of a sensor whose zero point changes from frame to frame."""
    rng = np.random.default_rng(seed)
    zero = 25 + rng.normal(size=N_FRAMES) * 0.1
    magnitude = rng.uniform(3, 7, 2000)
    frame = np.repeat(np.arange(N_FRAMES), per_frame)
    # Some of a few stars, which are others after each ten frames.
    few = min(3 * per_frame, 40)
    star = np.concatenate(
        [k // 10 * 40 + rng.choice(few, per_frame, replace=False) for k in range(N_FRAMES)]
    )
    seen = magnitude[star] + (rng.normal(size=2000) * colour)[star] - zero[frame]
    sigma = np.sqrt(floor**2 + photon / 10 ** (-0.4 * seen))
    flux = 10 ** (-0.4 * (seen + rng.normal(size=len(frame)) * sigma))
    return zero, frame, star, magnitude[star], flux


@pytest.mark.parametrize(
    ("per_frame", "colour", "floor", "photon"),
    [(8, 0.0, 0.05, 0.0), (8, 0.1, 0.05, 0.0), (5, 0.1, 0.02, 3e4), (30, 0.1, 0.05, 1e6),
     (3, 0.2, 0.1, 0.0)],
)  # fmt: skip
def test_zero_points_and_magnitudes_have_honest_errors(per_frame, colour, floor, photon):
    of_zero, of_object, sigma_ratio = [], [], []
    for seed in range(40):
        zero, frame, star, magnitude, flux = measured(seed, per_frame, colour, floor, photon)
        scale = flux_scale(frame, star, magnitude, flux, N_FRAMES)
        of_zero.append(np.mean((scale.zero_mag - zero) ** 2 / scale.zero_variance_mag2))
        rng = np.random.default_rng(seed)
        true = rng.uniform(4, 6, N_FRAMES)
        sigma = np.sqrt(floor**2 + photon / 10 ** (-0.4 * (true - zero)))
        noisy = 10 ** (-0.4 * (true - zero + rng.normal(size=N_FRAMES) * sigma))
        found, stated = scale.magnitudes(noisy)
        of_object.append(np.mean(((found - true) / stated) ** 2))
        own = np.sqrt(stated**2 - scale.zero_variance_mag2)
        sigma_ratio.append(np.median(own / sigma))
    # Of three stars none can be known to be variable: their mean is a little worse than it says.
    assert 0.8 < np.mean(of_zero) < (1.4 if per_frame == 3 else 1.2)
    assert 0.8 < np.mean(of_object) < 1.2
    assert 0.85 < np.median(sigma_ratio) < 1.15


def test_a_variable_star_does_not_move_the_zero_point():
    zero, frame, star, magnitude, flux = measured(1, 8, 0.05, 0.02, 0.0)
    shifted = np.random.default_rng(3).random(len(flux)) < 0.1
    flux[shifted] *= 5.0  # 1.7 magnitudes too bright
    scale = flux_scale(frame, star, magnitude, flux, N_FRAMES)
    assert np.abs(np.mean(scale.zero_mag - zero)) < 0.05  # with all stars 0.17


def test_frames_without_stars_or_flux_have_no_zero_point():
    _, frame, star, magnitude, flux = measured(1, 8, 0.0, 0.02, 0.0)
    flux[frame == 3] = np.nan
    flux[frame == 4] = 0.0
    magnitude = np.where(frame == 5, np.nan, magnitude)
    scale = flux_scale(frame, star, magnitude, flux, N_FRAMES + 1)
    without = [3, 4, 5, N_FRAMES]
    assert np.isnan(scale.zero_mag[without]).all()
    found, sigma = scale.magnitudes(np.full(N_FRAMES + 1, 1e7))
    assert np.isnan(found[without]).all()
    assert np.isnan(sigma[without]).all()
    assert np.isfinite(np.delete(found, without)).all()


def test_frames_before_the_first_star_change_nothing():
    _, frame, star, magnitude, flux = measured(1, 8, 0.1, 0.02, 0.0)
    scale = flux_scale(frame, star, magnitude, flux, N_FRAMES)
    later = flux_scale(frame + 50_000, star, magnitude, flux, N_FRAMES + 50_000)
    assert np.array_equal(later.zero_mag[50_000:], scale.zero_mag)
    assert later.floor_mag2[0] == scale.floor_mag2[0]


def test_no_stars_at_all():
    none, no = np.zeros(0, np.int64), np.zeros(0)
    scale = flux_scale(none, none, no, no, 2)
    assert np.isnan(scale.zero_mag).all()
    assert np.isnan(flux_scale(none, none, no, no, 0).magnitudes(no)[0]).all()


def test_objects_without_flux_have_no_magnitude():
    _, frame, star, magnitude, flux = measured(1, 8, 0.0, 0.02, 0.0)
    scale = flux_scale(frame, star, magnitude, flux, N_FRAMES)
    odd = np.resize([np.nan, 0.0, -1.0, np.inf], N_FRAMES)
    with np.errstate(all="raise"):
        found, sigma = scale.magnitudes(odd)
    assert np.isnan(found).all()
    assert np.isnan(sigma).all()


def test_one_star_per_frame_tells_a_zero_point_with_a_large_error():
    zero, frame, star, magnitude, flux = measured(2, 1, 0.1, 0.05, 0.0)
    scale = flux_scale(frame, star, magnitude, flux, N_FRAMES)
    z = (scale.zero_mag - zero) / np.sqrt(scale.zero_variance_mag2)
    assert np.mean(z**2) < 1.0
