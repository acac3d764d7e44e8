"""Midnight: the same rows whether nights are run one by one or together, and ids that last."""

import datetime

import polars as pl
import pytest
from scenes.dataset_tables import contents

from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import read_table

pytestmark = pytest.mark.long

NIGHTS = ["2019-04-01", "2019-04-02"]
START = datetime.datetime(2019, 4, 1, 23, 59, 40, tzinfo=datetime.UTC)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("midnight") / "log.mcap"
    simulate("four_sensor_geo", path, seed=5, hours=40 / 3600, start=START)
    return path


@pytest.fixture(scope="module")
def together(log):
    out = log.parent / "together"
    nightly(str(log), str(out))
    return out


def column(dataset, table, night, name):
    return pl.DataFrame(read_table(dataset, table, night))[name]


def test_nights_that_are_run_one_by_one_have_the_same_bytes(log, together, tmp_path):
    for night in NIGHTS:
        nightly(str(log), str(tmp_path), night=night)
    one_by_one, both = contents(tmp_path), contents(together)
    assert one_by_one.keys() == both.keys()
    assert [name for name in both if one_by_one[name] != both[name]] == []


def test_an_object_that_is_followed_over_midnight_keeps_its_id(together):
    first, second = (set(column(together, "positions", night, "object_id")) for night in NIGHTS)
    assert len(first) > 3
    assert second <= first
    assert all(name.startswith("20190401-") for name in second)


def test_an_object_is_followed_also_where_a_counter_restarted_earlier_that_day(log, tmp_path):
    logs, out = tmp_path / "logs", tmp_path / "out"
    start = START.replace(hour=10)
    simulate("four_sensor_geo", logs / "a.mcap", seed=5, hours=10 / 3600, start=start)
    (logs / "b.mcap").symlink_to(log)  # its frames count from 0 too
    for night in NIGHTS:
        nightly(str(logs / "*.mcap"), str(out), night=night)
    restarts = pl.DataFrame(read_table(out, "rejects", NIGHTS[0]))
    assert "restarted_counter" in restarts["reason"].to_list()
    first, second = (set(column(out, "positions", night, "object_id")) for night in NIGHTS)
    assert len(second) > 3
    assert second <= first


def test_a_night_without_the_one_before_has_ids_of_its_own(log, tmp_path):
    nightly(str(log), str(tmp_path), night=NIGHTS[1])
    names = sorted(set(column(tmp_path, "positions", NIGHTS[1], "object_id")))
    assert names == [f"20190402-{k + 1:05d}" for k in range(len(names))]


@pytest.mark.parametrize("night", NIGHTS)
def test_the_tables_of_a_night_name_what_is_in_it(together, night):
    objects = set(column(together, "positions", night, "object_id"))
    assert set(column(together, "observations", night, "object_id")) - {None} <= objects
    tracklets = pl.DataFrame(read_table(together, "tracklets", night))
    assert (tracklets["start_time"].dt.date().cast(pl.String) == night).all()
    assert (tracklets["end_time"].dt.date().cast(pl.String) == night).all()
    named = column(together, "detections", night, "tracklet_id").drop_nulls()
    assert set(named) == set(tracklets["tracklet_id"])
    counts = named.value_counts().rename({"count": "n"})
    both = tracklets.join(counts, on="tracklet_id")
    assert (both["n"] == both["n_detections"]).all()
