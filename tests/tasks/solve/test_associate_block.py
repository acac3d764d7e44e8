"""Associate a block: its objects and outcomes; sensors at fault are left out and counted."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.associations import SPAN, START_NS, block_of, sensor_views, tables, write_views
from scenes.tracklet_scenes import Scene

from epipole.io.work.parts import Parts
from epipole.schemas.bridge import array, to_polars
from epipole.schemas.rejects import Outcome, Reason
from epipole.schemas.settings import AssociationSettings, Settings
from epipole.schemas.spans import Sensor
from epipole.schemas.work_tables import OBJECT_MEMBERS
from epipole.tasks.common.sightings import MARK
from epipole.tasks.solve.associate_block import (
    associate_blocks,
    best_outcomes,
    blocks_of,
    object_members,
    outcomes,
    view_outcomes,
)
from epipole.tasks.solve.associate_objects import associate_objects

# Two sensors and three instants are little evidence.
SETTINGS = Settings.model_validate({"association": {"min_log_odds": 0.5}})
BLOCKS = blocks_of(SPAN, SETTINGS.association)
TIMES = np.array([5.0, 17.0, 29.0, 605.0, 617.0])  # in two blocks


def found_by(folder, of, left_out, settings=SETTINGS, blocks=None) -> Parts:
    """Associate the blocks of a scene's span, from the parts of its sensors."""
    sensors = sensor_views(of, settings)
    viewed = write_views(folder / "views", sensors, SPAN)
    named = [Sensor(one.number, one.sensor_id) for one in sensors]
    parts = Parts(folder / "blocks")
    blocks = blocks or blocks_of(SPAN, settings.association)
    associate_blocks.fn(
        named, viewed, blocks, of.cameras, left_out, settings.association,
        settings.alignment.window_s, settings.work.max_views, parts,
    )  # fmt: skip
    return parts


@pytest.fixture(scope="module")
def of():
    return tables(Scene(11, 4, times=TIMES).objects(3, spread_km=300.0))


def test_views_of_sensors_at_fault_are_left_out_and_counted(tmp_path, of):
    left_out = {
        "sat1": Reason.CLOCK_OFF, "sat3": Reason.EPHEMERIS_OFF, "absent": Reason.DISAGREES,
    }  # fmt: skip
    parts = found_by(tmp_path, of, left_out)
    outcomes = {}
    for block, times in zip(BLOCKS, (TIMES[:3], TIMES[3:], []), strict=True):
        rows = parts.read(block, "rejects").select(["sensor_id", "stage", "reason", "count"])
        expected = [
            {"sensor_id": "sat1", "stage": "check", "reason": "clock_off"},
            {"sensor_id": "sat3", "stage": "check", "reason": "ephemeris_off"},
        ]
        assert rows.to_pylist() == [
            row | {"count": 3 * len(times)} for row in expected if len(times)
        ]
        # The first view of each.
        first_ns = [START_NS + int(times[0]) * 1_000_000_000] * 2 if len(times) else []
        assert array(parts.read(block, "rejects"), "time").tolist() == first_ns
        members = parts.read(block, "members")
        assert set(members["sensor"].to_pylist()) == ({0, 2} if len(times) else set())
        ids = parts.read(block, "outcomes")
        outcomes |= dict(
            zip(ids["tracklet_id"].to_pylist(), ids["outcome"].to_pylist(), strict=True)
        )
    sensor = dict(zip(of.tracklets["tracklet_id"].to_pylist(),
                      of.tracklets["sensor_id"].to_pylist(), strict=True))  # fmt: skip
    assert outcomes.keys() == sensor.keys()
    for name, outcome in outcomes.items():
        at_fault = sensor[name] in left_out
        assert outcome == (Outcome.SENSOR_LEFT_OUT if at_fault else Outcome.SEEN_BY_ONE)


def test_left_out_sensors_change_nothing_else(tmp_path, of):
    """The others are associated as if the sensors at fault did not exist."""
    faulty = {"sat1": Reason.CLOCK_OFF}
    without = of._replace(
        views=of.views.filter(pl.Series(of.views["sensor_id"].to_pylist()).ne("sat1").to_arrow()),
    )
    one = found_by(tmp_path / "one", of, faulty)
    other = found_by(tmp_path / "other", without, {})
    for block in BLOCKS:
        assert one.read(block, "members").equals(other.read(block, "members"))
    assert one.read(BLOCKS[0], "members").num_rows == 3 * 3


def test_without_such_sensors_all_take_part(tmp_path, of):
    parts = found_by(tmp_path, of, {})
    for block in BLOCKS[:2]:
        assert parts.read(block, "rejects").num_rows == 0
        members = parts.read(block, "members")
        assert set(members["sensor"].to_pylist()) == {0, 1, 2, 3}
        assert members.num_rows == 3 * 4


def test_without_views_nothing_is_left_out(tmp_path, of):
    nothing = of._replace(views=of.views.slice(0, 0))
    parts = found_by(tmp_path, nothing, {"sat1": Reason.CLOCK_OFF})
    for block in BLOCKS:
        for name in ("members", "rejects", "outcomes"):
            assert parts.read(block, name).num_rows == 0


def test_all_sensors_at_fault_leave_no_object_but_their_outcomes(tmp_path, of):
    parts = found_by(tmp_path, of, {f"sat{k}": Reason.DISAGREES for k in range(4)})
    assert parts.read(BLOCKS[0], "members").num_rows == 0
    assert parts.read(BLOCKS[0], "rejects")["count"].to_pylist() == [9] * 4
    assert set(parts.read(BLOCKS[0], "outcomes")["outcome"].to_pylist()) == {"sensor_left_out"}


def test_blocks_are_the_same_alone_and_together(tmp_path, of):
    together = found_by(tmp_path / "together", of, {})
    for k, block in enumerate(BLOCKS):
        alone = found_by(tmp_path / f"alone{k}", of, {}, blocks=[block])
        for name in ("members", "rejects", "outcomes"):
            assert alone.read(block, name).equals(together.read(block, name))


def test_little_memory_gives_the_same_bits(tmp_path, monkeypatch):
    """Windows are read some at a time, and one at a time where no more fit."""
    scene = Scene(12, 4, times=np.arange(3.0, 300.0, 6.0)).objects(8).strays(6)
    of = tables(scene)
    one = found_by(tmp_path / "one", of, {})
    monkeypatch.setattr("epipole.schemas.settings.BYTES_PER_VIEW", 1 << 40)
    assert SETTINGS.work.max_views == 0
    other = found_by(tmp_path / "other", of, {})
    for name in ("members", "rejects", "outcomes"):
        assert one.read(BLOCKS[0], name).equals(other.read(BLOCKS[0], name))
    assert one.read(BLOCKS[0], "members").num_rows


def test_evidence_longer_than_a_block_is_summed_over_the_span(tmp_path):
    scene = Scene(11, 4, times=np.array([5.0, 400.0, 1000.0, 1500.0])).objects(3, spread_km=300.0)
    settings = Settings(association=AssociationSettings(window_s=1800.0))
    parts = found_by(tmp_path, tables(scene), {}, settings)
    assert parts.holds(SPAN)
    members = to_polars(parts.read(SPAN, "members"))
    assert members["n_views"].to_list() == [4] * 12
    assert members["object"].n_unique() == 3


def test_members_are_the_tracklets_of_each_object_with_their_times():
    scene = Scene(11, 3, times=np.arange(0.0, 120.0, 6.0)).objects(2, spread_km=300.0).strays(2)
    block = block_of(tables(scene))
    found = associate_objects(block, SETTINGS.association, SETTINGS.work.max_views)
    members = to_polars(object_members(block, found))
    assert members.columns == OBJECT_MEMBERS.names
    of_objects = [k for k, who in enumerate(scene.who) if who >= 0]
    assert sorted(members["tracklet_id"].to_list()) == [f"t{k:04d}" for k in of_objects]
    who = dict(
        zip([f"t{k:04d}" for k in of_objects], (scene.who[k] for k in of_objects), strict=True)
    )
    sensor = {f"t{k:04d}": scene.sensor[k] for k in of_objects}
    for name, number, of_sensor in members.select("tracklet_id", "sensor", "object").iter_rows():
        assert sensor[name] == number
        assert who[name] == who[members.filter(object=of_sensor)["tracklet_id"][0]]
    # Windows that follow one another are one row.
    assert members["n_views"].to_list() == [20] * 6
    seconds = members.select(
        (pl.col(name).cast(pl.Int64) - START_NS) / 1e9 for name in ("first_epoch", "last_epoch")
    )
    assert seconds.rows() == [(0.0, 114.0)] * 6
    assert members["object"].is_sorted()


def test_a_tracklet_that_is_of_no_object_for_a_while_has_two_members():
    """Seen by its own sensor only between two passes of another one, it is of no object there."""
    scene = Scene(11, 2, times=np.arange(0.0, 120.0, 6.0)).objects(1, spread_km=300.0)
    block = block_of(tables(scene))
    found = associate_objects(block, SETTINGS.association, SETTINGS.work.max_views)
    assert (found.object_number == 0).all()
    number = np.where(block.items.window == 1, -1, found.object_number)
    members = to_polars(object_members(block, found._replace(object_number=number)))
    assert members["tracklet_id"].to_list() == ["t0000", "t0000", "t0001", "t0001"]
    assert members["n_views"].to_list() == [5, 10, 5, 10]


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
            undecided(c="ambiguous", d="sensor_left_out", a="ambiguous", g="undecided"),
            outcomes(ids("g", "c"), Outcome.SEEN_BY_ONE),
            view_outcomes(associations(a=True, b=False)),
        ]
    )
    assert as_dict(judged) == {
        "a": Outcome.OBJECT,
        "b": Outcome.DISAGREES,
        "c": Outcome.AMBIGUOUS,
        "d": Outcome.SENSOR_LEFT_OUT,
        "e": Outcome.SEEN_BY_ONE,
        "f": Outcome.SENSOR_LEFT_OUT,
        "g": Outcome.UNDECIDED,
    }


def test_lone_detections_have_no_outcome():
    judged = outcomes(ids(f"{MARK}x", "a"), Outcome.SEEN_BY_ONE)
    assert as_dict(judged) == {"a": Outcome.SEEN_BY_ONE}


def test_views_without_a_published_tracklet_have_no_outcome():
    views = pa.table({"tracklet_id": pa.array([None, "a"]), "used": pa.array([True, True])})
    assert as_dict(view_outcomes(views)) == {"a": Outcome.OBJECT}


def test_a_tracklet_that_one_position_used_is_of_an_object():
    views = pa.table({"tracklet_id": ["a", "a", "b", "b"], "used": [False, True, False, False]})
    assert as_dict(view_outcomes(views)) == {"a": Outcome.OBJECT, "b": Outcome.DISAGREES}


@pytest.mark.parametrize("later", ["ambiguous", "seen_by_one", "disagrees"])
def test_an_object_in_one_span_is_one_in_the_night(later):
    spans = [undecided(a="object"), undecided(a=later, b=later)]
    for order in (spans, spans[::-1]):
        assert as_dict(best_outcomes(order)) == {"a": "object", "b": later}


def test_no_tracklets_have_no_outcomes():
    assert outcomes(ids(), Outcome.SEEN_BY_ONE).num_rows == 0
    assert view_outcomes(associations()).num_rows == 0
    assert best_outcomes([]).num_rows == 0


def test_every_tracklet_of_a_night_has_an_outcome(night_dataset):
    tracklets = pl.read_parquet(night_dataset / "night=*/tracklets/*.parquet")
    assert set(tracklets["outcome"]) <= {outcome.value for outcome in Outcome}
    views = pl.read_parquet(night_dataset / "night=*/associations/*.parquet").filter("used")
    of_objects = tracklets.filter(outcome="object")["tracklet_id"]
    assert set(of_objects) == set(views["tracklet_id"].drop_nulls())
