"""Solve a piece: larger errors of sensors count for positions, not for the check of the sensors."""

import collections

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from scenes.associations import SPAN, START_NS, block_of, tables, write_views
from scenes.object_members import SECOND_NS, SPANS, members, ns, seconds, views_of, write_spans
from scenes.tracklet_scenes import Scene

from epipole.io.work.parts import JUDGED, NUMBERED, read_part, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.bridge import array, empty, table, to_polars
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, Span
from epipole.schemas.work_tables import OBJECT_MEMBERS, SHARED_ERRORS, VIEWS
from epipole.tasks.solve.associate_block import object_members
from epipole.tasks.solve.associate_objects import associate_objects
from epipole.tasks.solve.sample_sight_lines import LineSampling
from epipole.tasks.solve.solve_piece import (
    MIN_OBJECTS,
    Piece,
    gather_views,
    sample_objects,
    solve_piece,
)

EVERY_NS = 10_000_000_000


@pytest.fixture(scope="module")
def block():
    of = tables(Scene(11, 4, times=np.arange(0.0, 60.0, 2.0)).objects(2, spread_km=300.0))
    views = of.views
    for name in ("sensor_vx_km_s", "sensor_vy_km_s", "sensor_vz_km_s"):
        at = views.schema.get_field_index(name)
        zero = pa.array(np.zeros(views.num_rows))
        views = views.set_column(at, views.schema.field(at), zero)
    return block_of(of._replace(views=views))


def piece_of(folder, block, errors, piece=0, count=1):
    """Solve a piece of the objects of a scene, with these errors of sensors."""
    settings, solved = Settings(), SolvedParts(folder)
    viewed = write_views(folder / "views", block.sensors, SPAN)
    members = object_members(
        block, associate_objects(block, settings.association, settings.work.max_views)
    )
    numbers = members["object"] if count > 1 else pa.array(np.zeros(members.num_rows, np.int64))
    at = members.schema.get_field_index("piece")
    members = members.set_column(at, members.schema.field(at), numbers)
    write_part(solved.objects.of(SPAN), NUMBERED, {"members": members})
    write_part(solved.errors.of(SPAN), JUDGED, {"errors": errors})
    made = Piece(SPAN, piece, count)
    n_positions = solve_piece.fn(
        viewed,
        made,
        30_000_000_000,
        LineSampling(EVERY_NS),
        settings.positions,
        settings.states,
        solved,
    )
    part = solved.piece(SPAN, piece)
    assert read_part(part, "positions").num_rows == n_positions
    return part


def larger(place: float) -> pa.Table:
    return table(SHARED_ERRORS, {"sensor_id": ["sat1"], "direction": [1.0], "position": [place]})


def test_positions_have_the_larger_errors_of_their_sensors(tmp_path, block):
    stated = read_part(piece_of(tmp_path / "a", block, empty(SHARED_ERRORS)), "positions")
    honest = read_part(piece_of(tmp_path / "b", block, larger(400.0)), "positions")
    assert stated.num_rows == honest.num_rows == 2 * 30
    assert (array(honest, "cov_xx") > array(stated, "cov_xx")).all()


def test_the_check_of_the_sensors_holds_them_against_their_stated_errors(tmp_path, block):
    """A fault that makes a sensor's errors larger would hide itself."""
    part = piece_of(tmp_path, block, larger(400.0))
    lines = read_part(part, "lines")
    assert set(lines["sensor_id"].to_pylist()) == {"sat0", "sat1", "sat2", "sat3"}
    np.testing.assert_allclose(array(lines, "position_sigma_km"), 0.02)


def test_lines_are_kept_at_some_epochs_only(tmp_path, block):
    lines = read_part(piece_of(tmp_path, block, empty(SHARED_ERRORS)), "lines")
    seconds = np.unique(array(lines, "epoch") - START_NS) / 1e9
    assert seconds.tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert lines.num_rows == 6 * 2 * 4


def test_the_pieces_together_are_the_whole(tmp_path, block):
    whole = piece_of(tmp_path / "whole", block, empty(SHARED_ERRORS))
    for name in ("positions", "associations", "states", "lines", "objects"):
        parts = [
            read_part(piece_of(tmp_path / f"{name}{k}", block, empty(SHARED_ERRORS), k, 2), name)
            for k in (0, 1)
        ]
        by = [("epoch", "ascending"), ("object_id", "ascending")]
        by += [("sensor_id", "ascending")] * (name in ("associations", "lines"))
        together = pa.concat_tables(parts).sort_by(by)
        assert together.equals(read_part(whole, name).sort_by(by)), name


EVER = Span(SPANS[0].start_ns, SPANS[-1].end_ns)
BORDER = 1800.0  # between the first two spans [s]


def rows_of(views, number):
    """Each view's time [s], object, tracklet."""
    return list(zip(seconds(views), number.tolist(), views["tracklet_id"].to_pylist(), strict=True))


def test_views_are_those_of_the_members_in_the_order_of_epochs_objects_and_sensors(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2], "a2": [0, 1, 2], "a3": [0, 1, 2]}),
        views_of(1, {"b1": [0, 1, 2], "b2": [0, 1, 2]}),
    ])  # fmt: skip
    found = members(
        (4, 0, "a1", "a1", 0, 2, 3), (2, 0, "a2", "a2", 0, 2, 3),
        (4, 1, "b1", "b1", 0, 2, 3), (2, 1, "b2", "b2", 0, 2, 3),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    assert views.schema == VIEWS
    assert rows_of(views, number) == [
        (t, k, name)
        for t in (0.0, 1.0, 2.0)
        for k, names in ((2, ("a2", "b2")), (4, ("a1", "b1")))
        for name in names
    ]


def test_views_at_epochs_at_which_no_second_sensor_has_one_are_left_out(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2, 3], "a2": [5, 6]}), views_of(1, {"b1": [2, 3, 4]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 0, "a2", "a2", 5, 6, 2), (0, 1, "b1", "b1", 2, 4, 3)
    )
    views, number = gather_views(viewed, found, EVER)
    assert rows_of(views, number) == [(t, 0, name) for t in (2.0, 3.0) for name in ("a1", "b1")]


def test_two_fragments_in_one_sensor_count_as_one_view(tmp_path):
    """The one with a centroid, or else the first."""
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [0, 1, 2, 3], "a2": [0, 1, 2, 3]},
                 missed=[("a1", 1), ("a1", 2), ("a2", 2)]),
        views_of(1, {"b1": [0, 1, 2]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 0, "a2", "a2", 0, 3, 4), (0, 1, "b1", "b1", 0, 2, 3)
    )
    views, number = gather_views(viewed, found, EVER)
    of_first = [row[2] for row in rows_of(views, number) if row[2] != "b1"]
    assert of_first == ["a1", "a2", "a1"]
    # At 3 s two fragments have a view, but they are of one sensor.
    assert set(seconds(views)) == {0.0, 1.0, 2.0}


def test_a_tracklet_of_two_objects_has_each_at_its_time(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members(
        (0, 0, "a1", "a1", 0, 3, 4), (0, 1, "b1", "b1", 0, 3, 4),
        (1, 0, "a1", "a1", 6, 9, 4), (1, 1, "b1", "b1", 6, 9, 4),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    assert seconds(views)[::2] == [0.0, 1.0, 2.0, 3.0, 6.0, 7.0, 8.0, 9.0]
    assert number.tolist() == [0] * 8 + [1] * 8


def test_views_outside_the_time_are_left_out(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 9, 10), (0, 1, "b1", "b1", 0, 9, 10))
    views, _ = gather_views(viewed, found, Span(ns(3), ns(6)))
    assert seconds(views)[::2] == [3.0, 4.0, 5.0]  # a span has its start, not its end


def test_only_epochs_that_are_multiples_of_a_time_are_gathered(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 9, 10), (0, 1, "b1", "b1", 0, 9, 10))
    views, number = gather_views(viewed, found, EVER, 4 * SECOND_NS)
    midnight_s = ns(0) % DAY_NS // SECOND_NS
    assert seconds(views)[::2] == [t for t in times if (midnight_s + t) % 4 == 0]
    assert len(number) == views.num_rows > 0


def test_members_outside_the_time_have_no_views(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [views_of(0, {"a1": times}), views_of(1, {"b1": times})])
    found = members((0, 0, "a1", "a1", 0, 3, 4), (0, 1, "b1", "b1", 0, 3, 4))
    for time in (Span(ns(6), ns(9)), Span(ns(-9), ns(-2))):
        views, number = gather_views(viewed, found, time)
        assert (views.num_rows, len(number)) == (0, 0)


def test_views_of_neighbouring_spans_are_gathered_within_the_time(tmp_path):
    """A tracklet that continues lies elsewhere among the views of the next span."""
    times = np.arange(BORDER - 40, BORDER + 40, 10.0)
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": times, "a0": times[:2]}), views_of(1, {"b1": times, "b0": times[6:]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", BORDER - 40, BORDER - 10, 4), (0, 0, "a1", "a1", BORDER, BORDER + 30, 4),
        (0, 1, "b1", "b1", BORDER - 40, BORDER - 10, 4), (0, 1, "b1", "b1", BORDER, BORDER + 30, 4),
    )  # fmt: skip
    for span, first, last in ((SPANS[0], -40, 10), (SPANS[1], -20, 30)):
        views, number = gather_views(viewed, found, span.widened(20 * SECOND_NS))
        expected = np.arange(BORDER + first, BORDER + last + 1, 10.0)
        assert seconds(views)[::2] == expected.tolist()
        assert views["tracklet_id"].to_pylist() == ["a1", "b1"] * len(expected)
        assert set(number.tolist()) == {0}


def test_a_sensor_without_a_part_of_a_span_has_no_views_there(tmp_path):
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": [BORDER - 5.0, BORDER + 5.0]}), views_of(1, {"b1": [BORDER - 5.0]}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", BORDER - 5, BORDER + 5, 2), (0, 1, "b1", "b1", BORDER - 5, BORDER - 5, 1)
    )
    views, _ = gather_views(viewed, found, EVER)
    assert seconds(views) == [BORDER - 5.0] * 2


def test_the_views_of_some_objects_do_not_depend_on_the_others(tmp_path):
    times = np.arange(10.0)
    viewed = write_spans(tmp_path, [
        views_of(0, {"a1": times, "a2": times}), views_of(1, {"b1": times, "b2": times}),
    ])  # fmt: skip
    found = members(
        (0, 0, "a1", "a1", 0, 9, 10), (1, 0, "a2", "a2", 0, 9, 10),
        (0, 1, "b1", "b1", 0, 9, 10), (1, 1, "b2", "b2", 2, 7, 6),
    )  # fmt: skip
    views, number = gather_views(viewed, found, EVER)
    for k in (0, 1):
        alone, own = gather_views(viewed, found.filter(pc.field("object") == k), EVER)
        assert alone.equals(views.filter(number == k))
        assert (own == k).all()


def test_no_members_have_no_views(tmp_path):
    viewed = write_spans(tmp_path, [views_of(0, {"a1": [0.0]})])
    views, number = gather_views(viewed, empty(OBJECT_MEMBERS), EVER)
    assert views.equals(empty(VIEWS))
    assert len(number) == 0


def random_members(seed, n_objects=60, n_sensors=7):
    """Objects that two sensors or more see, of different lengths; sensor 6 sees only two."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(n_objects):
        seen_by = rng.choice(n_sensors - 1, size=rng.integers(2, n_sensors), replace=False)
        own = [*sorted(seen_by.tolist()), *([n_sensors - 1] if k in (17, 41) else [])]
        rows += [(k, s, f"{s}-{k}", f"{s}-{k}", 0, 60, int(rng.integers(20, 400))) for s in own]
    return members(*rows)


def total(rows) -> int:
    return int(to_polars(rows)["n_views"].sum())


def test_all_objects_tell_where_all_may_be_held():
    rows = random_members(1)
    assert sample_objects(rows, total(rows)).equals(rows)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.9, 0.5, 0.2])
def test_some_objects_are_whole_and_no_more_than_may_be_held(seed, share):
    rows = random_members(seed)
    most = int(share * total(rows))
    chosen = sample_objects(rows, most)
    assert 0 < total(chosen) <= most
    objects = set(chosen["object"].to_pylist())
    assert chosen.equals(rows.filter(np.isin(rows["object"].to_numpy(), list(objects))))


@pytest.mark.parametrize("seed", range(4))
def test_each_sensor_gets_some_and_one_that_sees_few_gets_all_it_sees(seed):
    rows = random_members(seed)
    chosen = to_polars(sample_objects(rows, total(rows) // 2))
    seen = collections.Counter(chosen.select("sensor", "object").unique()["sensor"].to_list())
    assert seen.keys() == set(range(7))
    assert seen[6] == 2
    assert all(seen[sensor] >= MIN_OBJECTS for sensor in range(6))


def test_a_sensor_s_longest_objects_are_the_first():
    rows = members(*[
        (k, s, f"{s}-{k}", f"{s}-{k}", 0, 60, 100 + 10 * k) for k in range(20) for s in (0, 1)
    ])  # fmt: skip
    chosen = sample_objects(rows, total(rows) - 1)
    assert sorted(set(chosen["object"].to_pylist())) == list(range(20 - MIN_OBJECTS, 20))


def test_an_object_that_is_chosen_already_does_not_end_the_choice():
    """Three sensors see a long object, two of them also twenty short ones."""
    rows = members(
        *((0, s, f"{s}-0", f"{s}-0", 0, 60, n) for s, n in ((0, 10), (1, 500), (2, 400))),
        *((k, s, f"{s}-{k}", f"{s}-{k}", 0, 60, 5) for k in range(1, 21) for s in (1, 2)),
    )
    chosen = to_polars(sample_objects(rows, 1000))
    seen = collections.Counter(chosen.select("sensor", "object").unique()["sensor"].to_list())
    assert seen == {0: 1, 1: MIN_OBJECTS, 2: MIN_OBJECTS}


def test_one_object_is_judged_however_long_it_is():
    rows = members((0, 0, "a", "a", 0, 60, 500), (0, 1, "b", "b", 0, 60, 500))
    assert sample_objects(rows, 10).equals(rows)


def test_the_order_of_the_rows_does_not_matter():
    rows = random_members(2)
    mixed = rows.take(np.random.default_rng(0).permutation(rows.num_rows))
    one, other = (sample_objects(r, total(rows) // 4) for r in (rows, mixed))
    key = ["object", "sensor"]
    assert to_polars(one).sort(key).equals(to_polars(other).sort(key))
    assert pl.Series(one["object"].to_pylist()).n_unique() < 60


def test_no_objects_stay_none():
    assert sample_objects(empty(OBJECT_MEMBERS), 100).num_rows == 0
