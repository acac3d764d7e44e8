"""Objects that were lost."""

import polars as pl
import pytest

from epipole.tasks.evaluate.measure_associations import measure_lost_objects


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
    possible, claims = objects({3: n_possible, 4: 20}), objects({3: n_found, 4: 20})
    found = measure_lost_objects(possible, claims)
    assert found == {"objects_seen_by_two": 1 + counted, "objects_lost": lost}


def test_claims_at_other_epochs_and_second_claims_of_an_epoch_do_not_count():
    possible = objects({0: 10})
    elsewhere = objects({0: 10}).with_columns(pl.col("epoch") + 6)
    assert measure_lost_objects(possible, elsewhere)["objects_lost"] == 1
    repeated = pl.concat([objects({0: 4})] * 3)
    assert measure_lost_objects(possible, repeated)["objects_lost"] == 1
