"""Look-ups in the catalogue by direction."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.star_identification.sky.sky_grid import build_sky_grid, nearest_star


def _units(seed, n):
    u = np.random.default_rng(seed).normal(size=(n, 3))
    # Many on the cube's edges and corners, where faces meet.
    u[: n // 4] = np.sign(u[: n // 4]) + 1e-3 * u[n // 4 : n // 4 + n // 4]
    u[n // 4 : n // 2, 0] = 0.0
    return u / np.linalg.norm(u, axis=1, keepdims=True)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.02, 0.003]))
def test_the_nearest_star_is_the_one_a_tree_finds(seed, radius):
    stars = _units(seed, 400)
    near = stars + np.random.default_rng(seed + 1).normal(0, radius / 2, stars.shape)
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    grid = build_sky_grid(stars, radius)
    found = [nearest_star(*u, radius, stars, grid.first, grid.star, grid.n_face)[0] for u in near]
    distance, want = cKDTree(stars).query(near)
    np.testing.assert_array_equal(found, np.where(distance < radius, want, -1))


def test_an_empty_catalogue_has_no_star():
    grid = build_sky_grid(np.empty((0, 3)), 0.01)
    star, _ = nearest_star(
        0.0, 0.0, 1.0, 0.01, np.empty((0, 3)), grid.first, grid.star, grid.n_face
    )
    assert star == -1
