"""Judge tracklets: one outcome each, the first in `Outcome` of all spans."""

import polars as pl
import pyarrow as pa
import pytest

from epipole.schemas.rejects import Outcome
from epipole.tasks.common.lone_detections import MARK
from epipole.tasks.solve.judge_tracklets import best_outcomes, judge_views, outcomes


def ids(*names: str) -> pa.ChunkedArray:
    return pa.chunked_array([pa.array(names, pa.string())])


def undecided(**outcomes: str) -> pa.Table:
    return pa.table(
        {
            "tracklet_id": pa.array(list(outcomes), pa.string()),
            "outcome": pa.array(list(outcomes.values()), pa.string()),
        }
    )


def associations(**used: bool) -> pa.Table:
    return pa.table(
        {
            "tracklet_id": pa.array(list(used), pa.string()),
            "used": pa.array(list(used.values()), pa.bool_()),
        }
    )


def as_dict(rows: pa.Table) -> dict[str, str]:
    return dict(zip(rows["tracklet_id"].to_pylist(), rows["outcome"].to_pylist(), strict=True))


def test_each_tracklet_has_its_first_outcome():
    judged = best_outcomes(
        [
            outcomes(ids("a", "b", "c", "d", "e", "a"), Outcome.SEEN_BY_ONE),
            outcomes(ids("f"), Outcome.SENSOR_LEFT_OUT),
            undecided(c="ambiguous", d="sensor_left_out", a="ambiguous"),
            judge_views(associations(a=True, b=False)),
        ]
    )
    assert as_dict(judged) == {
        "a": Outcome.OBJECT,
        "b": Outcome.DISAGREES,
        "c": Outcome.AMBIGUOUS,
        "d": Outcome.SENSOR_LEFT_OUT,
        "e": Outcome.SEEN_BY_ONE,
        "f": Outcome.SENSOR_LEFT_OUT,
    }


def test_lone_detections_have_no_outcome():
    judged = outcomes(ids(f"{MARK}x", "a"), Outcome.SEEN_BY_ONE)
    assert as_dict(judged) == {"a": Outcome.SEEN_BY_ONE}


def test_views_without_a_published_tracklet_have_no_outcome():
    views = pa.table({"tracklet_id": pa.array([None, "a"]), "used": pa.array([True, True])})
    assert as_dict(judge_views(views)) == {"a": Outcome.OBJECT}


def test_a_tracklet_that_one_position_used_is_of_an_object():
    views = pa.table({"tracklet_id": ["a", "a", "b", "b"], "used": [False, True, False, False]})
    assert as_dict(judge_views(views)) == {"a": Outcome.OBJECT, "b": Outcome.DISAGREES}


@pytest.mark.parametrize("later", ["ambiguous", "seen_by_one", "disagrees"])
def test_an_object_in_one_span_is_one_in_the_night(later):
    spans = [undecided(a="object"), undecided(a=later, b=later)]
    for order in (spans, spans[::-1]):
        assert as_dict(best_outcomes(order)) == {"a": "object", "b": later}


def test_no_tracklets_have_no_outcomes():
    assert outcomes(ids(), Outcome.SEEN_BY_ONE).num_rows == 0
    assert judge_views(associations()).num_rows == 0
    assert best_outcomes([]).num_rows == 0


def test_every_tracklet_of_a_night_has_an_outcome(night_dataset):
    tracklets = pl.read_parquet(night_dataset / "night=*/tracklets/*.parquet")
    assert set(tracklets["outcome"]) <= {outcome.value for outcome in Outcome}
    views = pl.read_parquet(night_dataset / "night=*/associations/*.parquet").filter("used")
    of_objects = tracklets.filter(outcome="object")["tracklet_id"]
    assert set(of_objects) == set(views["tracklet_id"].drop_nulls())
