"""Objects followed over midnight: recognised by the detections that both nights share."""

import pyarrow as pa

from epipole.schemas.bridge import concat
from epipole.tasks.name.followed_objects import VIEWS, followed_objects


def views(*rows):
    """Rows: object, frame number, centroid, used; all of one sensor."""
    columns = ("object_id", "frame_number", "centroid", "used")
    named = [dict(zip(columns, row, strict=True)) | {"sensor_id": "a"} for row in rows]
    return pa.Table.from_pylist(named, schema=VIEWS)


BEFORE = views(("x", 1, 0, True), ("x", 2, 0, True), ("y", 1, 1, True), ("z", 1, 2, False))


def test_an_object_with_the_same_detections_is_the_same():
    own = views(("1", 1, 0, True), ("1", 2, 0, True), ("2", 1, 1, True), ("3", 1, 3, True))
    assert followed_objects([own], BEFORE) == {"1": "x", "2": "y"}


def test_views_that_positions_were_solved_without_do_not_count():
    own = views(("3", 1, 2, True), ("1", 1, 0, False))
    assert followed_objects([own], BEFORE) == {}


def test_views_of_missed_detections_do_not_count():
    missed = views(("x", 1, None, True))
    assert followed_objects([views(("1", 1, None, True))], missed) == {}


def test_an_id_goes_to_one_object_only_the_one_that_shares_more():
    own = views(("1", 1, 0, True), ("2", 2, 0, True), ("2", 3, 0, True))
    before = concat(VIEWS, [BEFORE, views(("x", 3, 0, True))])
    assert followed_objects([own], before) == {"2": "x"}


def test_an_object_of_which_no_id_has_more_than_half_is_new():
    own = views(("1", 1, 0, True), ("1", 1, 1, True))
    assert followed_objects([own], BEFORE) == {}


def test_each_detection_counts_once():
    own = views(("1", 1, 0, True), ("1", 1, 0, True), ("1", 1, 1, True))
    assert followed_objects([own], BEFORE) == {}


def test_without_a_night_before_all_objects_are_new():
    own = views(("1", 1, 0, True))
    assert followed_objects([own], VIEWS.empty_table()) == {}
    assert followed_objects([], BEFORE) == {}
