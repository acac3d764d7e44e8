"""Tables of a night: rejects counted once per night, each in a night."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scenes.associations import filled

from epipole.io.datasets.night_tables import PART
from epipole.io.work.parts import SOLVED, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.bridge import array, concat, empty
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings, TableSettings
from epipole.schemas.spans import DAY_NS, SPAN_NS, Span
from epipole.schemas.tables import ASSOCIATIONS, REJECTS, SOURCES, TABLES
from epipole.schemas.work_tables import LogSource
from epipole.tasks.publish.night_parts import NightParts
from epipole.tasks.publish.write_tables import (
    BY_SENSOR,
    BY_SPAN,
    SHARES,
    WHOLE,
    counted,
    into_nights,
    published_rows,
    source_table,
    write_tables,
)

NIGHT = "2019-04-01"
MIDNIGHT_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))


def view_rejected(time_ns: int, count: int, sensor_id="a", tracklet_id=None) -> pa.Table:
    return reject_rows(
        Reason.VIEW_REJECTED, time=[time_ns], count=[count], sensor_id=sensor_id,
        tracklet_id=tracklet_id,
    )  # fmt: skip


def test_every_table_of_a_dataset_is_written_by_one_task():
    later = (
        "identifications",
        "nights",
        "objects",
        "orbits",
        "sensor_errors",
    )  # made from the other tables
    names = [*later, *(name for share in SHARES for name in share)]
    assert sorted(names) == sorted(TABLES)
    assert sorted((*later, *BY_SENSOR, *BY_SPAN, *WHOLE, "observations")) == sorted(TABLES)


def test_views_of_an_object_without_a_position_in_a_span_are_left_out(tmp_path):
    """All its epochs in the span may be ones from which no position could be solved."""
    span = Span(MIDNIGHT_NS, MIDNIGHT_NS + SPAN_NS)
    solved = SolvedParts(tmp_path / "solved")
    pieces = {name: empty(schema) for name, schema in SOLVED.items()}
    pieces["associations"] = filled(ASSOCIATIONS, 3, {
        "object_id": ["solved", "unsolved", "solved"],
        "epoch": [MIDNIGHT_NS + k for k in (1, 2, 3)],
    })  # fmt: skip
    write_part(solved.piece(span, 0), SOLVED, pieces)
    names = {span.folder: {"solved": "20190401-00001"}}
    parts = NightParts(NIGHT, [span], [span], [], solved, names, {})
    write_tables.fn(["associations"], tmp_path / "night", parts)
    rows = pq.read_table(tmp_path / "night" / "associations" / PART)
    assert rows["object_id"].to_pylist() == ["20190401-00001"] * 2


def test_what_every_span_counts_is_one_row_of_the_night():
    rows = counted([view_rejected(9, 3), view_rejected(5, 4), view_rejected(7, 1, "b")])
    summed = rows.select(["sensor_id", "stage", "reason", "count"]).to_pylist()
    assert summed == [
        {"sensor_id": "a", "stage": "solve", "reason": "view_rejected", "count": 7},
        {"sensor_id": "b", "stage": "solve", "reason": "view_rejected", "count": 1},
    ]
    assert array(rows, "time").tolist() == [5, 7]  # the first of each


@pytest.mark.parametrize(
    ("ids", "expected"),
    [(("t1", "t1"), "t1"), (("t1", "t2"), None), (("t1", None), None), ((None, None), None)],
)
def test_rows_of_one_tracklet_keep_its_id(ids, expected):
    rows = counted([view_rejected(k, 1, tracklet_id=name) for k, name in enumerate(ids)])
    assert rows["tracklet_id"].to_pylist() == [expected]


def test_other_reasons_keep_their_rows():
    ambiguous = reject_rows(Reason.AMBIGUOUS, time=[3, 4], count=[1, 1], sensor_id="a")
    rows = counted([ambiguous, view_rejected(1, 2)])
    assert rows["reason"].to_pylist() == ["ambiguous", "ambiguous", "view_rejected"]
    assert counted([]).equals(empty(REJECTS))


def test_a_reject_is_in_one_of_the_nights_and_without_a_time_in_each():
    hour_ns, other = 3_600_000_000_000, "2019-04-05"
    before, within, gap, after = (
        MIDNIGHT_NS - hour_ns, MIDNIGHT_NS + hour_ns, MIDNIGHT_NS + DAY_NS + hour_ns,
        MIDNIGHT_NS + 9 * DAY_NS,
    )  # fmt: skip
    rows = concat(REJECTS, [view_rejected(t, 1) for t in (0, before, within, gap, after)])
    first, second = (into_nights(rows, [NIGHT, other], night) for night in (NIGHT, other))
    last = MIDNIGHT_NS + 4 * DAY_NS
    assert array(first, "time").tolist() == [MIDNIGHT_NS, MIDNIGHT_NS, within, MIDNIGHT_NS]
    assert array(second, "time").tolist() == [last, last]
    assert first.schema.equals(rows.schema)
    assert first.drop_columns("time").equals(rows.drop_columns("time").slice(0, 4))


def test_a_log_that_gave_nothing_has_one_row():
    rows = reject_rows([Reason.TRUNCATED, Reason.NOTHING_READ, Reason.TRUNCATED],
                       source=["a", "a", "b"], time=[0, 0, 0], count=[1] * 3)  # fmt: skip
    kept = into_nights(rows, [NIGHT], NIGHT)
    assert kept.select(["source", "reason"]).to_pylist() == [
        {"source": "a", "reason": "nothing_read"}, {"source": "b", "reason": "truncated"},
    ]  # fmt: skip


def test_sources_have_the_code_and_settings_that_made_the_night():
    rows = source_table([LogSource("n.mcap", 5, "ab", 1, 2)], Settings())
    assert rows.schema.equals(SOURCES)
    (row,) = rows.drop_columns(["first_time", "last_time"]).to_pylist()
    assert (row["name"], row["size"], row["sha256"]) == ("n.mcap", 5, "ab")
    assert row["settings_key"] == Settings().key()
    assert row["code_version"]


@pytest.mark.parametrize(("every", "left"), [(1, [0, 1, 2, 4, 5]), (2, [0, 2, 4]), (0, [])])
def test_stars_of_some_frames_are_published(every, left):
    stars = [{f.name: 0 for f in TABLES["stars"]} | {"sensor_id": "a", "frame_number": k}
             for k in (0, 1, 2, 4, 5)]  # fmt: skip
    rows = pa.Table.from_pylist(stars, schema=TABLES["stars"])
    found = published_rows("stars", rows, TableSettings(stars_every=every))
    assert array(found, "frame_number").tolist() == left


def test_tracked_detections_are_those_of_tracklets_and_objects():
    schema = TABLES["detections"]
    kinds = [("object", None), ("object", "t"), ("hot_pixel", "t"), ("unclassified", None)]
    filled = {f.name: "" if f.type == pa.string() else 0 for f in schema}
    rows = pa.Table.from_pylist(
        [filled | {"kind": kind, "tracklet_id": name} for kind, name in kinds], schema=schema
    )
    assert published_rows("detections", rows, TableSettings()).equals(rows)
    tracked = published_rows("detections", rows, TableSettings(detections="tracked"))
    assert tracked.equals(rows.slice(0, 3))
