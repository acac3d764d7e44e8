"""Frame grids: a window misses nothing within its reach, wherever on the sky the frame lies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epipole.tasks.algorithms.tracking.sky_filter import fill_grid, make_grids, window


def found_in(grids, u, reach):
    x_from, x_to, y_from, y_to, side = window(grids, 0, u, reach)
    start, items = grids[2][0], grids[3][0]
    out = set()
    if x_from <= x_to:
        for y in range(y_from, y_to + 1):
            out.update(items[start[y * side + x_from] : start[y * side + x_to + 1]].tolist())
    return out


@settings(deadline=None)  # the first call compiles
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 300))
def test_all_within_reach_lie_in_the_window(seed, n):
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=3)
    centre /= np.linalg.norm(centre)
    u = centre + rng.normal(size=(n, 3)) * rng.choice([1e-6, 0.05, 0.3])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    grids = make_grids(2, n)
    fill_grid(grids, 0, u, 0, n)
    wanted = u[rng.integers(n)] if n else centre
    reach = rng.choice([0.0, 1e-6, 0.02, 0.5])
    near = np.flatnonzero(np.linalg.norm(u - wanted, axis=1) <= reach * (1 - 1e-9))
    assert set(near.tolist()) <= found_in(grids, wanted, reach + 1e-12)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
def test_detections_on_one_spot_on_an_axis_are_found(axis):
    u = np.tile(np.array(axis), (9, 1))
    grids = make_grids(1, 9)
    fill_grid(grids, 0, u, 0, 9)
    assert found_in(grids, u[0], 1e-9) == set(range(9))


def test_a_window_far_off_is_empty():
    rng = np.random.default_rng(0)
    u = np.array([0.0, 0.0, 1.0]) + rng.normal(size=(50, 3)) * 0.01
    grids = make_grids(1, 50)
    fill_grid(grids, 0, u, 0, 50)
    assert found_in(grids, np.array([1.0, 0.0, 0.0]), 0.01) == set()
