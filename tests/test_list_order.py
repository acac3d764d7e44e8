"""Lists in another order."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epipole.tasks.algorithms.list_order import take_lists


def split(lists, cuts):
    """Return lists as pieces of values and offsets, cut at some rows."""
    edges = [0, *sorted(cuts), len(lists)]
    for low, high in itertools.pairwise(edges):
        part = lists[low:high]
        values = np.array([v for row in part for v in row], np.float32)
        # A piece's offsets need not begin at 0.
        padded = np.concatenate([np.full(3, -1, np.float32), values])
        offsets = 3 + np.concatenate([[0], np.cumsum([len(row) for row in part])])
        yield padded, offsets.astype(np.int32)


@settings(deadline=None)  # the first call loads a kernel
@given(st.data())
def test_rows_keep_their_values_wherever_they_go(data):
    number = st.integers(0, 1000)
    lists = data.draw(st.lists(st.lists(number, max_size=4), max_size=12))
    cuts = data.draw(st.lists(st.integers(0, len(lists)), max_size=3))
    order = data.draw(st.permutations(range(len(lists))))
    rows = np.array(order[: data.draw(st.integers(0, len(lists)))], np.int64)
    lengths = np.array([len(row) for row in lists], np.int64)
    values, first = take_lists(split(lists, cuts), lengths, rows)
    got = [values[a:b].tolist() for a, b in itertools.pairwise(first)]
    assert got == [[float(v) for v in lists[row]] for row in rows]


def test_no_lists_give_no_values():
    values, first = take_lists([], np.empty(0, np.int64), np.empty(0, np.int64))
    assert (len(values), first.tolist()) == (0, [0])


def test_a_row_that_is_not_there_is_an_error():
    with pytest.raises(IndexError):
        take_lists([], np.empty(0, np.int64), np.array([0]))
