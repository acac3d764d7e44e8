"""Spans: named by their times, counted from 1970, none over a midnight."""

import numpy as np

from epipole.schemas.spans import DAY_NS, SPAN_NS, Span, spans_between

START_NS = int(np.datetime64("2019-04-01T23:30", "ns").astype(np.int64))


def test_a_span_is_named_by_its_times():
    assert str(Span(START_NS, START_NS + SPAN_NS)) == "23:30-00:00"


def test_spans_cover_a_time_and_hold_no_midnight():
    spans = spans_between(START_NS + 1, START_NS + 5 * SPAN_NS - 1)
    assert [spans[0].start_ns, spans[-1].end_ns] == [START_NS, START_NS + 5 * SPAN_NS]
    assert all(span.start_ns // DAY_NS == (span.end_ns - 1) // DAY_NS for span in spans)


def test_a_span_holds_its_start_and_not_its_end():
    span = Span(START_NS, START_NS + SPAN_NS)
    assert span.holds(np.array([span.start_ns - 1, *span, span.end_ns - 1])).tolist() == [
        False, True, False, True,
    ]  # fmt: skip
