"""What the Earth hides, against a walk along the line of sight; where the field of a lens ends."""

import numpy as np
import pytest

from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.simulation.optics import TrueOptics, field_radius, hidden_by_earth


def test_the_earth_hides_what_a_walk_along_the_line_of_sight_runs_into():
    rng = np.random.default_rng(0)
    r_km = rng.normal(size=(400, 3))
    r_km *= (rng.uniform(6900, 12000, 400) / np.linalg.norm(r_km, axis=1))[:, None]
    target_km = rng.normal(size=(400, 3)) * 9000
    target_km = target_km[np.linalg.norm(target_km, axis=1) > 6500]
    r_km = r_km[: len(target_km)]
    d_km = target_km - r_km
    distance = np.linalg.norm(d_km, axis=1)
    walk = r_km[:, None] + np.linspace(0, 1, 4001)[None, :, None] * d_km[:, None]
    lowest = np.linalg.norm(walk, axis=2).min(axis=1)
    clear = np.abs(lowest - EARTH_RADIUS_KM) > 1.0  # steps of 10 km do not tell closer than so
    hidden = hidden_by_earth(r_km, d_km / distance[:, None], distance)
    assert 50 < hidden.sum() < len(hidden) - 50
    np.testing.assert_array_equal(hidden[clear], (lowest < EARTH_RADIUS_KM)[clear])


@pytest.mark.parametrize("k1", [-0.3, -0.5, -1.0])
def test_the_field_of_a_lens_that_folds_ends_where_it_folds(k1):
    fold_rad = np.arctan(np.sqrt(1 / (-3 * k1)))
    wide = TrueOptics(1000, 1000, 500.0, 500.0, 499.5, 499.5, k1)
    assert field_radius(wide) == pytest.approx(fold_rad)
    narrow = wide._replace(fx_px=5000.0, fy_px=5000.0)
    assert field_radius(narrow) == pytest.approx(np.arctan(0.1 * np.sqrt(2)), rel=0.05)
