"""The measures of an evaluation, by hand."""

import json

import numpy as np
import pytest

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import empty, table
from epipole.schemas.tables import (
    ASSOCIATIONS,
    DETECTIONS,
    EPOCHS,
    FRAMES,
    POSITIONS,
    STARS,
)
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_POINTS
from epipole.tasks.evaluate.evaluate_dataset import evaluate_dataset

T0_NS = 1_554_091_200_000_000_000
# Circular, in the equator, at its node: at (radius, 0, 0) at t0.
RINGS = [[42164.0, 0.0, 0.0, 0.0, 0.0, 0.0], [42000.0, 0.0, 0.0, 0.0, 0.0, 0.0]]
QUAT = {"qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
STAR, TARGET = 0, 1


def rows(schema, *values):
    """Return a table of these rows; a float that is not given is 0, the rest null or empty."""
    blank = {"double": 0.0, "int64": 0, "int32": 0, "string": "", "bool": True, "int8": 0}
    columns = {}
    for f in schema:
        default = T0_NS if "timestamp" in str(f.type) else blank[str(f.type)]
        columns[f.name] = [v.get(f.name, None if f.nullable else default) for v in values]
    return table(schema, columns)


def little_truth() -> Truth:
    """Two sensors of a frame each, both of which see star 77 and two objects."""
    frames = [{"sensor_id": s, "t_ns": T0_NS, **QUAT} for s in ("a", "b")]
    spots = [(STAR, 77), (TARGET, 0), (TARGET, 1)]
    points = [
        {"sensor_id": s, "centroid": k, "kind": kind, "source": source}
        for s in ("a", "b")
        for k, (kind, source) in enumerate(spots)
    ]
    targets = [{"elements": e} for e in RINGS]
    scenario = {"t0_ns": T0_NS, "sensors": [{"rate_hz": 1.0}] * 2, "targets": targets}
    return Truth(rows(TRUE_FRAMES, *frames), rows(TRUE_POINTS, *points), scenario)


def little_dataset():
    """Object 0 right, 1 km and one sigma off; a ghost of object 1 and a star; one star wrong."""
    half = {"qx": 5e-5, "qw": 1.0}  # a turn by 1e-4 rad about x
    frames = [{"sensor_id": s, "attitude_source": "stars", **QUAT, **half} for s in "ab"]
    stars = [{"sensor_id": "a", "star_id": 77}, {"sensor_id": "b", "star_id": 78}]
    views = [("o1", "a", 1), ("o1", "b", 1), ("o2", "a", 2), ("o2", "b", 0), ("o2", "b", 2)]
    associations = [
        {"object_id": o, "sensor_id": s, "centroid": k, "used": i < 4}
        for i, (o, s, k) in enumerate(views)
    ]
    cov = {"cov_xx": 1.0, "cov_yy": 4.0, "cov_zz": 9.0}
    positions = [{"object_id": "o1", "x_km": 42165.0, **cov}, {"object_id": "o2", **cov}]
    tracked = {"kind": "object", "track_id": "a1", "tracklet_id": "a1"}
    return {
        "frames": rows(FRAMES, *frames),
        "stars": rows(STARS, *stars),
        "detections": rows(
            DETECTIONS, *[{"sensor_id": "a", "centroid": k, **tracked} for k in (1, 2, 0)]
        ),
        "epochs": rows(EPOCHS, {"sensor_id": "a"}, {"sensor_id": "b"}),
        "associations": rows(ASSOCIATIONS, *associations),
        "positions": rows(POSITIONS, *positions),
    }


def test_every_measure_of_a_little_night_is_what_it_is_by_hand():
    found = evaluate_dataset(little_dataset(), little_truth()).as_dict()
    arcsec = 1e-4 * 648000 / np.pi
    assert found.pop("att_cross_arcsec_median") == pytest.approx(arcsec, rel=1e-6)
    assert found.pop("att_cross_arcsec_p99") == pytest.approx(arcsec, rel=1e-6)
    assert found.pop("axis_rms_km") == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert found == {
        "frames": 2, "frames_duplicated": 0, "frames_solved": 1.0,
        "stars_claimed": 2, "star_precision": 0.5, "star_recall": 0.5,
        "att_roll_arcsec_median": pytest.approx(0.0, abs=1e-6), "att_wrong": 0,
        "epochs": 1, "groups": 2, "ghosts": 1,
        "pair_precision": 0.5, "pair_recall": 0.5, "object_recall": 0.5,
        "positions": 1, "positions_of_ghosts": 1, "positions_per_truth": 0.5,
        "pos_err_km_median": pytest.approx(1.0), "pos_err_km_p95": pytest.approx(1.0),
        "pos_err_km_max": pytest.approx(1.0),
        "nees_median": pytest.approx(1.0), "nees_in_99": 1.0,
        "ids_per_target": 1.0, "longest_id_share": 1.0,
        "tracks": 1, "track_purity": pytest.approx(1 / 3), "track_completeness": 0.25,
        "tracks_per_target": 1.0,
    }  # fmt: skip


def test_a_missed_view_is_of_what_its_tracklet_is_of():
    tables = little_dataset()
    views = [{"sensor_id": "a", "tracklet_id": "a1"}, {"sensor_id": "b", "centroid": 1}]
    tables["associations"] = rows(ASSOCIATIONS, *[{"object_id": "o1", **view} for view in views])
    found = evaluate_dataset(tables, little_truth())
    assert (found.groups, found.ghosts, found.object_recall) == (1, 0, 0.5)
    assert found.pair_recall == 0.0  # there is no pair of centroids


def test_a_dataset_with_nothing_in_it_has_found_nothing():
    tables = {name: empty(t.schema) for name, t in little_dataset().items()}
    found = evaluate_dataset(tables, little_truth())
    assert (found.frames, found.frames_solved, found.star_recall) == (0, 0.0, 0.0)
    assert (found.object_recall, found.positions, found.tracks) == (0.0, 0, 0)
    assert found.att_wrong is None
    json.dumps(found.as_dict(), allow_nan=False)


def test_without_objects_only_stars_and_attitudes_are_measured():
    truth = little_truth()
    truth.scenario["targets"] = []
    found = evaluate_dataset(little_dataset(), truth)
    assert found.star_precision == 0.5
    assert found.object_recall is None
