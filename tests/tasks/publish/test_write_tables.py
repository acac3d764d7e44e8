"""Tables of a night: rejects counted once per night, each in a night, tracklets with outcomes."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.associations import filled

from epipole.io.work.part_tables import NIGHT_TRACKLETS, SOLVED
from epipole.io.work.parts import Parts, write_part
from epipole.io.work.places import SensorParts, WorkFolder
from epipole.schemas.bridge import array, concat, empty
from epipole.schemas.logs.log_tables import LogSource
from epipole.schemas.rejects import Outcome, Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, Sensor, Span
from epipole.schemas.tables import REJECTS, SOURCES, TABLES, TRACKLETS
from epipole.schemas.work_tables import TRACKLET_OUTCOMES, TRACKLET_RUNS
from epipole.tasks.publish.write_tables import (
    BY_SENSOR,
    BY_SPAN,
    SHARES,
    WHOLE,
    NightParts,
    counted,
    into_nights,
    source_table,
    tracklets_of_run,
)

NIGHT = "2019-04-01"
MIDNIGHT_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))
SPANS = [Span(MIDNIGHT_NS + k * SPAN_NS, MIDNIGHT_NS + (k + 1) * SPAN_NS) for k in (20, 21, 22)]


def view_rejected(time_ns: int, count: int, sensor_id="a", tracklet_id=None) -> pa.Table:
    return reject_rows(
        Reason.VIEW_REJECTED, time=[time_ns], count=[count], sensor_id=sensor_id,
        tracklet_id=tracklet_id,
    )  # fmt: skip


def test_every_table_of_a_dataset_is_written_by_one_task():
    names = [name for share in SHARES for name in share]
    assert sorted(names) == sorted(TABLES)
    assert sorted((*BY_SENSOR, *BY_SPAN, *WHOLE)) == sorted(TABLES)


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


def test_a_reject_is_in_one_of_the_nights():
    hour_ns = 3_600_000_000_000
    before, within, gap, after = (
        MIDNIGHT_NS - hour_ns, MIDNIGHT_NS + hour_ns, MIDNIGHT_NS + DAY_NS + hour_ns,
        MIDNIGHT_NS + 9 * DAY_NS,
    )  # fmt: skip
    rows = concat(REJECTS, [view_rejected(t, 1) for t in (0, before, within, gap, after)])
    moved = into_nights(rows, [NIGHT, "2019-04-05"])
    last = MIDNIGHT_NS + 4 * DAY_NS
    assert array(moved, "time").tolist() == [MIDNIGHT_NS, MIDNIGHT_NS, within, MIDNIGHT_NS, last]
    assert moved.schema.equals(rows.schema)
    assert moved.drop_columns("time").equals(rows.drop_columns("time"))


def runs(sensor_id: str, *names: str) -> pa.Table:
    columns = {"tracklet_id": names, "track_id": names, "sensor_id": [sensor_id] * len(names)}
    return filled(TRACKLET_RUNS, len(names), columns)


def solved_part(parts: Parts, span: Span, **outcomes: str) -> None:
    rows = {"tracklet_id": list(outcomes), "outcome": list(outcomes.values())}
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    tables["tracklet_outcomes"] = filled(TRACKLET_OUTCOMES, len(outcomes), rows)
    write_part(parts.of(span), SOLVED, tables)


def test_each_tracklet_has_its_first_outcome_of_all_spans(tmp_path):
    folder, sensors = WorkFolder(tmp_path), []
    for sensor, names in ((Sensor(0, "a"), ("a1", "a2", "a3")), (Sensor(1, "b"), ("b1",))):
        names_of = folder.tracklet_names(sensor, 0)
        tracklets = {"tracklets": runs(sensor.sensor_id, *names)}
        write_part(names_of.of_night(), NIGHT_TRACKLETS, tracklets)
        sensors.append(SensorParts(folder.identified(sensor), folder.tracked(sensor, 0), names_of))
    solved = folder.solved(0)
    solved_part(solved, SPANS[0], a1=Outcome.SEEN_BY_ONE, a2=Outcome.AMBIGUOUS)
    solved_part(solved, SPANS[2], a1=Outcome.OBJECT, a2=Outcome.SEEN_BY_ONE, b1=Outcome.OBJECT)
    # The middle span has no part. The night has only the first span, but the outcome is the run's.
    parts = NightParts(NIGHT, SPANS[:1], SPANS, sensors, solved, {}, {})
    rows = tracklets_of_run(parts)
    assert rows["tracklet_id"].to_pylist() == ["a1", "a2", "a3", "b1"]
    assert rows["outcome"].to_pylist() == ["object", "ambiguous", "not_compared", "object"]
    assert rows.schema.equals(TRACKLETS)


def test_sources_have_the_code_and_settings_that_made_the_night():
    rows = source_table([LogSource("n.mcap", 5, "ab", 1, 2)], Settings())
    assert rows.schema.equals(SOURCES)
    (row,) = rows.drop_columns(["first_time", "last_time"]).to_pylist()
    assert (row["name"], row["size"], row["sha256"]) == ("n.mcap", 5, "ab")
    assert row["settings_key"] == Settings().key()
    assert row["code_version"]
