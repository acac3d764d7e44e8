"""Time slices: together they hold every row of a span once, in order, whatever their number."""

from functools import partial

import numpy as np
import pytest
from scenes.associations import filled

from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.tables import EPOCHS
from epipole.tasks.publish import night_parts as time_slices
from epipole.tasks.publish.night_parts import in_slices

SPAN = Span(7 * SPAN_NS, 8 * SPAN_NS)


def epochs(*times_ns: int):
    return filled(EPOCHS, len(times_ns), {"epoch": list(times_ns), "frame_number": times_ns})


def test_rows_outside_the_span_are_left_out():
    rows = epochs(9, 10, 10, 19, 20, 21)
    (found,) = in_slices([lambda: rows], Span(10, 20), "epoch")
    assert found[0]["frame_number"].to_pylist() == [10, 10, 19]


@pytest.mark.parametrize(("most", "count"), [(501, 1), (500, 2), (100, 6)])
def test_slices_together_have_every_row_once_in_order(monkeypatch, most, count):
    monkeypatch.setattr(time_slices, "MAX_ROWS", most)
    monkeypatch.setattr(time_slices, "ROWS_OF_TABLE", 1)
    rng = np.random.default_rng(0)
    times = [np.sort(rng.integers(SPAN.start_ns, SPAN.end_ns, n)) for n in (0, 1, 500)]
    cut = list(
        in_slices([partial(epochs, *of_table.tolist()) for of_table in times], SPAN, "epoch")
    )
    assert len(cut) == count
    for k, of_table in enumerate(times):
        found = [t for of_slice in cut for t in of_slice[k]["frame_number"].to_pylist()]
        assert found == of_table.tolist()


def test_a_table_in_another_order_is_sorted():
    (found,) = in_slices([partial(epochs, 15, 11, 13)], Span(10, 20), "epoch")
    assert found[0]["frame_number"].to_pylist() == [11, 13, 15]


def test_no_rows_are_one_empty_slice():
    assert [rows[0].num_rows for rows in in_slices([epochs], SPAN, "epoch")] == [0]
    assert list(in_slices([], SPAN, "epoch")) == [[]]


def test_rows_of_a_small_part_of_a_span_are_divided_too(monkeypatch):
    monkeypatch.setattr(time_slices, "MAX_ROWS", 100)
    monkeypatch.setattr(time_slices, "ROWS_OF_TABLE", 1)
    wide = Span(0, 1_000_000)
    times = np.random.default_rng(0).integers(5_000, 6_000, 1_000).tolist()
    sizes = [rows[0].num_rows for rows in in_slices([partial(epochs, *times)], wide, "epoch")]
    assert sum(sizes) == 1_000
    assert max(sizes) < 120


def test_rows_of_one_time_are_never_divided(monkeypatch):
    monkeypatch.setattr(time_slices, "MAX_ROWS", 2)
    monkeypatch.setattr(time_slices, "ROWS_OF_TABLE", 1)
    read = partial(epochs, *[11] * 7, *[15] * 7)
    cut = [rows[0]["frame_number"].to_pylist() for rows in in_slices([read], Span(10, 20), "epoch")]
    assert [each for each in cut if each] == [[11] * 7, [15] * 7]
