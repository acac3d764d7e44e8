"""Link objects: objects keep their ids across gaps of all sensors."""

import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.associations import filled

from epipole.io.work.parts import SOLVED, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.bridge import concat, empty, table
from epipole.schemas.scene import validate_scene
from epipole.schemas.settings import Settings
from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS, STATES
from epipole.schemas.work_tables import LAST_FRAMES, OBJECT_DETECTIONS
from epipole.tasks.algorithms.orbits.orbit_fit import propagate
from epipole.tasks.name.earlier_objects import EarlierViews
from epipole.tasks.name.object_ids import (
    counted_alike,
    followed_objects,
    link_objects,
    name_objects,
    number_objects,
    number_of,
    outermost,
    renamed,
)

T0 = 1_554_091_200_000_000_000
GEO = np.array([-39359.89, 15125.76, 64.30, -1.1030, -2.8700, 0.01])
SETTINGS = Settings()
FOUR_SENSORS = Path(__file__).parents[3] / "io/simulation/built_in/four_sensor_geo.toml"


def positions_of(passes):
    """Exact positions every 10 s of objects by id, each with its passes (truth, from, to) [s]."""
    rows = [
        (T0 + int(t * 1e9), name, *propagate(truth, t)[:3])
        for name, truth, first, last in passes
        for t in np.arange(first, last + 1, 10.0)
    ]
    epoch, name, *place = (list(column) for column in zip(*sorted(rows), strict=True))
    zeros = np.zeros(len(name))
    columns = {"epoch": np.array(epoch), "time": np.array(epoch), "object_id": name}
    columns |= {f"{a}_km": p for a, p in zip("xyz", place, strict=True)}
    columns |= {f"cov_{a}{a}": zeros + 1.0 for a in "xyz"}
    columns |= {f"cov_{ab}": zeros for ab in ("xy", "xz", "yz")} | {"chi2": zeros}
    columns |= {n: zeros.astype(np.int32) for n in ("n_sensors", "n_rejected")}
    return table(POSITIONS, columns | {"residual_px": zeros, "independent": zeros > 0})


def states_of(passes):
    """Nearly exact states at the middle of each pass."""
    rows = []
    for name, truth, first, last in passes:
        t = (first + last) / 2
        rows.append((T0 + int(t * 1e9), name, *propagate(truth, t)))
    epoch, name, *state = (list(column) for column in zip(*rows, strict=True))
    columns = {n: np.zeros(len(name)) for n in STATES.names} | {"epoch": np.array(epoch)}
    columns |= {"object_id": name}
    columns |= {n: np.full(len(name), 5, np.int32) for n in ("n_epochs", "n_views", "dof")}
    names = [*(f"{a}_km" for a in "xyz"), *(f"v{a}_km_s" for a in "xyz")]
    columns |= dict(zip(names, state, strict=True))
    columns |= {f"cov_{a}{a}": np.full(len(name), 0.25) for a in "xyz"}
    columns |= {f"cov_v{a}v{a}": np.full(len(name), 1e-6) for a in "xyz"}
    return table(STATES, columns)


OTHER = GEO + np.array([300.0, 0, 0, 0, 0.02, 0])
PASSES = [("1", GEO, 0, 60), ("2", OTHER, 0, 60), ("3", OTHER, 300, 360), ("4", GEO, 330, 400)]


def test_ids_change_to_the_first_one_of_their_object():
    positions, states = positions_of(PASSES), states_of(PASSES)
    new_id = link_objects.fn(positions, states, SETTINGS.states)
    assert new_id == {"3": "2", "4": "1"}
    ids = set(renamed(positions, new_id)["object_id"].to_pylist())
    assert ids == {"1", "2"}
    assert renamed(positions, {}) is positions


def test_an_object_without_a_state_is_recognised_by_its_position():
    states = states_of(PASSES[:2])
    assert link_objects.fn(positions_of(PASSES), states, SETTINGS.states) == {"3": "2", "4": "1"}
    assert link_objects.fn(positions_of(PASSES), states.slice(0, 0), SETTINGS.states) == {}


def test_only_first_and_last_positions_are_needed():
    positions, states = positions_of(PASSES), states_of(PASSES)
    few = outermost(positions)
    assert few.num_rows == 2 * len(PASSES)
    assert link_objects.fn(few, states, SETTINGS.states) == link_objects.fn(
        positions, states, SETTINGS.states
    )


def test_linking_can_be_switched_off():
    off = SETTINGS.model_copy(
        update={"states": SETTINGS.states.model_copy(update={"link_gap_s": 0.0})}
    )
    assert link_objects.fn(positions_of(PASSES), states_of(PASSES), off.states) == {}


def test_no_positions_give_no_links():
    assert link_objects.fn(empty(POSITIONS), empty(STATES), SETTINGS.states) == {}
    assert renamed(empty(ASSOCIATIONS), {"2": "1"}).num_rows == 0


@pytest.fixture(scope="module")
def gap_dataset(prefect, tmp_path_factory):
    """Four sensors see nine objects for 45 s; after ten minutes three of them see them again."""
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    folder = tmp_path_factory.mktemp("gap")
    scene = tomllib.loads(FOUR_SENSORS.read_text())
    scene |= {"duration_s": 690.0, "seed": 5}
    for sensor in scene["sensors"]:
        ends = 690.0 if sensor["id"] == "sat2" else 645.0
        sensor["outages_s"] = [[45.0, ends]]
    simulate(validate_scene(scene, "gap"), folder / "gap.mcap")
    nightly([str(folder / "gap.mcap")], str(folder / "out"))
    return folder


def test_objects_keep_their_ids_across_a_gap_of_all_sensors(gap_dataset):
    def scan(name):
        return pl.read_parquet(gap_dataset / f"out/night=*/{name}/*.parquet")

    positions = scan("positions")
    assert positions["object_id"].n_unique() == 9
    later = positions.filter(pl.col("epoch") > pl.col("epoch").min() + pl.duration(seconds=600))
    assert later["object_id"].n_unique() == 9
    truth = pl.read_parquet(gap_dataset / "gap.mcap.truth/points.parquet")
    views = scan("associations").drop_nulls("centroid")
    views = views.join(truth, on=["sensor_id", "frame_number", "centroid"])
    whose = views.filter(pl.col("kind") == 1).group_by("object_id").agg(pl.col("source").n_unique())
    assert whose["source"].to_list() == [1] * 9
    assert set(scan("states")["object_id"]) == set(positions["object_id"])


def views(*rows):
    """Rows: object, frame number, centroid, used; all of one sensor."""
    columns = ("object_id", "frame_number", "centroid", "used")
    named = [dict(zip(columns, row, strict=True)) | {"sensor_id": "a"} for row in rows]
    return pa.Table.from_pylist(named, schema=OBJECT_DETECTIONS)


BEFORE = views(("x", 1, 0, True), ("x", 2, 0, True), ("y", 1, 1, True), ("z", 1, 2, False))


def test_an_object_with_the_same_detections_is_the_same():
    own = views(("1", 1, 0, True), ("1", 2, 0, True), ("2", 1, 1, True), ("3", 1, 3, True))
    assert followed_objects([own], BEFORE) == {"1": "x", "2": "y"}


def test_views_that_positions_were_solved_without_do_not_count():
    own = views(("3", 1, 2, True), ("1", 1, 0, False))
    assert followed_objects([own], BEFORE) == {}


def test_views_of_missed_detections_do_not_count():
    missed = views(("x", 1, None, True))
    assert followed_objects([views(("1", 1, None, True))], missed) == {}


def test_an_id_goes_to_one_object_only_the_one_that_shares_more():
    own = views(("1", 1, 0, True), ("2", 2, 0, True), ("2", 3, 0, True))
    before = concat(OBJECT_DETECTIONS, [BEFORE, views(("x", 3, 0, True))])
    assert followed_objects([own], before) == {"2": "x"}


def test_an_object_of_which_no_id_has_more_than_half_is_new():
    own = views(("1", 1, 0, True), ("1", 1, 1, True))
    assert followed_objects([own], BEFORE) == {}


def test_each_detection_counts_once():
    own = views(("1", 1, 0, True), ("1", 1, 0, True), ("1", 1, 1, True))
    assert followed_objects([own], BEFORE) == {}


def test_without_a_night_before_all_objects_are_new():
    own = views(("1", 1, 0, True))
    assert followed_objects([own], OBJECT_DETECTIONS.empty_table()) == {}
    assert followed_objects([], BEFORE) == {}


def last_frames(**of_sensors: tuple[int, float]) -> pa.Table:
    """LAST_FRAMES: the number of each sensor's frame and its time [s]."""
    rows = [
        {"sensor_id": name, "frame_number": number, "time": round(t * 1e9)}
        for name, (number, t) in of_sensors.items()
    ]
    return pa.Table.from_pylist(rows, schema=LAST_FRAMES)


# Of the last second before midnight: frame 2 of BEFORE is the 102nd here, and 40 ms later.
RENUMBERED = np.array([98.54, 99.04, 99.54]) * 1e9, np.array([101, 102, 103])


def test_objects_are_followed_although_a_counter_restarted_in_the_night_before():
    own = views(("1", 101, 0, True), ("1", 102, 0, True), ("2", 101, 1, True))
    before = EarlierViews(BEFORE, last_frames(a=(2, 99.0), b=(5, 99.0)))
    alike = counted_alike(before, {"a": RENUMBERED})
    assert followed_objects([own], alike) == {"1": "x", "2": "y"}
    assert alike["frame_number"].to_pylist() == [101, 102, 101, 101]


@pytest.mark.parametrize("frames", [{}, {"a": (np.array([3e9]), np.array([7]))}])
def test_numbers_stay_where_the_last_frame_is_not_there(frames):
    before = EarlierViews(BEFORE, last_frames(a=(2, 99.0)))
    assert counted_alike(before, frames).equals(BEFORE)
    assert counted_alike(before._replace(frames=last_frames()), frames).equals(BEFORE)


MIDNIGHT_NS = int(np.datetime64("2019-04-02", "ns").astype(np.int64))
SPANS = [Span(MIDNIGHT_NS + k * SPAN_NS, MIDNIGHT_NS + (k + 1) * SPAN_NS) for k in (-1, 0, 1)]


def solved_piece(solved: SolvedParts, span: Span, piece: int, *rows: tuple[float, str]) -> None:
    """Write the positions of a piece, each its time after the span's start [s] and its object."""
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    tables["positions"] = filled(POSITIONS, len(rows), {
        "epoch": [span.start_ns + round(t * 1e9) for t, _ in rows],
        "object_id": [name for _, name in rows],
    })  # fmt: skip
    write_part(solved.piece(span, piece), SOLVED, tables)


def test_an_object_has_one_number_in_all_spans(tmp_path):
    solved = SolvedParts(tmp_path)
    solved_piece(solved, SPANS[0], 0, (5.0, "20190401-00003"), (9.0, "20190401-00003"))
    solved_piece(solved, SPANS[1], 0, (0.0, "20190402-00003"), (1.0, "20190402-00007"))
    assert number_objects(solved, SPANS) == {
        SPANS[0].folder: {"20190401-00003": "000000001"},
        SPANS[1].folder: {"20190402-00003": "000000001", "20190402-00007": "000000002"},
        SPANS[2].folder: {},
    }


def test_objects_are_counted_in_the_order_of_their_first_positions_whatever_their_pieces(tmp_path):
    one, other = SolvedParts(tmp_path / "one"), SolvedParts(tmp_path / "other")
    rows = [(8.0, "20190401-00001"), (3.0, "20190401-00002"), (3.0, "20190401-00004")]
    solved_piece(one, SPANS[0], 0, *rows)
    for k, row in enumerate(rows):
        solved_piece(other, SPANS[0], k, row)
    assert number_objects(one, SPANS[:1]) == number_objects(other, SPANS[:1])
    assert list(number_objects(one, SPANS[:1])[SPANS[0].folder].items()) == [
        ("20190401-00002", "000000001"), ("20190401-00004", "000000002"),
        ("20190401-00001", "000000003"),
    ]  # fmt: skip


def test_objects_without_a_position_have_no_number(tmp_path):
    solved = SolvedParts(tmp_path)
    solved_piece(solved, SPANS[0], 0)
    assert number_objects(solved, SPANS[:1]) == {SPANS[0].folder: {}}
    assert number_objects(SolvedParts(tmp_path / "none"), SPANS[:1]) == {SPANS[0].folder: {}}


def test_ids_have_the_date_of_the_night_and_count_its_objects_only():
    numbers = {SPANS[0].folder: {"a": "1", "b": "2"}, SPANS[1].folder: {"c": "3", "d": "2"}}
    assert name_objects(numbers, SPANS[1:], "2019-04-02", {}) == {
        SPANS[0].folder: {"b": "20190402-00002"},
        SPANS[1].folder: {"c": "20190402-00001", "d": "20190402-00002"},
    }


def test_objects_of_the_night_before_keep_their_id():
    numbers = {SPANS[0].folder: {"a": "1"}, SPANS[1].folder: {"a": "1", "b": "2"}}
    earlier = {"1": "20190331-00007"}
    assert name_objects(numbers, SPANS[1:], "2019-04-02", earlier) == {
        SPANS[0].folder: {"a": "20190331-00007"},
        SPANS[1].folder: {"a": "20190331-00007", "b": "20190402-00001"},
    }


def test_numbers_may_have_more_than_five_digits():
    assert number_of("20190401-00042") == 42
    assert number_of("20190401-1234567") == 1234567
