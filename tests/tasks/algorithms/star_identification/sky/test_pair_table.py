"""The table of catalogue pairs."""

import numpy as np

from epipole.tasks.algorithms.star_identification.sky.kvector import range_of
from epipole.tasks.algorithms.star_identification.sky.pair_table import NEAR_SHARE, build_pair_table


def _units(n):
    u = np.random.default_rng(3).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def test_the_table_has_every_pair_within_reach_once():
    u = _units(300)
    table = build_pair_table(u, np.radians(20))
    separation = np.degrees(np.arccos(np.clip(u @ u.T, -1, 1)))
    i, j = np.nonzero(np.triu(separation < 20, 1))
    assert set(zip(table.first, table.second, strict=True)) == set(zip(i, j, strict=True))
    assert np.all(table.first < table.second)


def test_a_separation_is_found_by_its_chord():
    u = _units(300)
    table = build_pair_table(u, np.radians(20))
    k = len(table.first) // 2
    chord = np.linalg.norm(u[table.first[k]] - u[table.second[k]])
    first, last = range_of(table.chord, chord - 1e-9, chord + 1e-9)
    assert first <= k < last


def test_stars_far_apart_make_an_empty_table():
    table = build_pair_table(np.eye(3), 0.1)
    assert len(table.first) == 0
    assert range_of(table.chord, 0.0, 1.0) == (0, 0)


def test_each_star_has_all_its_near_neighbours():
    u = _units(400)
    table = build_pair_table(u, np.radians(30))
    near, chord = table.near, np.linalg.norm(u[:, None] - u[None], axis=2)
    assert near.reach == NEAR_SHARE * 2 * np.sin(np.radians(15))
    for k in (0, 17, 399):
        rows = slice(near.first[k], near.first[k + 1])
        wanted = np.flatnonzero((chord[k] <= near.reach) & (np.arange(400) != k))
        assert sorted(near.other[rows].tolist()) == wanted.tolist()
        np.testing.assert_allclose(near.chord[rows], chord[k, near.other[rows]], atol=1e-15)
