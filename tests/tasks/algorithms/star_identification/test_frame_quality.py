"""Errors of each frame, from the residuals of its stars."""

import numpy as np
import pytest

from epipole.tasks.algorithms.star_identification.frame_quality import frame_scales


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
