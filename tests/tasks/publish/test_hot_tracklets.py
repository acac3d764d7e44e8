"""Tracklets of a night: each has an outcome; what no other sensor confirms may be a hot pixel."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.associations import filled

from epipole.io.work.parts import ASSOCIATED, NIGHT_TRACKLETS, SOLVED, TRACKED, write_part
from epipole.io.work.work_layout import SensorParts, SolvedParts, WorkFolder
from epipole.schemas.bridge import empty, table
from epipole.schemas.rejects import Outcome
from epipole.schemas.spans import BLOCK_NS, SPAN_NS, Sensor, Span
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import (
    HOT_SUSPECTS,
    JUDGED_TRACKLETS,
    TRACKLET_OUTCOMES,
    TRACKLET_RUNS,
)
from epipole.tasks.publish.hot_tracklets import (
    confirmed_tracklets,
    hot_pixel_rejects,
    hot_tracklets,
    tracklets_of_run,
    with_hot_pixels,
)
from epipole.tasks.publish.night_parts import NightParts

NIGHT = "2019-04-01"
MIDNIGHT_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))
SPANS = [Span(MIDNIGHT_NS + k * SPAN_NS, MIDNIGHT_NS + (k + 1) * SPAN_NS) for k in (20, 21, 22)]
A, B = Sensor(0, "a"), Sensor(1, "b")


def solved_part(parts: SolvedParts, span: Span, *, piece: int = 0, **outcomes: str) -> None:
    """Write the part of some objects, with the outcomes of their tracklets."""
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    write_part(parts.piece(span, piece), SOLVED, tables | outcomes_of(outcomes))


def associated_part(parts: SolvedParts, span: Span, *, block: int = 0, **outcomes: str) -> None:
    """Write the part of a block of a span, with the outcomes of the tracklets."""
    tables = {name: empty(schema) for name, schema in ASSOCIATED.items()}
    start_ns = span.start_ns + block * BLOCK_NS
    of_block = parts.blocks.of(Span(start_ns, start_ns + BLOCK_NS))
    write_part(of_block, ASSOCIATED, tables | outcomes_of(outcomes))


def outcomes_of(outcomes: dict[str, str]) -> dict[str, pa.Table]:
    rows = {"tracklet_id": list(outcomes), "outcome": list(outcomes.values())}
    return {"outcomes": filled(TRACKLET_OUTCOMES, len(outcomes), rows)}


def night(tmp_path, tracks: dict[Sensor, dict[str, str]], suspects=()) -> NightParts:
    """Return parts in which each sensor has tracklets, each of a track."""
    folder, sensors = WorkFolder(tmp_path), []
    for sensor, track_of in tracks.items():
        names_of, n = folder.tracklet_names(sensor, 0), len(track_of)
        columns = {
            "tracklet_id": list(track_of), "track_id": list(track_of.values()),
            "sensor_id": [sensor.sensor_id] * n, "n_detections": [7] * n,
        }  # fmt: skip
        tables = {
            "tracklets": filled(TRACKLET_RUNS, n, columns),
            "suspects": table(
                HOT_SUSPECTS, {"tracklet_id": [s for s in suspects if s in track_of]}
            ),
        }
        write_part(names_of.of_night(), NIGHT_TRACKLETS, tables)
        sensors.append(
            SensorParts(
                sensor.sensor_id, folder.identified(sensor), folder.tracked(sensor, 0), names_of,
                folder.viewed(0)[sensor.number],
            )
        )  # fmt: skip
    return NightParts(NIGHT, SPANS[:1], SPANS, sensors, folder.solved(0), {}, {})


def alone(*names: str) -> dict[str, str]:
    return {name: name for name in names}


def test_each_tracklet_has_its_first_outcome_of_all_spans(tmp_path):
    parts = night(tmp_path, {A: alone("a1", "a2", "a3"), B: alone("b1")})
    solved_part(parts.solved, SPANS[0], a1=Outcome.SEEN_BY_ONE, a2=Outcome.AMBIGUOUS)
    solved_part(
        parts.solved, SPANS[2], a1=Outcome.OBJECT, a2=Outcome.SEEN_BY_ONE, b1=Outcome.OBJECT
    )
    # The middle span has no part. The night has only the first span, but the outcome is the run's.
    rows = tracklets_of_run(parts)
    assert rows["tracklet_id"].to_pylist() == ["a1", "a2", "a3", "b1"]
    assert rows["outcome"].to_pylist() == ["object", "ambiguous", "not_compared", "object"]
    assert rows.schema.equals(JUDGED_TRACKLETS)


def test_the_outcomes_of_all_blocks_and_pieces_count(tmp_path):
    parts = night(tmp_path, {A: alone("a1", "a2", "a3", "a4"), B: alone("b1")})
    associated_part(parts.solved, SPANS[0], a1=Outcome.SEEN_BY_ONE, a2=Outcome.SEEN_BY_ONE)
    associated_part(parts.solved, SPANS[0], block=2, a2=Outcome.AMBIGUOUS, b1=Outcome.SEEN_BY_ONE)
    associated_part(parts.solved, SPANS[2], block=1, a3=Outcome.SENSOR_LEFT_OUT)
    solved_part(parts.solved, SPANS[0], a1=Outcome.DISAGREES)
    solved_part(parts.solved, SPANS[0], piece=11, b1=Outcome.OBJECT)
    rows = tracklets_of_run(parts)
    assert dict(zip(rows["tracklet_id"].to_pylist(), rows["outcome"].to_pylist(), strict=True)) == {
        "a1": "disagrees", "a2": "ambiguous", "a3": "sensor_left_out", "a4": "not_compared",
        "b1": "object",
    }  # fmt: skip


@pytest.mark.parametrize("outcome", list(Outcome))
def test_nothing_that_another_sensor_sees_is_a_hot_pixel(tmp_path, outcome):
    parts = night(tmp_path, {A: alone("a1", "a2")}, suspects=["a1"])
    solved_part(parts.solved, SPANS[0], a1=outcome, a2=Outcome.SEEN_BY_ONE)
    unseen = outcome in (Outcome.UNDECIDED, Outcome.SEEN_BY_ONE, Outcome.NOT_COMPARED)
    kept = confirmed_tracklets(parts)["tracklet_id"].to_pylist()
    assert kept == (["a2"] if unseen else ["a1", "a2"])
    rejects = hot_pixel_rejects(parts).select(["sensor_id", "tracklet_id", "stage", "count"])
    row = {"sensor_id": "a", "tracklet_id": "a1", "stage": "track", "count": 7}
    assert rejects.to_pylist() == ([row] if unseen else [])


def test_a_suspect_of_the_track_of_an_object_is_that_object(tmp_path):
    tracks = {"a1": "a1", "a2": "a1", "a3": "a3", "a4": "a3"}
    parts = night(tmp_path, {A: tracks}, suspects=["a1", "a2", "a3"])
    solved_part(parts.solved, SPANS[0], a1=Outcome.SEEN_BY_ONE, a2=Outcome.OBJECT)
    assert not hot_tracklets(parts).num_rows


def test_detections_of_hot_tracklets_are_hot_pixels_of_no_tracklet(tmp_path):
    parts = night(tmp_path, {A: alone("a1", "a2")}, suspects=["a1"])
    columns = {
        "kind": ["object", "object", "unknown"], "tracklet_id": ["a1", "a2", None],
        "track_id": ["a1", "a2", None],
    }  # fmt: skip
    detections = filled(DETECTIONS, 3, columns)
    rows = pl.DataFrame(with_hot_pixels(detections, hot_tracklets(parts)["tracklet_id"]))
    assert rows["kind"].to_list() == ["hot_pixel", "object", "unknown"]
    assert rows["tracklet_id"].to_list() == [None, "a2", None]
    assert rows["track_id"].to_list() == [None, "a2", None]


def test_the_other_hot_pixels_of_a_sensor_are_one_row_of_the_night(tmp_path):
    parts = night(tmp_path, {A: alone(), B: alone()})
    time_ns = SPANS[0].start_ns + np.array([5, 3, SPAN_NS])  # the last is in another span
    columns = {"sensor_id": ["b"] * 3, "kind": ["hot_pixel"] * 3, "time": time_ns}
    tables = {name: empty(schema) for name, schema in TRACKED.items()}
    tables["detections"] = filled(DETECTIONS, 3, columns)
    write_part(parts.sensors[1].tracked.of(SPANS[0]), TRACKED, tables)
    (row,) = hot_pixel_rejects(parts).drop_columns("time").to_pylist()
    assert (row["sensor_id"], row["tracklet_id"], row["count"]) == ("b", None, 2)
