"""Stars in a cone, against a search of all stars."""

import numpy as np
import pytest

from epipole.tasks.algorithms.simulation.star_field import star_field, stars_in_cones


@pytest.mark.parametrize("radius_deg", [0.5, 7.0, 40.0])
def test_stars_in_cones_are_those_that_a_search_of_all_stars_finds(radius_deg):
    rng = np.random.default_rng(2)
    z = rng.uniform(-1, 1, 3000)
    zeros = np.zeros(3000)
    field = star_field(
        np.arange(3000), rng.uniform(0, 2 * np.pi, 3000), np.arcsin(z), zeros, zeros, zeros,
        zeros, epoch=1991.25, radius_rad=np.radians(radius_deg),
    )  # fmt: skip
    u = rng.normal(size=(40, 3))
    u = np.concatenate([u / np.linalg.norm(u, axis=1)[:, None], np.eye(3), -np.eye(3)])
    cone, star = stars_in_cones(field, u, np.radians(radius_deg))
    expected = np.argwhere(u @ field.place.T >= np.cos(np.radians(radius_deg)))
    order = np.lexsort((star, cone))
    np.testing.assert_array_equal(np.stack([cone, star], axis=1)[order], expected)
