"""What a sensor's stars tell about it."""

import numpy as np
import pytest
from scenes.random_stars import MATCHING, frame, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frame import identify_predicted
from epipole.tasks.algorithms.star_identification.sensor_model import (
    Scale,
    faintest_star,
    frame_scales,
    is_significant,
    rematch,
    residual_scale,
    zero_point,
)
from epipole.tasks.algorithms.star_identification.star_grid import sky_to_limit

CATALOGUE = random_catalogue(20_000)
DEEP = sky_to_limit(CATALOGUE, 99.0)
SEEN_TO = 5.5


def _frames(n=20, **matching):
    """Return frames of a sensor that sees to SEEN_TO, and their solutions."""
    seen = sky_to_limit(CATALOGUE, SEEN_TO).catalogue
    frames = [frame(seen, random_attitude(k), k, **matching)[0] for k in range(n)]
    near = np.eye(3) * 1e-8
    return frames, [
        identify_predicted(f, DEEP, random_attitude(k), near, MATCHING)
        for k, f in enumerate(frames)
    ]


def test_residuals_over_their_true_errors_have_a_scale_of_one():
    found = residual_scale(_frames()[1])
    assert abs(found.scale - 1) < 4 / np.sqrt(2 * found.dof)
    assert not is_significant(found)


def test_a_scale_is_significant_only_with_enough_stars_behind_it():
    assert is_significant(Scale(1.2, 1000))
    assert not is_significant(Scale(1.2, 20))
    assert not is_significant(Scale(1.01, 10**6))


def test_errors_claimed_too_small_show_in_the_scale_after_rematching():
    frames, solutions = _frames(sigma_px=0.4)
    half = [f._replace(sigma_rad=f.sigma_rad / 1.5) for f in frames]
    found = residual_scale(rematch(half, solutions, DEEP, MATCHING))
    assert 1.3 < found.scale < 1.55


def test_the_zero_point_and_its_scatter_are_found():
    frames, solutions = _frames()
    middle, scatter = zero_point(frames, solutions, DEEP)
    assert middle == pytest.approx(20.0, abs=0.05)
    assert scatter == pytest.approx(0.2, abs=0.05)


def test_without_flux_there_is_no_zero_point():
    frames, solutions = _frames(flux=False)
    assert np.isnan(zero_point(frames, solutions, DEEP)).all()


def test_the_faintest_star_seen_is_found_among_false_points():
    frames, solutions = _frames(n_false=20)
    found = faintest_star(frames, solutions, DEEP, 3.7, 4.0)
    assert SEEN_TO <= found <= SEEN_TO + 0.5


def test_nothing_solved_tells_nothing():
    frames, _ = _frames(2)
    assert residual_scale([None, None]) == Scale(1.0, 0)
    assert np.isnan(zero_point(frames, [None, None], DEEP)).all()
    assert rematch(frames, [None, None], DEEP, MATCHING) == [None, None]
    assert faintest_star(frames, [None, None], DEEP, 3.7, 4.0) == 4.0


def residuals(scale, stars, seed):
    """Return sums of squares and degrees of freedom of frames with these errors and stars."""
    rng = np.random.default_rng(seed)
    dof = 2 * stars - 3
    return scale**2 * rng.chisquare(dof), dof


def test_frames_that_are_alike_get_the_error_of_all():
    different = 0
    for seed in range(100):
        stars = np.random.default_rng(seed).integers(4, 30, 200)
        found = frame_scales(*residuals(np.full(200, 0.3), stars, seed))
        different += np.ptp(found) > 0
        assert np.median(found) == pytest.approx(0.3, rel=0.1)
    assert different <= 3


def test_frames_that_differ_get_their_own_errors():
    rng = np.random.default_rng(1)
    scale, stars = rng.choice([0.2, 0.5, 2.0], 600), rng.integers(5, 30, 600)
    found = frame_scales(*residuals(scale, stars, 1))
    assert np.median(np.abs(np.log(found / scale))) < 0.15
    assert np.corrcoef(np.log(found), np.log(scale))[0, 1] > 0.95


def test_a_frame_of_few_stars_is_drawn_towards_the_others():
    rng = np.random.default_rng(2)
    true, stars = np.exp(rng.normal(0.0, 0.4, 4000)), np.full(4000, 3)
    square, dof = residuals(true, stars, 2)
    alone = np.log(np.sqrt(square / dof) / true)
    found = np.log(frame_scales(square, dof) / true)
    # What the residuals of a frame and those of the others tell, each by its own variance.
    best = 1.0 / (1.0 / np.mean(alone**2) + 1.0 / 0.4**2)
    assert np.mean(found**2) < 1.05 * best


def test_a_frame_without_an_attitude_has_the_error_of_all():
    square, dof = residuals(np.repeat([0.2, 2.0], 50), np.full(100, 12), 3)
    found = frame_scales(np.append(square, 0.0), np.append(dof, 0))
    assert 0.3 < found[-1] < 1.3
    assert frame_scales(np.zeros(3), np.zeros(3, np.int64)).tolist() == [1.0, 1.0, 1.0]


def test_residuals_of_nothing_are_no_perfect_frame():
    found = frame_scales(np.append(np.full(50, 20.0), 0.0), np.full(51, 20))
    assert (found > 0).all()
