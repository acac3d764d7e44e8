"""Boresight and focal length from a few stars, against SciPy."""

import doctest
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import brentq, least_squares, lsq_linear
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry import boresight
from epipole.tasks.algorithms.geometry.boresight import (
    attitude_error,
    best_three,
    boresight_and_focal_length,
    boresight_covariance,
    boresight_of_three,
    focal_length_from_separations,
)

FOCAL_PX = 2435.7  # 12 degrees on 512 px
ARCSEC = np.pi / 648000
PAGE = Path(__file__).parents[4] / "docs" / "methods" / "boresight.md"
SEEDS = st.integers(0, 2**32 - 1)


def stars(seed, n=3, noise_px=0.0):
    """Return n stars of a random field: places from the principal point, apparent directions,
    and the attitude (sensor from ICRS)."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-256, 256, (n, 2))
    v = np.column_stack([x, np.full(n, FOCAL_PX)])
    R = Rotation.random(random_state=seed).as_matrix()
    u = (v / np.linalg.norm(v, axis=1, keepdims=True)) @ R
    return x + rng.normal(0, 1, (n, 2)) * noise_px, u, R


def squared_length(focal_px, u, a):
    """Return |d|^2 - 1 of the boresight that solves the linear system."""
    d = np.linalg.solve(u, focal_px / np.hypot(focal_px, a))
    return d @ d - 1


def spread(x):
    """Return the area of the triangle of the first three places [px^2]."""
    (ax, ay), (bx, by) = x[1] - x[0], x[2] - x[0]
    return abs(ax * by - ay * bx) / 2


@given(seed=SEEDS)
def test_three_stars_give_the_boresight_without_noise(seed):
    x, u, R = stars(seed)
    assume(spread(x) > 2000)
    d = boresight_of_three(u, np.hypot(*x.T), FOCAL_PX)
    assert np.linalg.norm(d - R[2]) < 0.01 * ARCSEC


def test_with_noise_the_closed_form_solves_the_same_equations_as_scipy():
    for seed in range(20):
        x, u, _ = stars(seed, noise_px=0.5)
        a = np.hypot(*x.T)
        cosines = FOCAL_PX / np.hypot(FOCAL_PX, a)
        found = lsq_linear(u, cosines)
        if spread(x) > 2000:
            d = found.x / np.linalg.norm(found.x)
            assert np.linalg.norm(boresight_of_three(u, a, FOCAL_PX) - d) < 0.01 * ARCSEC


def test_the_focal_length_is_where_scipy_finds_the_length_to_be_one():
    solved = 0
    for seed in range(40):
        x, u, _ = stars(seed, noise_px=0.05)
        a = np.hypot(*x.T)
        d, f = boresight_and_focal_length(u, a, 1.05 * FOCAL_PX)
        if not np.isfinite(f):
            continue
        low, high = 0.999 * f, 1.001 * f
        root = brentq(squared_length, low, high, args=(u, a), xtol=1e-9)
        assert abs(root - f) < 1e-5
        assert abs(np.linalg.norm(d) - 1) < 1e-12
        solved += 1
    assert solved >= 30


@given(seed=SEEDS)
def test_newton_recovers_the_focal_length_of_a_perfect_image(seed):
    x, u, R = stars(seed)
    a = np.hypot(*x.T)
    assume(spread(x) > 2000)
    # There may be a second root nearby, or a double one.
    lengths = [squared_length(f, u, a) for f in np.linspace(0.9, 1.1, 401) * FOCAL_PX]
    assume(np.sum(np.diff(np.sign(lengths)) != 0) == 1)
    assume(abs(lengths[210] - lengths[190]) > 1e-6)
    # Newton may leave where the length turns near the start.
    slopes = np.diff(lengths)[180:260]
    assume(slopes.max() * slopes.min() > 0 and np.ptp(np.abs(slopes)) < 0.5 * np.abs(slopes).max())
    d, f = boresight_and_focal_length(u, a, 1.01 * FOCAL_PX)
    assert abs(f - FOCAL_PX) < 1e-3
    assert np.linalg.norm(d - R[2]) < 0.01 * ARCSEC


@given(seed=SEEDS, n=st.integers(2, 12), start=st.floats(0.7, 1.4))
def test_separations_give_the_focal_length_of_a_perfect_image(seed, n, start):
    x, u, _ = stars(seed, n)
    assume(np.linalg.norm(x[0] - x[1]) > 20)
    assert abs(focal_length_from_separations(x, u, start * FOCAL_PX) - FOCAL_PX) < 1e-4


def test_with_noise_separations_are_fitted_as_scipy_fits_them():
    for seed in range(10):
        x, u, _ = stars(seed, 8, noise_px=0.5)
        i, j = np.triu_indices(8, 1)
        wanted = np.arccos(np.sum(u[i] * u[j], axis=1))

        def miss(f, x=x, i=i, j=j, wanted=wanted):
            v = np.column_stack([x, np.full(len(x), f[0])])
            v /= np.linalg.norm(v, axis=1, keepdims=True)
            return np.arccos(np.sum(v[i] * v[j], axis=1)) - wanted

        f = least_squares(miss, [FOCAL_PX], x_scale=FOCAL_PX, xtol=1e-15, ftol=1e-15).x[0]
        assert abs(focal_length_from_separations(x, u, 1.1 * FOCAL_PX) - f) < 0.01


def test_the_error_transfer_is_that_of_an_unbound_matrix():
    # Columns of a matrix A with A r_i = u_i, by SciPy-like least squares, over many seeds:
    # each row errs by sigma^2 (R R')^-1; the transfer says half of the trace.
    rng = np.random.default_rng(0)
    u = stars(3, 5)[1]
    sigma = 1e-5
    rows = np.linalg.lstsq(u, u[:, :1] + rng.normal(0, sigma, (5, 20000)), rcond=None)[0]
    variance = np.sum(np.var(rows, axis=1))
    assert abs(attitude_error(u, sigma) / np.sqrt(variance / 2) - 1) < 0.03


def test_the_best_three_stars_are_those_that_err_least():
    for seed in range(5):
        u = stars(seed, 9)[1]
        wanted = min(combinations(range(9), 3), key=lambda k: attitude_error(u[list(k)], 1.0))
        assert tuple(best_three(u)) == wanted


def test_a_wider_triangle_errs_less():
    u = stars(0, 3)[1]
    middle = u.mean(axis=0) / np.linalg.norm(u.mean(axis=0))
    narrow = u + 2 * middle
    narrow /= np.linalg.norm(narrow, axis=1, keepdims=True)
    assert attitude_error(u, 1e-5) < attitude_error(narrow, 1e-5)


def test_stars_on_one_great_circle_are_refused():
    angle = np.array([0.0, 0.05, 0.1])
    u = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    with pytest.raises(ValueError, match="great circle"):
        boresight_of_three(u, np.array([10.0, 50.0, 100.0]), FOCAL_PX)
    assert attitude_error(u, 1e-5) == np.inf


def test_too_few_stars_are_refused():
    x, u, _ = stars(0, 2)
    with pytest.raises(ValueError, match="three stars"):
        boresight_of_three(u, np.hypot(*x.T), FOCAL_PX)
    with pytest.raises(ValueError, match="two or more"):
        focal_length_from_separations(x[:1], u[:1], FOCAL_PX)
    with pytest.raises(ValueError, match="three or more"):
        best_three(u)


def test_one_spot_twice_fixes_no_focal_length():
    assert np.isnan(focal_length_from_separations(np.zeros((2, 2)), np.eye(3)[:2], FOCAL_PX))


def test_the_covariance_is_honest_over_many_trials():
    rng = np.random.default_rng(2)
    for seed in range(3):
        x, u, R = stars(seed)
        cov = boresight_covariance(u, np.hypot(*x.T), FOCAL_PX, 0.1)
        shaken = x + rng.normal(0, 0.1, (3000, 3, 2))
        d = np.array([boresight_of_three(u, np.hypot(*p.T), FOCAL_PX) for p in shaken])
        across = (d - R[2]) @ R[:2].T
        whitened = across @ np.linalg.inv(np.linalg.cholesky(R[:2] @ cov @ R[:2].T)).T
        np.testing.assert_allclose(np.cov(whitened.T), np.eye(2), atol=0.1)  # 3000 trials: 0.03


def test_the_examples_of_the_docstrings_run():
    result = doctest.testmod(boresight)
    assert result.attempted > 0
    assert result.failed == 0


def test_the_example_of_the_page_runs():
    result = doctest.testfile(str(PAGE), module_relative=False)
    assert result.attempted > 0
    assert result.failed == 0
