"""Optimal attitude and its covariance."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry.attitude import (
    attitude_covariance,
    optimal_attitude,
    orthonormalise,
    refine_attitude,
    turn,
)

ARCSEC = np.pi / 648000
seeds = st.integers(0, 2**32 - 1)


def _field(rng, n, half_angle):
    """Return n directions in a field about z."""
    t = np.tan(half_angle)
    v = np.column_stack([rng.uniform(-t, t, (n, 2)), np.ones(n)])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _noisy(rng, u, sigma):
    """Return directions with errors of sigma per axis, across the line of sight."""
    moved = u + np.cross(rng.normal(size=u.shape) * np.reshape(sigma, (-1, 1)), u)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def _angle(R, S):
    return np.linalg.norm(Rotation.from_matrix(R @ S.T).as_rotvec())


@settings(deadline=None)  # the first call compiles
@given(seeds)
def test_the_optimal_attitude_is_scipys(seed):
    rng = np.random.default_rng(seed)
    u, R = _field(rng, 8, 0.2), Rotation.random(random_state=seed).as_matrix()
    sigma = rng.uniform(5, 50, 8) * ARCSEC
    measured = _noisy(rng, u, sigma)
    found, _ = optimal_attitude(measured, u @ R, sigma)
    want, _ = Rotation.align_vectors(measured, u @ R, weights=(sigma.min() / sigma) ** 2)
    assert _angle(found, want.as_matrix()) < 1e-3 * ARCSEC


@settings(deadline=None)  # the first call compiles
@given(seeds)
def test_the_compiled_refinement_reaches_the_same_optimum(seed):
    rng = np.random.default_rng(seed)
    u, R = _field(rng, 8, 0.2), Rotation.random(random_state=seed).as_matrix()
    sigma = rng.uniform(5, 50, 8) * ARCSEC
    measured = _noisy(rng, u, sigma)
    start = Rotation.from_rotvec(rng.normal(size=3) * 1e-3).as_matrix() @ R
    P = np.empty((3, 3))
    assert refine_attitude(start, measured, sigma, u @ R, np.arange(8), P)
    want, cov = optimal_attitude(measured, u @ R, sigma)
    assert _angle(start, want) < 1e-3 * ARCSEC
    np.testing.assert_allclose(start @ start.T, np.eye(3), atol=1e-14)
    # P is taken at the predicted directions: alike to the size of the noise.
    np.testing.assert_allclose(P, cov, rtol=0.02, atol=1e-3 * np.trace(cov))


def test_errors_divided_by_their_sigmas_are_standard_normal():
    rng = np.random.default_rng(1)
    normalised, nees = [], []
    for _ in range(2000):
        n = int(rng.integers(3, 12))
        u, R = _field(rng, n, 0.17), Rotation.random(random_state=rng.integers(2**31)).as_matrix()
        sigma = rng.uniform(3, 30, n) * ARCSEC
        found, cov = optimal_attitude(_noisy(rng, u, sigma), u @ R, sigma)
        # R_true = exp(phi) R_reported, phi about the sensor axes.
        phi = Rotation.from_matrix(R @ found.T).as_rotvec()
        normalised.append(phi / np.sqrt(np.diag(cov)))
        nees.append(phi @ np.linalg.solve(cov, phi))
    np.testing.assert_allclose(np.std(normalised, axis=0), 1.0, atol=0.05)
    assert abs(np.mean(nees) - 3) < 0.2  # chi-square with 3: its mean has sigma 0.055
    assert abs(np.mean(np.array(nees) < 11.345) - 0.99) < 0.01


def test_a_turn_about_the_boresight_has_the_largest_sigma_in_a_narrow_field():
    u = _field(np.random.default_rng(0), 10, np.radians(1))
    u = np.concatenate([u, u * [-1, -1, 1]])  # about the boresight, so that axes do not mix
    sigma = np.sqrt(np.diag(attitude_covariance(u, np.full(20, ARCSEC))))
    assert sigma[2] > 30 * sigma[0]
    assert abs(sigma[0] / (ARCSEC / np.sqrt(20)) - 1) < 0.01


def test_directions_all_alike_have_no_covariance():
    u = np.repeat([[0.0, 0.0, 1.0]], 4, axis=0)
    assert np.isnan(attitude_covariance(u, np.full(4, ARCSEC))).all()
    R, P = np.eye(3), np.empty((3, 3))
    assert not refine_attitude(R, u, np.full(4, ARCSEC), u, np.arange(4), P)


@settings(deadline=None)  # the first call compiles
@given(seeds)
def test_turn_is_the_exponential_map(seed):
    rng = np.random.default_rng(seed)
    R, v = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    want = Rotation.from_rotvec(v).as_matrix() @ R
    turn(R, *v)
    np.testing.assert_allclose(R, want, atol=1e-14)
    R += 1e-9
    orthonormalise(R)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(R, want, atol=1e-8)
