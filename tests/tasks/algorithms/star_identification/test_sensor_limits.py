"""What a sensor's stars tell about it."""

import numpy as np
import pytest
from scenes.random_stars import HOW, frame, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frames.frame import identify_predicted
from epipole.tasks.algorithms.star_identification.sensor_limits import (
    Scale,
    faintest_star,
    is_significant,
    rematch,
    residual_scale,
    zero_point,
)
from epipole.tasks.algorithms.star_identification.sky.camera_sky import sky_to_limit

CATALOGUE = random_catalogue(20_000)
DEEP = sky_to_limit(CATALOGUE, 99.0)
SEEN_TO = 5.5


def _frames(n=20, **how):
    """Return frames of a sensor that sees to SEEN_TO, and their solutions."""
    seen = sky_to_limit(CATALOGUE, SEEN_TO).catalogue
    frames = [frame(seen, random_attitude(k), k, **how)[0] for k in range(n)]
    near = np.eye(3) * 1e-8
    return frames, [
        identify_predicted(f, DEEP, random_attitude(k), near, HOW) for k, f in enumerate(frames)
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
    found = residual_scale(rematch(half, solutions, DEEP, HOW))
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
    assert rematch(frames, [None, None], DEEP, HOW) == [None, None]
    assert faintest_star(frames, [None, None], DEEP, 3.7, 4.0) == 4.0
