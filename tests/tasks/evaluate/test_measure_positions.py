"""Ids of true objects, and covariances of positions."""

import polars as pl
import pytest
from scenes.little_night import RADII_KM, little_truth, rows

from epipole.schemas.tables import POSITIONS
from epipole.tasks.evaluate.measure_positions import measure_ids, measure_positions


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
