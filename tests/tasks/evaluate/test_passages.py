"""What becomes of passages, by hand; objects that are blended, sensors at fault."""

import dataclasses

import pyarrow as pa
import pytest
from scenes.little_night import little_dataset, little_truth, rows

from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.tables import DETECTIONS, IDENTIFICATIONS, OBSERVATIONS, TRACKLETS
from epipole.tasks.evaluate.evaluate_dataset import evaluate_dataset
from epipole.tasks.evaluate.passages import measure_passages

N = 6  # frames of each of the sensors a and b, which show the objects 0 (centroid 1) and 1 (2)


def detections(sensor_id, centroid, tracklet_id, frames=range(N)):
    return [
        {
            "sensor_id": sensor_id,
            "frame_number": i,
            "centroid": centroid,
            "kind": "object",
            "tracklet_id": tracklet_id,
        }
        for i in frames
    ]


def tracklet(tracklet_id, object_id):
    return {"tracklet_id": tracklet_id, "object_id": object_id}


def measured(seen, tracklets=(), observed=(), named=(), **scenario):
    truth = little_truth(N)
    sensors = [{"id": s, "sat": s, "rate_hz": 1.0} for s in "ab"]
    truth.scenario.update({"sensors": sensors} | scenario)
    tables = {
        "detections": rows(DETECTIONS, *seen),
        "observations": rows(OBSERVATIONS, *observed),
        "tracklets": rows(TRACKLETS, *tracklets),
        "identifications": rows(IDENTIFICATIONS, *named),
    }
    return measure_passages(tables, to_polars(truth.points), truth)


def test_a_passage_is_tracked_by_half_of_its_detections_in_one_tracklet():
    seen = [
        *detections("a", 1, "a1"),
        *detections("a", 2, "a2", range(3)),
        *detections("a", 2, "a3", range(3, 5)),
        *detections("b", 1, "b1", range(2)),
    ]
    found = measured(seen)
    assert (found["passages"], found["passages_tracked"]) == (4, 0.5)
    assert (found["passages_fast"], found["passages_fast_tracked"]) == (0, None)
    assert (found["tracklets"], found["tracklets_false"]) == (4, 0)


def test_a_tracklet_without_half_of_its_detections_on_one_object_is_false():
    seen = [*detections("a", 0, "a1", range(3)), *detections("a", 1, "a1", range(3, 5))]
    assert measured(seen)["tracklets_false"] == 1


def test_passages_are_observed_by_half_of_their_detections():
    observed = detections("a", 1, None, range(3)) + detections("b", 1, None, range(2))
    found = measured([], observed=observed)
    assert found["passages_observed"] == 0.25
    assert found["detections_observed"] == pytest.approx(5 / (4 * N))


def test_passages_through_two_satellites_are_joined_by_one_id():
    seen = [row for s in "ab" for k in (1, 2) for row in detections(s, k, f"{s}{k}")]
    ids = {"a1": "o1", "b1": "o1", "a2": "o2", "b2": "o3"}
    joined = [tracklet(*pair) for pair in ids.items()]
    found = measured(seen, joined)
    assert (found["passage_pairs"], found["passages_joined"]) == (2, 0.5)
    assert found["joined_wrong"] == 0
    one_satellite = [{"id": s, "sat": "x", "rate_hz": 1.0} for s in "ab"]
    assert measured(seen, joined, sensors=one_satellite)["passage_pairs"] == 0
    mixed = [*joined[:2], tracklet("b2", "o1")]
    assert measured(seen, mixed)["joined_wrong"] == 1


def test_tracklets_are_named_by_the_identification_of_their_object():
    seen = detections("a", 1, "a1") + detections("a", 2, "a2")
    joined = [tracklet("a1", "o1"), tracklet("a2", "o2")]
    named = [{"object_id": o, "status": "known", "norad_id": 7} for o in ("o1", "o2")]
    targets = [{"norad": 7}, {"norad": 8}]
    found = measured(seen, joined, named=named, targets=targets)
    assert (found["named_right"], found["named_wrong"]) == (0.5, 1)


def test_errors_of_blended_objects_are_not_measured():
    tables, truth = little_dataset(), little_truth()
    also = pa.array([1 if k == 1 else None for k in (0, 1, 2) * 2], pa.int64())
    points = truth.points.drop_columns("also").append_column("also", also)
    found = evaluate_dataset(tables, dataclasses.replace(truth, points=points))
    assert (found.positions, found.positions_blended) == (0, 1)
    assert (found.states, found.nees_mean) == (0, None)


def test_what_sensors_at_fault_see_is_not_expected():
    truth = little_truth()
    truth.scenario["sensors"] = [{"id": "a", "rate_hz": 1.0}, {"id": "b", "rate_hz": 1.0}]
    assert evaluate_dataset(little_dataset(), truth).object_recall == 0.5
    truth.scenario["sensors"][1]["clock_s"] = 0.5
    found = evaluate_dataset(little_dataset(), truth)
    assert (found.object_recall, found.pair_recall) == (0.0, 1.0)


def test_a_night_without_detections_has_passages_without_tracklets():
    tables = {name: empty(t.schema) for name, t in little_dataset().items()}
    found = evaluate_dataset(tables, little_truth(N))
    assert (found.passages, found.passages_tracked, found.tracklets) == (4, 0.0, 0)
