"""Gather views: one per sensor, of objects that two sensors see, from all parts that have some."""

import numpy as np
import pyarrow.compute as pc
from scenes.object_members import SECOND_NS, SPANS, members, ns, seconds, views_of, write_spans

from epipole.schemas.bridge import empty
from epipole.schemas.spans import DAY_NS, Span
from epipole.schemas.work_tables import OBJECT_MEMBERS, VIEWS
from epipole.tasks.solve.positions.gather_views import gather_views

EVER = Span(SPANS[0].start_ns, SPANS[-1].end_ns)
BORDER = 1800.0  # between the first two spans [s]


def rows_of(views, number):
    """Each view's time [s], object, tracklet."""
    return list(zip(seconds(views), number.tolist(), views["tracklet_id"].to_pylist(), strict=True))


def test_views_are_those_of_the_members_in_the_order_of_epochs_objects_and_sensors(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2], "a2": [0, 1, 2], "a3": [0, 1, 2]}),
        views_of(1, {"b1": [0, 1, 2], "b2": [0, 1, 2]}),
    ])  # fmt: skip
    found = members(
        (4, 0, "a1", "a1", 0, 2, 3), (2, 0, "a2", "a2", 0, 2, 3),
        (4, 1, "b1", "b1", 0, 2, 3), (2, 1, "b2", "b2", 0, 2, 3),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    assert views.schema == VIEWS
    assert rows_of(views, number) == [
        (t, k, name)
        for t in (0.0, 1.0, 2.0)
        for k, names in ((2, ("a2", "b2")), (4, ("a1", "b1")))
        for name in names
    ]


def test_views_at_epochs_at_which_no_second_sensor_has_one_are_left_out(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2, 3], "a2": [5, 6]}), views_of(1, {"b1": [2, 3, 4]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 0, "a2", "a2", 5, 6, 2), (0, 1, "b1", "b1", 2, 4, 3)
    )
    views, number = gather_views(viewed, found, EVER)
    assert rows_of(views, number) == [(t, 0, name) for t in (2.0, 3.0) for name in ("a1", "b1")]


def test_two_fragments_in_one_sensor_count_as_one_view(tmp_path):
    """The one with a centroid, or else the first."""
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2, 3], "a2": [0, 1, 2, 3]},
                 missed=[("a1", 1), ("a1", 2), ("a2", 2)]),
        views_of(1, {"b1": [0, 1, 2]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 0, "a2", "a2", 0, 3, 4), (0, 1, "b1", "b1", 0, 2, 3)
    )
    views, number = gather_views(viewed, found, EVER)
    of_first = [row[2] for row in rows_of(views, number) if row[2] != "b1"]
    assert of_first == ["a1", "a2", "a1"]
    # At 3 s two fragments have a view, but they are of one sensor.
    assert set(seconds(views)) == {0.0, 1.0, 2.0}


def test_a_tracklet_of_two_objects_has_each_at_its_time(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 1, "b1", "b1", 0, 3, 4),
        (1, 0, "a1", "a1", 6, 9, 4), (1, 1, "b1", "b1", 6, 9, 4),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    assert seconds(views)[::2] == [0.0, 1.0, 2.0, 3.0, 6.0, 7.0, 8.0, 9.0]
    assert number.tolist() == [0] * 8 + [1] * 8


def test_views_outside_the_time_are_left_out(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 9, 10), (0, 1, "b1", "b1", 0, 9, 10))
    views, _ = gather_views(viewed, found, Span(ns(3), ns(6)))
    assert seconds(views)[::2] == [3.0, 4.0, 5.0]  # a span has its start, not its end


def test_only_epochs_that_are_multiples_of_a_time_are_gathered(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 9, 10), (0, 1, "b1", "b1", 0, 9, 10))
    views, number = gather_views(viewed, found, EVER, 4 * SECOND_NS)
    midnight_s = ns(0) % DAY_NS // SECOND_NS
    assert seconds(views)[::2] == [t for t in times if (midnight_s + t) % 4 == 0]
    assert len(number) == views.num_rows > 0


def test_members_outside_the_time_have_no_views(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 3, 4), (0, 1, "b1", "b1", 0, 3, 4))
    for time in (Span(ns(6), ns(9)), Span(ns(-9), ns(-2))):
        views, number = gather_views(viewed, found, time)
        assert (views.num_rows, len(number)) == (0, 0)


def test_views_of_neighbouring_spans_are_gathered_within_the_time(tmp_path):
    """A tracklet that continues lies elsewhere among the views of the next span."""
    times = np.arange(BORDER - 40, BORDER + 40, 10.0)
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": times, "a0": times[:2]}), views_of(1, {"b1": times, "b0": times[6:]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", BORDER - 40, BORDER - 10, 4), (0, 0, "a1", "a1", BORDER, BORDER + 30, 4),
        (0, 1, "b1", "b1", BORDER - 40, BORDER - 10, 4), (0, 1, "b1", "b1", BORDER, BORDER + 30, 4),
    )  # fmt: skip
    for span, first, last in ((SPANS[0], -40, 10), (SPANS[1], -20, 30)):
        views, number = gather_views(viewed, found, span.widened(20 * SECOND_NS))
        expected = np.arange(BORDER + first, BORDER + last + 1, 10.0)
        assert seconds(views)[::2] == expected.tolist()
        assert views["tracklet_id"].to_pylist() == ["a1", "b1"] * len(expected)
        assert set(number.tolist()) == {0}


def test_a_sensor_without_a_part_of_a_span_has_no_views_there(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [BORDER - 5.0, BORDER + 5.0]}), views_of(1, {"b1": [BORDER - 5.0]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", BORDER - 5, BORDER + 5, 2), (0, 1, "b1", "b1", BORDER - 5, BORDER - 5, 1)
    )
    views, _ = gather_views(viewed, found, EVER)
    assert seconds(views) == [BORDER - 5.0] * 2


def test_the_views_of_some_objects_do_not_depend_on_the_others(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": times, "a2": times}), views_of(1, {"b1": times, "b2": times}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 9, 10), (1, 0, "a2", "a2", 0, 9, 10),
        (0, 1, "b1", "b1", 0, 9, 10), (1, 1, "b2", "b2", 2, 7, 6),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    for k in (0, 1):
        alone, own = gather_views(viewed, found.filter(pc.field("object") == k), EVER)
        assert alone.equals(views.filter(number == k))
        assert (own == k).all()


def test_no_members_have_no_views(tmp_path):
    viewed = write_spans(tmp_path, [views_of(0, {"a1": [0.0]})])
    views, number = gather_views(viewed, empty(OBJECT_MEMBERS), EVER)
    assert views.equals(empty(VIEWS))
    assert len(number) == 0
