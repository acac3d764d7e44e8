"""The error of detections along their motion through the image, from their scatter."""

import numpy as np
import pytest

from epipole.tasks.algorithms.tracking.image_trails import trail_time2

SIGMA = 2e-5


def scattered(n, time_s, seed=1):
    """Residuals of detections that scatter by `time_s` times their rate along their motion."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    moves = np.cross(u, rng.normal(size=(n, 3))) * 4e-3
    noise = np.cross(u, rng.normal(0.0, SIGMA, (n, 3)))
    residual = noise + rng.normal(0.0, time_s, (n, 1)) * moves
    cov = SIGMA**2 * (np.eye(3) - u[:, :, None] * u[:, None, :])
    return residual, moves, cov, np.zeros(n)


@pytest.mark.parametrize("time_s", [0.004, 0.01, 0.05])
def test_the_error_along_the_motion_is_found(time_s):
    assert np.sqrt(trail_time2(*scattered(2000, time_s))) == pytest.approx(time_s, rel=0.1)


def test_detections_of_other_objects_do_not_count():
    residual, moves, cov, leverage = scattered(2000, 0.01)
    residual[::20] += 60 * SIGMA
    found = np.sqrt(trail_time2(residual, moves, cov, leverage))
    assert found == pytest.approx(0.01, rel=0.15)


def test_residuals_of_a_fit_are_smaller_than_errors():
    residual, moves, cov, leverage = scattered(2000, 0.01)
    fitted = residual * np.sqrt(0.6), moves, cov, leverage + 0.4
    assert np.sqrt(trail_time2(*fitted)) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_equal_errors_in_all_directions_are_no_trails(seed):
    assert trail_time2(*scattered(2000, 0.0, seed)) == 0.0


def test_few_detections_tell_nothing():
    assert trail_time2(*scattered(40, 0.05)) == 0.0


def test_an_error_along_the_motion_that_is_stated_is_not_added_again():
    residual, moves, cov, leverage = scattered(2000, 0.01)
    stated = cov + 0.01**2 * moves[:, :, None] * moves[:, None, :]
    assert trail_time2(residual, moves, stated, leverage) == 0.0
