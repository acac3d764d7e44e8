"""The table of catalogue pairs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from epipole.tasks.algorithms.star_identification.star_pairs import (
    NEAR_SHARE,
    build_kvector,
    build_pair_table,
    range_of,
)


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


finite = st.floats(-1e6, 1e6)


@settings(deadline=None)  # the first call compiles
@given(arrays(float, st.integers(0, 60), elements=finite), finite, finite)
def test_a_range_holds_what_a_comparison_finds(values, a, b):
    s, (low, high) = np.sort(values), sorted((a, b))
    first, last = range_of(build_kvector(s), low, high)
    np.testing.assert_array_equal(s[first:last], s[(s >= low) & (s <= high)])


@settings(deadline=None)  # the first call compiles
@given(arrays(float, st.integers(1, 60), elements=st.sampled_from([0.0, 1.0, 2.0, 2.5])))
def test_equal_elements_are_all_found(values):
    s = np.sort(values)
    first, last = range_of(build_kvector(s), s[0], s[-1])
    assert (first, last) == (0, len(s))


def test_the_index_is_the_papers_line():
    # Yuan, Zhang, Shi (2017): d = (s(n) - s(1)) / (n - 1), a1 = d n / (n - 1) over k = 1 .. n.
    s = np.sort(np.random.default_rng(0).uniform(0, 1, 1000))
    k = build_kvector(s)
    d = (s[-1] - s[0]) / (len(s) - 1)
    assert abs(k.intercept - (s[0] - d / 2)) < 1e-12
    assert abs(k.intercept + k.slope * len(s) - (s[-1] + d / 2)) < 1e-12
    line = k.intercept + k.slope * np.arange(1, len(s))
    np.testing.assert_array_equal(k.below[1:-1], [np.sum(s <= z) for z in line])


def test_a_far_range_is_empty_and_an_infinite_one_is_all():
    k = build_kvector(np.arange(10.0))
    assert range_of(k, 1e300, 1e301) == (0, 0)
    assert range_of(k, -1e300, 1e300) == (0, 10)
    assert range_of(k, 3.0, 2.0) == (0, 0)


def test_a_vector_that_does_not_ascend_is_refused():
    with pytest.raises(ValueError, match="ascending"):
        build_kvector(np.array([2.0, 1.0]))
