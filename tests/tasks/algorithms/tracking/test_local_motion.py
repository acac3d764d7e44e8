"""Local motion: exact on a great circle, true errors with noise, no worse for fast objects."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.sky_filter import BEND_SHARE, acceleration


def passing(t, speed_km_s, range_km):
    """Directions to an object on a straight line past a sensor, nearest at t = 0."""
    x = np.column_stack([speed_km_s * t, np.full(len(t), range_km), 0.1 * speed_km_s * t])
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def evaluate(t, u, at, sigma, bias=0.0, widest=6.0):
    n, q = len(t), len(at)
    return directions_at(
        np.zeros(q, int),
        np.full(q, n),
        at,
        0.01,
        t,
        u,
        centroid_covariance(u, np.full(n, sigma)),
        centroid_covariance(u, np.full(n, bias)),
        widest,
    )


@pytest.mark.parametrize(("speed", "range_km"), [(3.0, 36000.0), (7.0, 3000.0), (10.0, 400.0)])
def test_the_neglected_motion_stays_below_the_noise(speed, range_km):
    t, sigma = np.arange(-10, 10.1, 0.25), 2 * ARCSEC
    at = np.linspace(-8, 8, 50)
    u, _, noise, *_ = evaluate(t, passing(t, speed, range_km), at, sigma)
    error = np.linalg.norm(u - passing(at, speed, range_km), axis=1)
    assert (error < sigma).all()
    assert (error < 3 * np.sqrt(np.trace(noise, axis1=1, axis2=2))).all()


def test_rates_come_out():
    t = np.arange(-5, 5.1, 0.5)
    _, w, *_ = evaluate(t, passing(t, 7.0, 3000.0), np.zeros(1), ARCSEC)
    np.testing.assert_allclose(w[0], [7.0 / 3000.0, 0.0, 0.7 / 3000.0], atol=1e-6)


@pytest.mark.parametrize("n", [2, 3, 5, 13])
def test_the_covariance_is_honest_over_many_trials(n):
    rng = np.random.default_rng(n)
    t, sigma, rate = np.arange(n) - 0.3 * n, 2 * ARCSEC, 40 * ARCSEC
    goal = np.array([0.0, 0.6, 0.8])
    basis = tangent_basis(goal)
    squares = []
    for _ in range(3000):
        # The acceleration is one that the rate allows; the fit does not know which.
        bend = rng.normal(size=2) * BEND_SHARE * acceleration(rate)
        path = t[:, None] * [rate, 0.0] + 0.5 * t[:, None] ** 2 * bend
        seen = goal + (path + rng.normal(size=(n, 2)) * sigma) @ basis
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        u, _, noise, *_ = evaluate(t, seen, np.zeros(1), sigma)
        e, C = basis @ (u[0] - goal), basis @ noise[0] @ basis.T
        squares.append(e @ np.linalg.solve(C, e) / 2)
    assert abs(np.mean(squares) - 1) < 0.06


def test_what_all_frames_share_does_not_average_out():
    t = np.arange(-6, 6.1)
    u = passing(t, 3.0, 36000.0)
    _, _, noise, bias, fitted, *_ = evaluate(t, u, np.zeros(1), ARCSEC, bias=30 * ARCSEC)
    assert fitted.tolist() == [[0, 13]]
    basis = tangent_basis(u[6])
    np.testing.assert_allclose(
        basis @ bias[0] @ basis.T, np.eye(2) * (30 * ARCSEC) ** 2, rtol=1e-3, atol=1e-12
    )
    assert np.trace(noise[0]) < 2 * ARCSEC**2


def test_one_detection_holds_still_with_an_error_that_grows():
    u = np.array([[0.0, 0.0, 1.0]])
    out, w, noise, _, fitted, *_ = evaluate(np.zeros(1), u, np.array([0.0, 0.5]), ARCSEC)
    assert fitted.tolist() == [[0, 1], [0, 1]]
    np.testing.assert_allclose(out, np.tile(u, (2, 1)))
    assert not w.any()
    assert noise[1, 0, 0] == pytest.approx(ARCSEC**2 + (0.01 * 0.5) ** 2)


def test_no_query_gives_nothing():
    found = evaluate(np.zeros(1), np.array([[0.0, 0.0, 1.0]]), np.zeros(0), ARCSEC)
    assert all(len(values) == 0 for values in found)


def test_a_bias_that_some_frames_alone_have_stays_a_covariance():
    """Attitudes of a few frames are priors, of the others from stars."""
    t = np.arange(-5.0, 6.0, 2.0)
    u = passing(t, 3.0, 36000.0)
    own, shared = np.full(len(t), ARCSEC), np.where(np.arange(len(t)) % 3 == 0, 30 * ARCSEC, 0.0)
    n = len(t)
    _, _, _, bias, *_ = directions_at(
        np.zeros(12, np.int64), np.full(12, n), np.linspace(-6, 6, 12), 0.0, t, u,
        centroid_covariance(u, own), centroid_covariance(u, shared), 6.0,
    )  # fmt: skip
    assert np.linalg.eigvalsh(bias).min() > -1e-6 * (30 * ARCSEC) ** 2
