"""Ids of true objects, and covariances of positions."""

import polars as pl
import pytest
from scenes.little_night import RADII_KM, little_truth, rows

from epipole.schemas.tables import POSITIONS
from epipole.tasks.evaluate.measures import measure_ids, measure_lost_objects, measure_positions


def matched(*positions):
    schema = {"epoch": pl.Int64, "object_id": pl.String, "true_object": pl.Int64}
    return pl.DataFrame(positions, schema=schema, orient="row")


@pytest.mark.parametrize(
    ("true_objects", "swaps"),
    [([0, 0, 0], 0), ([0, 1, 1], 1), ([0, 1, 0], 2), ([0, -1, 0], 0), ([0, -1, 1], 1)],
)
def test_an_id_is_swapped_where_its_next_position_is_of_another_object(true_objects, swaps):
    one_id = [(epoch, "o1", k) for epoch, k in enumerate(true_objects)]
    assert measure_ids(matched(*one_id))["id_swaps"] == swaps
    assert measure_ids(matched(*reversed(one_id)))["id_swaps"] == swaps
    another_id = [(epoch, "o2", 5) for epoch in range(3)]
    assert measure_ids(matched(*one_id, *another_id))["id_swaps"] == swaps


def test_two_ids_of_one_object_are_two_ids_but_no_swap():
    found = measure_ids(matched((0, "o1", 3), (1, "o2", 3), (2, "o2", 3), (0, "o3", 4)))
    expected = {"id_swaps": 0, "ids_per_target": 1.5, "longest_id_share": pytest.approx(5 / 6)}
    assert found == expected


def test_the_mean_nees_is_over_objects_not_over_positions():
    cov = {"cov_xx": 1.0, "cov_yy": 1.0, "cov_zz": 1.0}
    off = [(0, 3.0), (0, 3.0), (0, 3.0), (1, 0.0)]  # 9 / 3 and 0
    positions = [{"object_id": f"o{k}", "x_km": RADII_KM[k] + x, **cov} for k, x in off]
    found = measure_positions(
        rows(POSITIONS, *positions), matched(*[(0, f"o{k}", k) for k, _ in off]), little_truth()
    )
    assert found["nees_mean"] == pytest.approx((3.0 + 0.0) / 2)
    assert found["nees_mean_sigma"] == pytest.approx(1.5 / 2**0.5)


def objects(n_epochs):
    """Return a row for each object and each of its epochs."""
    pairs = [(epoch, k) for k, n in n_epochs.items() for epoch in range(n)]
    schema = {"epoch": pl.Int64, "true_object": pl.Int64}
    return pl.DataFrame(pairs, schema=schema, orient="row")


@pytest.mark.parametrize(
    ("n_possible", "n_found", "counted", "lost"),
    [(10, 5, 1, 0), (10, 4, 1, 1), (10, 0, 1, 1), (9, 0, 0, 0), (11, 5, 1, 1)],
)
def test_an_object_is_lost_below_half_of_ten_or_more_epochs(n_possible, n_found, counted, lost):
    possible, estimates = objects({3: n_possible, 4: 20}), objects({3: n_found, 4: 20})
    found = measure_lost_objects(possible, estimates)
    assert found == {"objects_seen_by_two": 1 + counted, "objects_lost": lost}


def test_estimates_at_other_epochs_and_second_estimates_of_an_epoch_do_not_count():
    possible = objects({0: 10})
    elsewhere = objects({0: 10}).with_columns(pl.col("epoch") + 6)
    assert measure_lost_objects(possible, elsewhere)["objects_lost"] == 1
    repeated = pl.concat([objects({0: 4})] * 3)
    assert measure_lost_objects(possible, repeated)["objects_lost"] == 1
