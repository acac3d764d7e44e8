"""Look-ups in the catalogue by direction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.random_stars import optics, random_catalogue
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.star_identification.star_grid import (
    BANDS,
    MAX_PAIRS,
    PATTERN_STARS,
    SECTORS,
    build_sky_grid,
    by_bands,
    cell_at,
    cells_of_cone,
    find_in_cone,
    nearest_star,
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)


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


CATALOGUE = random_catalogue(20_000)


def test_a_sky_holds_the_stars_to_its_limit_and_their_mean_density():
    sky = sky_to_limit(CATALOGUE, 5.0)
    np.testing.assert_array_equal(
        sky.catalogue.magnitude, CATALOGUE.magnitude[CATALOGUE.magnitude <= 5]
    )
    assert sky.rho == pytest.approx(len(sky.catalogue.star_id) / (4 * np.pi))


def test_a_field_shows_about_as_many_pattern_stars_as_wanted():
    sky = sky_to_limit(CATALOGUE, 99.0)
    share = optics().solid_angle_sr / (4 * np.pi)
    assert pattern_size(sky, optics().solid_angle_sr) * share == pytest.approx(
        PATTERN_STARS, abs=0.1
    )
    assert pattern_size(sky, 1e-9) == 20_000


def test_pairs_of_a_dense_sky_stay_within_their_number():
    pairs = pattern_pairs(CATALOGUE.u_icrs, 1.0)
    assert 0.9 * MAX_PAIRS < len(pairs.first) < 1.1 * MAX_PAIRS


def test_the_grid_is_for_the_radius_asked():
    assert sky_grid(sky_to_limit(CATALOGUE, 4.0), 0.01).radius_rad == 0.01


def test_a_limit_brighter_than_every_star_leaves_an_empty_sky():
    sky = sky_to_limit(CATALOGUE, -30.0)
    assert len(sky.catalogue.star_id) == 0
    assert sky.rho > 0


POLES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
SEAM = np.array([[-1.0, 0.0, 0.0], [-1.0, -1e-17, 0.0], [-1.0, 1e-9, 0.0]])


def directions(seed, n):
    u = np.random.default_rng(seed).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def rows_of_cone(stars, centre, angle):
    """Return the rows of the stars in the cells of a cone."""
    cone = cells_of_cone(*centre, np.cos(angle))
    cells = [
        cell_at(band, sector)
        for band in range(cone.low, cone.high + 1)
        for sector in range(cone.left, cone.left + cone.n_sectors)
    ]
    assert len(set(cells)) == len(cells)
    rows = [np.arange(stars.first[cell], stars.first[cell + 1]) for cell in cells]
    return np.concatenate(rows)


@pytest.mark.parametrize("angle", [1e-4, 0.02, 0.2, 1.0, 1.57])
def test_all_stars_of_a_cone_are_in_its_cells(angle):
    u = np.concatenate([directions(0, 5000), POLES, SEAM])
    stars = by_bands(u)
    near_pole = POLES[0] + 0.01 * directions(2, 20)
    near_pole /= np.linalg.norm(near_pole, axis=1, keepdims=True)
    for centre in np.concatenate([directions(1, 60), POLES, SEAM, near_pole, -near_pole]):
        inside = np.flatnonzero(stars.u @ centre > np.cos(angle))
        assert np.isin(inside, rows_of_cone(stars, centre, angle)).all()


def test_a_narrow_cone_has_few_cells():
    stars = by_bands(directions(3, 20_000))
    for centre in directions(4, 100):
        assert len(rows_of_cone(stars, centre, 0.05)) < 0.05 * len(stars.u)


def test_each_star_is_in_one_cell():
    u = np.concatenate([directions(5, 3000), POLES, SEAM])
    stars = by_bands(u)
    assert stars.first[0] == 0
    assert stars.first[-1] == len(u)
    assert len(stars.first) == BANDS * SECTORS + 1
    np.testing.assert_array_equal(np.sort(stars.u, axis=0), np.sort(u, axis=0))


def test_cells_have_the_same_area():
    count = np.diff(by_bands(directions(6, 400_000)).first)
    expected = 400_000 / (BANDS * SECTORS)
    assert np.mean((count - expected) ** 2 / expected) == pytest.approx(1.0, abs=0.15)


def test_without_stars_all_cells_are_empty():
    stars = by_bands(np.zeros((0, 3)))
    assert not stars.first.any()
    assert len(rows_of_cone(stars, POLES[0], 0.3)) == 0


@pytest.mark.parametrize("angle", [0.02, 0.2, 1.5])
def test_the_stars_of_a_cone_are_found_with_their_rows(angle):
    u = directions(7, 5000)
    stars, at = by_bands(u), np.empty(5000, np.int32)
    for centre in np.concatenate([directions(8, 20), POLES]):
        n = find_in_cone(stars, *centre, np.cos(angle), at)
        rows = np.sort(stars.row[at[:n]])
        np.testing.assert_array_equal(rows, np.flatnonzero(u @ centre > np.cos(angle)))
    np.testing.assert_array_equal(u[stars.row], stars.u)
