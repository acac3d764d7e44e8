"""Small symmetric matrices, as NumPy inverts and solves them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epipole.tasks.algorithms.symmetric_matrices import (
    determinant3,
    factor,
    invert_symmetric,
    solve_factored,
)

seeds = st.integers(0, 2**32 - 1)


def positive(seed, n=3):
    A = np.random.default_rng(seed).normal(size=(n, n))
    return A @ A.T + np.eye(n)


@settings(deadline=None)  # the first call compiles
@given(seeds)
def test_a_symmetric_matrix_is_inverted(seed):
    A, out = positive(seed), np.empty((3, 3))
    assert abs(invert_symmetric(A, out) / np.linalg.det(A) - 1) < 1e-9
    assert abs(determinant3(A) / np.linalg.det(A) - 1) < 1e-9
    np.testing.assert_allclose(out @ A, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(out, out.T)


def test_the_upper_half_is_enough_and_the_inverse_may_replace_the_matrix():
    A, out = positive(1), np.empty((3, 3))
    upper = np.triu(A)
    invert_symmetric(A, out)
    invert_symmetric(upper, upper)
    np.testing.assert_array_equal(upper, out)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_a_matrix_that_is_not_positive_has_determinant_zero_and_no_inverse(value):
    out = np.full((3, 3), 7.0)
    assert invert_symmetric(value * np.eye(3), out) == 0.0
    assert (out == 7.0).all()


@pytest.mark.parametrize("n", [1, 4, 6])
def test_normal_equations_are_solved(n):
    N, b = positive(n, n), np.arange(1.0, n + 1)
    L, x = N.copy(), b.copy()
    assert abs(factor(L, x) - np.linalg.slogdet(N)[1]) < 1e-9
    np.testing.assert_allclose(x, np.linalg.solve(N, b), rtol=1e-9)
    again = b.copy()
    solve_factored(L, again)
    np.testing.assert_allclose(again, x, rtol=1e-12)
    assert np.isnan(factor(-N, b))
