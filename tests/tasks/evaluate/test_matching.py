"""True objects of views and of estimates."""

import dataclasses

import numpy as np
import polars as pl
import pytest
from scenes.little_night import RINGS, SECOND_NS, T0_NS, little_dataset, little_truth, rows

from epipole.schemas.bridge import to_polars
from epipole.schemas.tables import ASSOCIATIONS, DETECTIONS, POSITIONS
from epipole.schemas.work_tables import TRUE_ORBITS
from epipole.tasks.algorithms.simulation.paths import state_at
from epipole.tasks.evaluate.matching import (
    detected_objects,
    locate_objects,
    match_estimates,
    match_positions,
    match_views,
    possible_estimates,
)

POINTS = to_polars(little_truth().points)


def estimates_of(views, detections):
    detections = detected_objects(to_polars(rows(DETECTIONS, *detections)), POINTS)
    return match_estimates(match_views(to_polars(rows(ASSOCIATIONS, *views)), detections, POINTS))


def view(object_id="o1", sensor_id="a", centroid=None, **other):
    return {"object_id": object_id, "sensor_id": sensor_id, "centroid": centroid, **other}


def detection(centroid, kind="object"):
    return {"sensor_id": "a", "centroid": centroid, "kind": kind, "tracklet_id": "a1"}


def test_a_missed_view_shows_what_most_detections_of_its_tracklet_show():
    views = [view(tracklet_id="a1"), view(sensor_id="b", centroid=1)]
    on_object = [detection(1), detection(0), detection(2, kind="unknown")]
    assert estimates_of(views, on_object)["true_object"].to_list() == [0]
    on_star = [detection(0)]
    assert estimates_of(views, on_star)["true_object"].to_list() == [-1]


def test_views_with_a_centroid_decide_between_two_objects_with_as_many_views():
    missed = [view(tracklet_id="a1")] * 2
    views = [*missed, view(sensor_id="b", centroid=2), view(sensor_id="a", centroid=2)]
    assert estimates_of(views, [detection(1)])["true_object"].to_list() == [1]


def test_an_estimate_is_a_ghost_without_two_used_views_of_one_object():
    both = [view(sensor_id=s, centroid=1) for s in "ab"]
    assert estimates_of(both, [])["true_object"].to_list() == [0]
    unused = [both[0], both[1] | {"used": False}]
    assert estimates_of(unused, [])["true_object"].to_list() == [-1]
    different = [both[0], view(sensor_id="b", centroid=2)]
    assert estimates_of(different, [])["true_object"].to_list() == [-1]


def test_possible_estimates_are_objects_that_two_frames_of_an_epoch_show():
    epochs = to_polars(little_dataset()["epochs"])
    possible = possible_estimates(POINTS, epochs)
    assert sorted(possible.select("true_object", "n_views").rows()) == [(0, 2), (1, 2)]
    assert possible_estimates(POINTS, epochs.head(1)).height == 0


def test_positions_have_the_object_of_their_estimate_and_keep_their_order():
    estimates = pl.DataFrame({"object_id": ["o1", "o2"], "true_object": [7, -1]})
    estimates = estimates.with_columns(epoch=pl.lit(T0_NS).cast(pl.Datetime("ns", "UTC")))
    positions = rows(POSITIONS, *[{"object_id": o} for o in ("o3", "o1", "o2", "o1")])
    assert match_positions(positions, estimates)["true_object"].to_list() == [-1, 7, -1, 7]


METRE, MM_S = 1e-3, 1e-6  # in km and km/s


def sampled(number, elements, t_s):
    r_km, v_km_s = state_at(np.array(elements), t_s)
    return [
        {"object": number, "t_ns": T0_NS + int(t * SECOND_NS)}
        | dict(zip(("x", "y", "z"), r, strict=True))
        | dict(zip(("vx", "vy", "vz"), v, strict=True))
        for t, r, v in zip(t_s, r_km, v_km_s, strict=True)
    ]


def test_sampled_orbits_are_used_where_the_truth_has_them():
    truth = little_truth()
    t_s = np.arange(-10.0, 50.0, 10.0)
    low = [7000.0, 0.01, 0.9, 0.2, 0.3, 0.4]
    samples = [*sampled(40, low, t_s), *sampled(7, RINGS[0], t_s)]
    samples = [samples[i] for i in np.random.default_rng(2).permutation(len(samples))]
    truth = dataclasses.replace(truth, orbits=rows(TRUE_ORBITS, *samples))
    objects, at_s = np.array([40, 7, 40, 40, 7]), np.array([3.0, 17.5, 39.9, 0.0, 20.0])
    found = locate_objects(truth, objects, T0_NS + (at_s * SECOND_NS).astype(np.int64))
    elements = np.where(objects[:, None] == 40, low, RINGS[0])
    r_km, v_km_s = state_at(elements, at_s)
    np.testing.assert_allclose(found[0], r_km, atol=METRE)
    np.testing.assert_allclose(found[1], v_km_s, atol=10 * MM_S)


def test_objects_move_by_their_elements_where_the_truth_has_no_samples():
    (r_km,), (v_km_s,) = locate_objects(little_truth(), np.array([1]), np.array([T0_NS]))
    assert r_km == pytest.approx([42000.0, 0.0, 0.0])
    assert v_km_s == pytest.approx([0.0, np.sqrt(398600.4418 / 42000.0), 0.0])
