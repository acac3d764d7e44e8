"""Triangulation: exact without noise, honest with it, and NaN where there is no point."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.geometry.triangulation import triangulate

METRE = 1e-3  # km
GEO = np.array([-39359.89, 15125.76, 64.30])


def sensors(rng, n):
    r = rng.normal(size=(n, 3))
    return 7000.0 * r / np.linalg.norm(r, axis=1, keepdims=True)


def look(r, x, rng=None, sigma=0.0):
    u = (x - r) / np.linalg.norm(x - r, axis=1, keepdims=True)
    if rng is not None:
        u = u + np.einsum("na,nai->ni", rng.normal(size=(len(r), 2)) * sigma, tangent_basis(u))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def solve(r, u, sigma, *, offsets=None, sigma_km=0.0, velocity=None, reject=4.0):
    offsets = np.array([0, len(r)]) if offsets is None else offsets
    n, g = len(r), len(offsets) - 1
    return triangulate(
        offsets,
        r,
        u,
        np.broadcast_to(np.eye(2) * sigma**2, (n, 2, 2)),
        np.full(n, sigma_km),
        np.zeros((g, 3)) if velocity is None else velocity,
        reject,
    )


@pytest.mark.parametrize("n", [2, 3, 4, 20])
def test_it_finds_the_point_without_noise(n):
    r = sensors(np.random.default_rng(n), n)
    x, _, chi2, used, *_ = solve(r, look(r, GEO), ARCSEC)
    np.testing.assert_allclose(x[0], GEO, atol=METRE)
    assert chi2[0] < 1e-6
    assert used.all()


def test_it_agrees_with_a_general_least_squares_solver():
    rng = np.random.default_rng(3)
    r = sensors(rng, 4)
    sigma = ARCSEC * np.array([1.0, 2.0, 0.5, 3.0])
    u = look(r, GEO, rng, sigma[:, None])
    cov = np.eye(2) * sigma[:, None, None] ** 2
    x, cov_km2, chi2, *_ = triangulate(
        np.array([0, 4]), r, u, cov, np.full(4, 0.2), np.zeros((1, 3)), 99.0
    )

    def residual(at):
        d = at - r
        rho = np.linalg.norm(d, axis=1)
        e = np.einsum("nai,ni->na", tangent_basis(u), d) / rho[:, None]
        return (e / np.sqrt(sigma**2 + (0.2 / rho) ** 2)[:, None]).ravel()

    best = least_squares(residual, GEO, x_scale=1e4, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(x[0], best.x, atol=10 * METRE)
    np.testing.assert_allclose(chi2[0], 2 * best.cost, rtol=1e-6)
    # The range changes by the error over the range only: 1e-4 of the covariance.
    np.testing.assert_allclose(cov_km2[0], np.linalg.inv(best.jac.T @ best.jac), rtol=2e-3)


def test_the_covariance_is_honest_over_many_trials():
    rng = np.random.default_rng(4)
    trials, sigma, sigma_km = 3000, 3 * ARCSEC, 0.3
    r = sensors(rng, 4)
    true_r = np.tile(r, (trials, 1))
    u = look(true_r, GEO, rng, sigma)
    believed = true_r + rng.normal(size=true_r.shape) * sigma_km
    x, cov, chi2, used, *_ = solve(
        believed, u, sigma, offsets=np.arange(trials + 1) * 4, sigma_km=sigma_km, reject=9.0
    )
    assert used.all()
    e = x - GEO
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
    assert abs(nees.mean() / 3 - 1) < 0.05
    assert abs(np.mean(nees < 11.345) - 0.99) < 0.006
    assert abs(chi2.mean() / 5 - 1) < 0.05


def test_a_wrong_view_is_left_out_and_named():
    rng = np.random.default_rng(5)
    r = sensors(rng, 5)
    u = look(r, GEO, rng, ARCSEC)
    u[2] = look(r[2:3], GEO + np.array([0, 0, 100.0]))[0]  # 9 arcmin away
    x, cov, _, used, *_ = solve(r, u, ARCSEC)
    assert used.tolist() == [True, True, False, True, True]
    assert np.linalg.norm(x[0] - GEO) < 4 * np.sqrt(np.trace(cov[0]))


def test_light_time_puts_the_point_at_the_mean_emission():
    velocity = np.array([-1.1, -2.85, 0.01])
    r = np.array([[7000.0, 0, 0], [-7000.0, 0, 0], [0, 0, 7000.0]])
    # The light that a sensor gets at time 0 left the object earlier on its path.
    u = np.empty((3, 3))
    for i in range(3):
        x = GEO
        for _ in range(6):
            x = GEO - velocity * np.linalg.norm(x - r[i]) / SPEED_OF_LIGHT_KM_S
        u[i] = look(r[i : i + 1], x)[0]
    x, _, chi2, _, mean_range, *_ = solve(r, u, 0.001 * ARCSEC, velocity=velocity[None])
    expected = GEO - velocity * mean_range[0] / SPEED_OF_LIGHT_KM_S
    np.testing.assert_allclose(x[0], expected, atol=METRE)
    assert chi2[0] < 1.0


def test_parallel_lines_and_points_behind_have_no_position():
    r = np.array([[7000.0, 0, 0], [7000.0, 100.0, 0]])
    parallel = np.tile([0.0, 0.0, 1.0], (2, 1))
    x, _, chi2, used, *_ = solve(r, parallel, ARCSEC)
    assert np.isnan(x).all()
    assert np.isnan(chi2[0])
    assert not used.any()
    x, *_ = solve(r, -look(r, GEO), ARCSEC)
    assert np.isnan(x).all()


def test_views_that_are_parallel_without_a_wrong_one_have_no_position():
    r = np.array([[7000.0, 0, 0], [7000.0, 0.02, 0], [0, 7000.0, 0]])
    u = look(r, GEO)
    u[2] = look(r[2:], GEO + np.array([0, 0, 100.0]))[0]
    _, _, chi2, used, *_ = solve(r, u, ARCSEC, sigma_km=0.001)
    assert np.isnan(chi2[0])
    assert not used.any()


@pytest.mark.parametrize(("baseline_km", "share"), [(0.01, 0.0), (0.1, 0.5), (1.0, 1.0)])
def test_lines_that_are_parallel_within_their_errors_have_no_position(baseline_km, share):
    """Two cameras of one satellite: where their lines meet is chance."""
    rng, trials, sigma = np.random.default_rng(7), 1000, 2 * ARCSEC
    r = np.tile([[7000.0, 0.0, 0.0], [7000.0, baseline_km, 0.0]], (trials, 1))
    x_km = np.array([8500.0, 0.0, 0.0])
    u = look(r, x_km, rng, sigma)
    x, cov, chi2, used, *_ = solve(r, u, sigma, offsets=np.arange(trials + 1) * 2)
    has = np.isfinite(chi2)
    assert abs(has.mean() - share) < 0.05
    np.testing.assert_array_equal(used, np.repeat(has, 2))
    assert np.isnan(x[~has]).all()
    if share:
        off = x[has] - x_km
        nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov[has]), off)
        assert np.mean(nees < 11.345) > 0.85


def test_nothing_in_gives_nothing_out():
    x, cov, chi2, used, mean_range, *_ = solve(
        np.zeros((0, 3)), np.zeros((0, 3)), ARCSEC, offsets=np.zeros(1, int)
    )
    assert x.shape == (0, 3)
    assert cov.shape == (0, 3, 3)
    assert len(chi2) == len(used) == len(mean_range) == 0


def test_a_single_view_has_no_position():
    r = sensors(np.random.default_rng(6), 1)
    x, *_ = solve(r, look(r, GEO), ARCSEC)
    assert np.isnan(x).all()
