"""Time slices: they cover a span, hold every row once, and depend on the rows only."""

import itertools

import numpy as np
import pytest
from scenes.associations import filled

from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.tables import EPOCHS
from epipole.tasks.publish.time_slices import MOST_ROWS, rows_between, slices_of

SPAN = Span(7 * SPAN_NS, 8 * SPAN_NS)


@pytest.mark.parametrize(
    ("n_rows", "count"),
    [(0, 1), (1, 1), (MOST_ROWS, 1), (MOST_ROWS + 1, 2), (7 * MOST_ROWS - 1, 7)],
)
def test_slices_cover_the_span_without_gaps(n_rows, count):
    slices = slices_of(SPAN, n_rows)
    assert len(slices) == count
    assert (slices[0].start_ns, slices[-1].end_ns) == SPAN
    assert all(a.end_ns == b.start_ns for a, b in itertools.pairwise(slices))
    lengths = [time.end_ns - time.start_ns for time in slices]
    assert max(lengths) - min(lengths) <= 1


def epochs(*times_ns: int):
    return filled(EPOCHS, len(times_ns), {"epoch": list(times_ns), "frame_number": times_ns})


def test_a_slice_has_its_start_and_not_its_end():
    rows = epochs(9, 10, 10, 19, 20, 21)
    (found,) = rows_between([rows], Span(10, 20), "epoch")
    assert found["frame_number"].to_pylist() == [10, 10, 19]


def test_slices_together_have_every_row_once_in_order():
    rng = np.random.default_rng(0)
    tables = [
        epochs(*np.sort(rng.integers(SPAN.start_ns, SPAN.end_ns, n)).tolist()) for n in (0, 1, 500)
    ]
    cut = [rows_between(tables, time, "epoch") for time in slices_of(SPAN, 5 * MOST_ROWS)]
    assert all(len(of_slice) == len(tables) for of_slice in cut)
    for k, rows in enumerate(tables):
        times = [t for of_slice in cut for t in of_slice[k]["frame_number"].to_pylist()]
        assert times == rows["frame_number"].to_pylist()
