"""Errors of a direction: how much scatters beyond the stated errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry.camera import Camera, project, unproject
from epipole.tasks.algorithms.geometry.covariances import (
    OPTICS,
    few_stars_covariance,
    image_derivatives,
    scatter_beyond,
    shared_attitude_covariance,
    shared_direction_covariance,
)


@pytest.mark.parametrize("shared", [0.0, 0.5])
def test_the_scatter_is_that_of_independent_errors_with_the_same_mean(shared):
    """Interpolated errors scatter less, but neighbours correlate: their mean errs as before."""
    rng = np.random.default_rng(3)
    n, width, own, white = 4000, 13, 4.0, 20.0
    e = rng.normal(size=(n, width + 1, 3)) * white
    e = (1 - shared) * e[:, 1:] + shared * e[:, :-1] + rng.normal(size=(n, width, 3)) * own
    residual = e - e.mean(axis=1, keepdims=True)  # a fit of one constant
    follows = np.tile(np.arange(width) > 0, n)
    residual = residual * [1.0, 1.0, 0.0]
    found = scatter_beyond(
        residual.reshape(-1, 3), np.full(n * width, own), np.full(n * width, 1 / width), follows
    )
    assert np.sqrt(found) == pytest.approx(white, rel=0.08)


def test_few_residuals_tell_no_scatter():
    assert scatter_beyond(np.ones((9, 3)), np.ones(9), np.zeros(9), np.zeros(9, bool)) == 0.0


CAMERA = Camera(1024, 1024, 2900.0, 2910.0, 515.0, 508.0, -0.2, 0.05, 3e-4, -2e-4, 0.01)
SMALL = dict(zip(OPTICS, (0.01, 0.01, 0.01, 0.01, 1e-5, 1e-4, 1e-6, 1e-6, 1e-3), strict=True))


FISHEYE = CAMERA._replace(fx_px=600.0, fy_px=610.0, fisheye=True)


def changed(name, camera=CAMERA):
    return camera._replace(**{name: getattr(camera, name) + SMALL[name]})


def places(n, seed=0):
    return np.random.default_rng(seed).uniform(0, 1023, (2, n))


def directions(camera, n, seed=0):
    return unproject(camera, *places(n, seed))


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE])
def test_derivatives_are_those_of_small_changes(camera):
    u = directions(camera, 50)
    J_turn, J_optics = image_derivatives(camera, u)
    here = np.stack(project(camera, u), axis=1)
    for k, name in enumerate(OPTICS):
        there = np.stack(project(changed(name, camera), u), axis=1)
        np.testing.assert_allclose(J_optics[:, :, k] * SMALL[name], there - here, atol=1e-6)
    for k in range(3):
        turned = Rotation.from_rotvec(1e-6 * np.eye(3)[k]).apply(u)
        there = np.stack(project(camera, turned), axis=1)
        np.testing.assert_allclose(J_turn[:, :, k] * 1e-6, there - here, atol=1e-7)


@pytest.mark.parametrize("name", OPTICS)
def test_attitudes_turn_as_scipy_finds_with_other_optics(name):
    u, offsets = directions(CAMERA, 40), np.array([0, 4, 12, 40])
    one = np.array([[name == other for other in OPTICS]], float) * SMALL[name]
    cov = shared_attitude_covariance(CAMERA, one.T @ one, u, np.full(40, 1e-5), offsets)
    other = unproject(changed(name), *project(CAMERA, u))
    for k in range(3):
        of = slice(offsets[k], offsets[k + 1])
        turn = Rotation.align_vectors(other[of], u[of])[0].as_rotvec()
        np.testing.assert_allclose(cov[k], np.outer(turn, turn), rtol=0.02, atol=1e-15)


@pytest.mark.parametrize("name", OPTICS)
def test_directions_move_as_with_other_optics_and_their_attitude(name):
    side = np.linspace(0, 1023, 30)
    stars = unproject(CAMERA, *(axis.ravel() for axis in np.meshgrid(side, side)))
    attitude = Rotation.align_vectors(unproject(changed(name), *project(CAMERA, stars)), stars)[0]
    x_px, y_px = places(20, 1)
    u, other = unproject(CAMERA, x_px, y_px), unproject(changed(name), x_px, y_px)
    from_stars = np.arange(20) % 2 == 0
    moved = np.where(from_stars[:, None], attitude.inv().apply(other), other) - u
    one = np.array([[name == n for n in OPTICS]], float) * SMALL[name]
    cov = shared_direction_covariance(CAMERA, one.T @ one, u, from_stars)
    # A hundredth of the largest: the pipeline's own stars are fewer places.
    largest = np.abs(cov).max()
    np.testing.assert_allclose(cov, moved[:, :, None] * moved[:, None, :], atol=0.1 * largest)


@pytest.mark.parametrize("name", ["fx_px", "k1", "p1"])
def test_attitudes_from_few_stars_scatter_with_other_optics(name):
    n, frames = 12, 300
    u, other = (unproject(c, *places(n * frames)) for c in (CAMERA, changed(name)))
    turns = np.array([
        Rotation.align_vectors(other[k : k + n], u[k : k + n])[0].as_rotvec()
        for k in range(0, n * frames, n)
    ])  # fmt: skip
    one = np.array([[name == other for other in OPTICS]], float) * SMALL[name]
    sigma = np.sqrt(np.diag(few_stars_covariance(CAMERA, one.T @ one)) / n)
    # About the boresight a field of 20 degrees hardly matters for directions.
    np.testing.assert_allclose(turns.std(axis=0)[:2], sigma[:2], atol=0.2 * sigma.max())


def test_attitude_and_principal_point_compensate_each_other():
    cov = np.zeros((9, 9))
    cov[2, 2] = cov[3, 3] = 5.0**2  # px
    u = directions(CAMERA, 100)
    stars, prior = np.ones(100, bool), np.zeros(100, bool)
    ours = np.trace(shared_direction_covariance(CAMERA, cov, u, stars), axis1=1, axis2=2)
    alone = np.trace(shared_direction_covariance(CAMERA, cov, u, prior), axis1=1, axis2=2)
    np.testing.assert_allclose(np.sqrt(alone / 2), 5.0 * CAMERA.pixel_rad, rtol=0.1)
    assert np.sqrt(ours.max()) < 0.05 * np.sqrt(alone.min())


def test_corners_that_show_nothing_are_left_out():
    folds = Camera(1000, 1000, 500.0, 500.0, 499.5, 499.5, k1=-0.25)
    assert np.isnan(unproject(folds, np.zeros(1), np.zeros(1))).all()
    cov = np.diag([1.0, 1.0, 0.25, 0.25, 1e-6, 1e-6, 1e-8, 1e-8, 1e-6])
    u = unproject(folds, np.array([500.0, 600.0, 300.0]), np.array([500.0, 400.0, 650.0]))
    for from_stars in (True, False):
        found = shared_direction_covariance(folds, cov, u, np.full(3, from_stars))
        assert np.isfinite(found).all()
    assert np.isfinite(few_stars_covariance(folds, cov)).all()


def test_no_attitudes_have_no_covariances():
    none = np.empty((0, 3))
    cov = shared_attitude_covariance(CAMERA, np.eye(9), none, np.empty(0), np.zeros(1, int))
    assert cov.shape == (0, 3, 3)
    assert shared_direction_covariance(CAMERA, np.eye(9), none, np.empty(0, bool)).shape == (
        0,
        3,
        3,
    )
