"""Errors of a direction: how much scatters beyond the stated errors."""

import numpy as np
import pytest

from epipole.tasks.algorithms.geometry.direction_errors import scatter_beyond


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
