"""Objects that only orbits join have positions where several sensors saw them at once."""

import pytest

from epipole.flows.api.datasets import open_dataset
from epipole.flows.evaluate import evaluate
from epipole.flows.nightly import nightly

UNDECIDED = {"association": {"min_log_odds": 100.0}}  # more than a minute of four sensors gives


@pytest.fixture(scope="module")
def linked(prefect, night_log, tmp_path_factory):
    out = tmp_path_factory.mktemp("linked") / "out"
    return out, nightly([str(night_log)], str(out), settings=UNDECIDED)


def test_they_are_those_that_association_finds(linked, night_log, night_run):
    (out, summary), (_, usual) = linked, night_run
    assert summary.positions == usual.positions > 500
    assert summary.outcomes["object"] >= 0.9 * usual.outcomes["object"]
    # What orbits decided is not left out.
    assert summary.rejects.get("ambiguous", 0) == summary.outcomes.get("ambiguous", 0)
    report = evaluate(out, night_log)
    assert report.object_recall == 1.0
    assert report.ghosts == report.id_swaps == report.objects_lost == report.joined_wrong == 0
    assert report.states == report.orbits == 9
    assert 0.3 < report.nees_mean < 2.0


def test_their_tables_name_them_alike(linked):
    tables = open_dataset(linked[0])
    ids = {
        name: set(tables[name].collect()["object_id"].drop_nulls())
        for name in ("objects", "positions", "states", "tracklets", "observations", "associations")
    }
    assert len(ids["objects"]) == 9
    assert all(of_table == ids["objects"] for of_table in ids.values())


def test_without_linking_none_is_found(prefect, night_log, tmp_path):
    settings = {**UNDECIDED, "linking": {"enabled": False}}
    summary = nightly([str(night_log)], str(tmp_path / "out"), settings=settings)
    assert summary.positions == summary.objects == 0
