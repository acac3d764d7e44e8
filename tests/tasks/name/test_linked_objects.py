"""Linked objects: where several sensors saw what an orbit joins, it has positions."""

import numpy as np
import polars as pl
import pytest
from scenes.associations import block_of, filled, tables, write_views
from scenes.object_members import SECOND_NS, SPANS, members, ns, views_of, write_spans
from scenes.tracklet_scenes import Scene

from epipole.io.work.parts import JUDGED, NUMBERED, SOLVED, Parts, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.bridge import empty, table
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS
from epipole.schemas.tables import POSITIONS, TRACKLETS
from epipole.schemas.work_tables import LINKED_TRACKLETS, OBJECT_MEMBERS, SHARED_ERRORS
from epipole.tasks.name import linked_objects
from epipole.tasks.name.linked_objects import (
    LinkedMembers,
    add_linked_members,
    names_with_linked,
    tracklets_at_once,
    without_refused,
)
from epipole.tasks.solve.sample_sight_lines import LineSampling
from epipole.tasks.solve.solve_piece import Piece, solve_piece

MARGIN_NS = 30 * SECOND_NS
SPAN, NEXT = SPANS[:2]
# Tracklets: name, sensor, object, first and last second. Those of "x" are of an object.
TEN = [*range(0, 10, 2)]


def tracklets(*rows):
    name, sensor, object_id, first, last = zip(*rows, strict=True)
    return filled(TRACKLETS, len(rows), {
        "tracklet_id": name, "track_id": name, "sensor_id": [f"s{k}" for k in sensor],
        "object_id": object_id, "start_time": [ns(t) for t in first],
        "end_time": [ns(t) for t in last],
    })  # fmt: skip


def at_once(rows, linked):
    columns = {"tracklet_id": list(linked), "object_id": ["x"] * len(linked)}
    return tracklets_at_once(pl.DataFrame(tracklets(*rows)), table(LINKED_TRACKLETS, columns))


def named(joined):
    return joined["tracklet_id"].sort().to_list()


def test_a_linked_tracklet_counts_where_another_sensor_has_one_of_its_object():
    a, b = ("a", 0, "x", 0, 10), ("b", 1, "x", 5, 20)
    assert named(at_once([a, b], "ab")) == ["a", "b"]
    assert named(at_once([a, b], "b")) == ["b"]
    assert named(at_once([a, b], "")) == []
    # A long one between holds the ends together; the order of rows does not matter.
    between = ("c", 0, "x", 1000, 1010), ("long", 1, "x", 0, 2000), ("d", 0, "x", 1900, 1910)
    for rows in ([a, *between], [*between[::-1], a]):
        assert named(at_once(rows, "cd")) == ["c", "d"]


@pytest.mark.parametrize("other", [
    ("b", 0, "x", 5, 20),  # of the same sensor
    ("b", 1, "y", 5, 20),  # of another object
    ("b", 1, None, 5, 20),
    ("b", 1, "x", 200, 300),  # at another time
])  # fmt: skip
def test_a_linked_tracklet_that_no_other_sensor_shares_does_not(other):
    assert named(at_once([("a", 0, "x", 0, 10), other], "a")) == []


@pytest.fixture
def all_meet(monkeypatch):
    """Lines of sight that meet: these views have no directions."""

    def agreeing(views, number, linked, *_):
        names = views["tracklet_id"].to_pylist()
        rows = pl.DataFrame({"object": number, "tracklet_id": names, "agrees": [True] * len(names)})
        return rows.filter(pl.col("tracklet_id").is_in(linked["tracklet_id"].implode()))

    monkeypatch.setattr(linked_objects, "_agreeing_views", agreeing)


def solved_spans(folder, *rows, pieces=None):
    """Members of the first span, as `number_objects` leaves them; the next one has none."""
    solved = SolvedParts(folder / "solved")
    of_first = members(*rows) if rows else empty(OBJECT_MEMBERS)
    if pieces:
        at = of_first.schema.get_field_index("piece")
        of_first = of_first.set_column(at, of_first.schema.field(at), [pieces])
    for span, of_span in ((SPAN, of_first), (NEXT, empty(OBJECT_MEMBERS))):
        write_part(solved.objects.of(span), NUMBERED, {"members": of_span})
    return solved


def add(folder, solved, joined, seen, names, max_views=1000):
    viewed = write_spans(folder / "views", [views_of(k, of) for k, of in seen.items()])
    sensors = {f"s{k}": k for k in seen}
    return add_linked_members.fn(
        joined, sensors, SPANS[:2], names, MARGIN_NS, max_views, 4.5, viewed, solved
    )


def objects_of(solved, span=SPAN):
    rows = pl.DataFrame(solved.with_links().objects.read(span, "members"))
    return {
        name: (number, piece)
        for name, number, piece in rows.select("tracklet_id", "object", "piece").rows()
    }


def member(number, name, sensor):
    return (number, sensor, name, name, 0, 8, 5)


OTHERS = [member(4, "p", 2), member(4, "q", 3)]
SEEN = {2: {"p": TEN}, 3: {"q": TEN}}


def test_two_linked_tracklets_are_a_new_object_in_a_piece_of_its_own(tmp_path, all_meet):
    solved = solved_spans(tmp_path, *OTHERS)
    joined = at_once([("a", 0, "x", 0, 8), ("b", 1, "x", 0, 8)], "ab")
    names = {SPAN.folder: {"20190401-00005": "w"}, NEXT.folder: {}}
    found = add(tmp_path, solved, joined, {0: {"a": TEN}, 1: {"b": TEN}, **SEEN}, names)
    assert found.pieces == [Piece(SPAN, 1, 2)]
    assert found.ids == {5: "w", 6: "x"}
    assert objects_of(solved) == {"p": (4, 0), "q": (4, 0), "a": (5, 1), "b": (5, 1)}
    rows = solved.with_links().objects.read(SPAN, "members").to_pylist()
    (of_a,) = [row for row in rows if row["tracklet_id"] == "a"]
    assert (of_a["sensor"], of_a["n_views"]) == (0, 5)
    assert [int(of_a[f"{end}_epoch"].timestamp()) - ns(0) // SECOND_NS
            for end in ("first", "last")] == [0, 8]  # fmt: skip
    assert not solved.with_links().objects.holds(NEXT)
    assert not objects_of(solved).keys() - {*"abpq"}


def test_a_linked_tracklet_joins_its_object_in_its_piece(tmp_path, all_meet):
    solved = solved_spans(
        tmp_path, *OTHERS, member(7, "a", 0), member(7, "b", 1), pieces=[0, 0, 1, 1]
    )
    joined = at_once([("a", 0, "x", 0, 8), ("b", 1, "x", 0, 8), ("c", 2, "x", 0, 8)], "c")
    names = {SPAN.folder: {"20190401-00005": "w", "20190401-00008": "x"}}
    seen = {0: {"a": TEN}, 1: {"b": TEN}, 2: {"c": TEN, "p": TEN}, 3: {"q": TEN}}
    found = add(tmp_path, solved, joined, seen, names)
    assert found.pieces == [Piece(SPAN, 1, 2)]
    assert objects_of(solved)["c"] == (7, 1)
    assert objects_of(solved)["p"] == (4, 0)


def test_two_numbers_of_one_object_become_the_first(tmp_path, all_meet):
    rows = [member(7, "a", 0), member(7, "b", 1), member(3, "d", 0), member(3, "e", 1)]
    solved = solved_spans(tmp_path, *OTHERS, *rows, pieces=[0, 0, 1, 1, 2, 2])
    joined = at_once([("a", 0, "x", 0, 8), ("c", 2, "x", 0, 8)], "c")
    names = {SPAN.folder: {"20190401-00008": "x", "20190401-00004": "x"}}
    seen = {0: {"a": TEN, "d": [30, 32]}, 1: {"b": TEN, "e": [30, 32]}, 2: {"c": TEN}}
    found = add(tmp_path, solved, joined, seen, names)
    assert {objects_of(solved)[name] for name in "abcde"} == {(3, 1)}
    assert found.pieces == [Piece(SPAN, k, 3) for k in (1, 2)]
    emptied, parts = found.pieces[1], solved.with_links()
    write_part(solved.errors.of(SPAN), JUDGED, {"errors": empty(SHARED_ERRORS)})
    viewed = {k: Parts(tmp_path / "views" / str(k)) for k in seen}
    settings = Settings()
    assert not solve_piece.fn(
        viewed, emptied, MARGIN_NS, LineSampling(DAY_NS), settings.positions, settings.states, parts
    )  # fmt: skip


def test_tracklets_without_a_common_epoch_change_nothing(tmp_path, all_meet):
    solved = solved_spans(tmp_path, *OTHERS)
    joined = at_once([("a", 0, "x", 0, 8), ("b", 1, "x", 1, 9)], "ab")
    seen = {0: {"a": TEN}, 1: {"b": [1, 3, 5]}, **SEEN}
    found = add(tmp_path, solved, joined, seen, {SPAN.folder: {}})
    assert found.pieces == []
    assert not solved.with_links().objects.holds(SPAN)


def test_an_object_at_the_end_of_a_span_is_in_both(tmp_path, all_meet):
    solved = solved_spans(tmp_path)
    end = (NEXT.start_ns - ns(0)) / SECOND_NS
    times = [end - 4, end - 2, end, end + 2]
    joined = at_once([(name, k, "x", times[0], times[-1]) for k, name in enumerate("ab")], "ab")
    found = add(tmp_path, solved, joined, {0: {"a": times}, 1: {"b": times}}, {})
    assert found.pieces == [Piece(SPAN, 0, 1), Piece(NEXT, 0, 1)]
    # The margin is there for the motion at the ends.
    for span in SPANS[:2]:
        rows = solved.with_links().objects.read(span, "members")
        assert sum(rows["n_views"].to_pylist()) == 8


@pytest.mark.parametrize("others", [[], OTHERS])
def test_a_span_that_an_object_only_comes_near_to_stays_as_it_is(tmp_path, all_meet, others):
    solved = solved_spans(tmp_path, *others)
    begin = (NEXT.start_ns - ns(0)) / SECOND_NS
    times = [begin, begin + 2, begin + 4]
    joined = at_once([(name, k, "x", times[0], times[-1]) for k, name in enumerate("ab")], "ab")
    found = add(tmp_path, solved, joined, {0: {"a": times}, 1: {"b": times}, **SEEN}, {})
    assert found.pieces == [Piece(NEXT, 0, 1)]
    assert not solved.with_links().objects.holds(SPAN)


def test_tracklets_whose_lines_of_sight_do_not_meet_are_refused(tmp_path):
    """Of two objects, seen by four sensors, each object's own tracklets meet."""
    of = tables(Scene(11, 4, times=np.arange(0.0, 60.0, 2.0)).objects(2, spread_km=300.0))
    sensors = block_of(of).sensors
    viewed, solved = write_views(tmp_path / "views", sensors, SPAN), solved_spans(tmp_path)
    number = {each.sensor_id: each.number for each in sensors}
    # The first four are of one object, the others of the second.
    objects = {"t0000": "wrong", "t0005": "wrong", "t0002": "right", "t0003": "right"}
    joined = (
        pl.DataFrame(of.tracklets)
        .with_columns(object_id=pl.col("tracklet_id").replace_strict(objects, default=None))
        .drop_nulls("object_id")
    )
    columns = ["tracklet_id", "track_id", "sensor_id", "object_id", "start_time", "end_time"]
    found = add_linked_members.fn(
        joined.select(columns), number, [SPAN], {}, MARGIN_NS, 1000, 4.5, viewed, solved
    )
    assert found.refused == ["t0000", "t0005"]
    assert set(objects_of(solved)) == {"t0002", "t0003"}


def test_what_is_refused_leaves_no_single_tracklet_of_a_new_object():
    rows = {"tracklet_id": list("abcdef"), "object_id": list("xxyyzw")}
    linked = table(LINKED_TRACKLETS, rows)
    names = {"span": {"1": "z"}}
    assert without_refused(linked, [], names).equals(linked)
    left = without_refused(linked, ["a"], names)
    assert left["tracklet_id"].to_pylist() == ["c", "d", "e"]


def test_objects_with_first_positions_have_their_names(tmp_path):
    solved = SolvedParts(tmp_path)
    for parts, name, piece in (
        (solved, "20190401-00005", 0),
        (solved.with_links(), "20190401-00006", 1),
    ):
        tables = {key: empty(schema) for key, schema in SOLVED.items()}
        tables["positions"] = filled(POSITIONS, 1, {"object_id": [name]})
        write_part(parts.piece(SPAN, piece), SOLVED, tables)
    found = LinkedMembers([Piece(SPAN, 1, 2)], {5: "w", 6: "x", 9: "other"}, [])
    before = {SPAN.folder: {"20190401-00005": "w"}, NEXT.folder: {"20190401-00010": "other"}}
    assert names_with_linked(before, solved.with_links(), found) == {
        SPAN.folder: {"20190401-00005": "w", "20190401-00006": "x"},
        NEXT.folder: {"20190401-00010": "other"},
    }
    assert len(solved.pieces(SPAN)) == 1
