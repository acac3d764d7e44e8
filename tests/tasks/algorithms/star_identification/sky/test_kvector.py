"""K-vector range search."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from epipole.tasks.algorithms.star_identification.sky.kvector import build_kvector, range_of

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
