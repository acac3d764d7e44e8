"""The measures of an evaluation, by hand."""

import json

import numpy as np
import pytest
from scenes.little_night import little_dataset, little_state, little_truth, rows

from epipole.schemas.bridge import concat, empty
from epipole.schemas.tables import OBSERVATIONS, STATES
from epipole.tasks.evaluate.evaluate_dataset import evaluate_dataset

OF_PASSAGES = (
    *("passages", "passages_tracked", "passages_fast", "passages_fast_tracked"),
    *("passages_observed", "detections_observed", "passage_pairs", "passages_joined"),
    *("tracklets", "tracklets_false", "joined_wrong", "named_right", "named_wrong"),
)


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
        "positions": 1, "positions_blended": 0, "positions_of_ghosts": 1,
        "positions_per_truth": 0.5,
        "pos_err_km_median": pytest.approx(1.0), "pos_err_km_p95": pytest.approx(1.0),
        "pos_err_km_max": pytest.approx(1.0),
        "nees_median": pytest.approx(1.0), "nees_in_99": 1.0,
        "nees_mean": pytest.approx(1 / 3), "nees_mean_sigma": 0.0,
        "objects_seen_by_two": 0, "objects_lost": 0,
        "ids_per_target": 1.0, "longest_id_share": 1.0, "id_swaps": 0,
        "observations": 2, "observations_of_others": 1, "observation_recall": 0.5,
        "observation_nees_mean": pytest.approx(0.5, rel=1e-4),
        "observation_nees_mean_sigma": 0.0,
        "magnitudes": 1, "magnitude_error_median": pytest.approx(0.1),
        "magnitude_nees_mean": pytest.approx(4.0),
        "states": 1, "states_of_nothing": 1, "states_err_km_median": pytest.approx(1.0),
        "states_nees_mean": pytest.approx(4 / 6), "states_nees_median": pytest.approx(4.0),
        "states_nees_max": pytest.approx(4.0), "states_in_99": 1.0,
        "orbits": 1, "orbits_of_nothing": 1, "orbits_err_km_median": pytest.approx(0.5),
        "orbits_nees_mean": pytest.approx(1 / 6), "orbits_nees_median": pytest.approx(1.0),
        "orbits_nees_max": pytest.approx(1.0), "orbits_in_99": 1.0,
        "tracks": 1, "track_purity": pytest.approx(1 / 3), "track_completeness": 0.25,
        "tracks_per_target": 1.0,
        **dict.fromkeys(OF_PASSAGES),  # none has five frames
    }  # fmt: skip


def test_an_empty_dataset_has_found_nothing():
    tables = {name: empty(t.schema) for name, t in little_dataset().items()}
    found = evaluate_dataset(tables, little_truth())
    assert (found.frames, found.frames_solved, found.star_recall) == (0, 0.0, 0.0)
    assert (found.object_recall, found.positions, found.states, found.orbits) == (0.0, 0, 0, 0)
    assert (found.att_wrong, found.tracks, found.nees_mean, found.states_in_99) == (None,) * 4
    assert found.id_swaps == 0
    json.dumps(found.as_dict(), allow_nan=False)


def test_observations_of_objects_without_a_position_are_not_in_the_recall():
    tables = little_dataset()
    others = [
        {"object_id": "o3", "sensor_id": s, "centroid": 2, "sigma_ra_arcsec": 1.0,
         "sigma_dec_arcsec": 1.0}
        for s in "ab"
    ]  # fmt: skip
    tables["observations"] = concat(
        tables["observations"].schema, [tables["observations"], rows(OBSERVATIONS, *others)]
    )
    found = evaluate_dataset(tables, little_truth())
    assert (found.observations, found.observations_of_others) == (4, 1)
    assert found.observation_recall == 0.5
    tables["positions"] = tables["positions"].slice(0, 0)
    assert evaluate_dataset(tables, little_truth()).observation_recall == 0.0


def test_without_objects_only_stars_and_attitudes_are_measured():
    truth = little_truth()
    truth.scenario["targets"] = []
    found = evaluate_dataset(little_dataset(), truth)
    assert found.star_precision == 0.5
    assert (found.object_recall, found.states, found.id_swaps) == (None, None, None)


def test_an_invalid_covariance_leaves_no_infinity_in_the_report():
    tables = little_dataset()
    tables["states"] = rows(STATES, little_state("o1", cov_xx=-1.0))
    found = evaluate_dataset(tables, little_truth())
    assert (found.states, found.states_in_99, found.states_nees_mean) == (1, 0.0, None)
    json.dumps(found.as_dict(), allow_nan=False)
