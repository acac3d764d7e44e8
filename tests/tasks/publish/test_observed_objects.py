"""Observations: each sighting is of the object at the nearest epoch of its tracklet, or of none."""

import polars as pl
import pytest
from scenes.associations import filled

from epipole.io.work.work_layout import NOTHING_ADDED, AddedErrors, SensorFault
from epipole.schemas.bridge import to_polars
from epipole.schemas.work_tables import SIGHTINGS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.publish.observed_objects import (
    longest_object,
    published,
    runs_of_views,
    with_objects,
    with_shared_errors,
)

SECOND = 1_000_000_000


def sightings(*rows: tuple[str, float]) -> pl.DataFrame:
    """Sightings of tracklets at these seconds, numbered in this order."""
    names, seconds = zip(*rows, strict=True) if rows else ((), ())
    return to_polars(filled(SIGHTINGS, len(rows), {
        "tracklet_id": list(names), "time": [round(s * SECOND) for s in seconds],
        "centroid": list(range(len(rows))),
    }))  # fmt: skip


def runs(*views: tuple[str | None, str, float, bool]) -> pl.DataFrame:
    """The runs of these views: tracklet, object, second, whether it was used."""
    tracklet, object_, second, used = zip(*views, strict=True) if views else ((),) * 4
    time = to_polars(filled(SIGHTINGS, len(views), {"time": [round(s * SECOND) for s in second]}))
    return runs_of_views(halves(pl.DataFrame(
        {
            "tracklet_id": list(tracklet), "object_id": list(object_), "epoch": time["time"],
            "used": list(used), "sensor_id": ["s"] * len(views),
            "frame_number": [7] * len(views), "centroid": [3] * len(views),
        },
        schema_overrides={"tracklet_id": pl.String, "object_id": pl.String, "used": pl.Boolean},
    ))).sort("first", "tracklet_id")  # fmt: skip


def halves(views: pl.DataFrame) -> list[pl.DataFrame]:
    """The views in two pieces: a run may have epochs in both."""
    return [views.gather_every(2), views.gather_every(2, 1)]


def objects(seen: pl.DataFrame, of_runs: pl.DataFrame) -> dict[int, str]:
    found = with_objects(seen, of_runs).drop_nulls("object_id")
    return dict(zip(found["centroid"].to_list(), found["object_id"].to_list(), strict=True))


def test_a_tracklet_shows_its_object_before_between_and_after_its_epochs():
    of_runs = runs(*[("t", "o", k, True) for k in (10, 11, 12)], ("u", "p", 11, True))
    seen = sightings(("t", 0), ("t", 10.4), ("u", 12), ("t", 99), ("v", 11))
    assert objects(seen, of_runs) == {0: "o", 1: "o", 2: "p", 3: "o"}


def test_near_an_epoch_that_was_rejected_it_is_of_no_object():
    of_runs = runs(("t", "o", 10, True), ("t", "o", 11, False), ("t", "o", 12, True))
    seen = sightings(*[("t", s) for s in (10.4, 10.6, 11.0, 11.4, 11.6)])
    assert objects(seen, of_runs) == {0: "o", 4: "o"}


def test_a_tracklet_that_passes_to_another_object_changes_halfway():
    of_runs = runs(("t", "o", 10, True), ("t", "p", 20, True), ("t", "p", 21, True))
    seen = sightings(*[("t", s) for s in (9, 14, 16, 20.5, 30)])
    assert objects(seen, of_runs) == {0: "o", 1: "o", 2: "p", 3: "p", 4: "p"}


def test_a_lone_detection_has_the_object_that_used_it():
    of_runs = runs((None, "o", 10, True))
    assert objects(sightings(("lone:s-7-3", 10.2), ("lone:s-7-4", 10.2)), of_runs) == {0: "o"}


@pytest.mark.parametrize("views", [[], [("t", "o", 10, False)]])
def test_without_used_views_there_are_no_objects(views):
    assert objects(sightings(("t", 10)), runs(*views)) == {}


def test_a_tracklet_without_object_is_published_and_a_lone_detection_is_not():
    of_runs = runs(("t", "o", 10, True), (None, "p", 10, True))
    seen = sightings(("t", 10), ("u", 10), ("lone:s-7-3", 10.2), ("lone:s-7-4", 10.2))
    rows = published(with_objects(seen, of_runs))
    assert rows["tracklet_id"].to_list() == ["t", "u", None]
    assert rows["object_id"].to_list() == ["o", None, "p"]


def test_a_tracklet_of_two_objects_has_the_one_that_it_shows_for_longest():
    of_runs = runs(
        ("t", "o", 10, True), ("t", "p", 20, True), ("t", "p", 21, True), ("u", "q", 5, True),
        ("v", "o", 3, False),
    )  # fmt: skip
    found = longest_object(of_runs)
    pairs = zip(found["tracklet_id"].to_list(), found["object_id"].to_list(), strict=True)
    assert dict(pairs) == {"t": "p", "u": "q"}


def test_rows_are_in_the_order_of_time_and_then_as_they_came():
    of_runs = runs(("t", "o", 10, True), ("u", "p", 10, True))
    found = with_objects(sightings(("u", 11), ("t", 10), ("u", 10), ("t", 11)), of_runs)
    assert found["centroid"].to_list() == [1, 2, 0, 3]


def test_shared_errors_are_as_large_as_the_objects_show():
    seen = sightings(("t", 10), ("u", 10)).with_columns(
        sensor_id=pl.Series(["a", "b"]), bias_sigma_arcsec=2.0, position_sigma_km=0.1
    )
    errors = pl.DataFrame({"sensor_id": ["b"], "direction": [9.0], "position": [4.0]})
    found = with_shared_errors(seen, errors, NOTHING_ADDED)
    assert found["bias_sigma_arcsec"].to_list() == [2.0, 6.0]
    assert found["position_sigma_km"].to_list() == [0.1, 0.2]
    added = AddedErrors(1.0, (SensorFault("a", km=2.0, rad=1.5 * ARCSEC),))
    found = with_shared_errors(seen, errors, added)
    assert found["bias_sigma_arcsec"].to_list() == pytest.approx([2.5, 6.0])
    assert found["position_sigma_km"].to_list() == pytest.approx([5.01**0.5, 2 * 1.01**0.5])
    assert with_shared_errors(seen.clear(), errors, added).is_empty()
