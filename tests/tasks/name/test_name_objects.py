"""Name objects: an object of several spans has one name, in the order of first appearance."""

import numpy as np
from scenes.associations import filled

from epipole.io.work.part_tables import SOLVED
from epipole.io.work.parts import write_part
from epipole.io.work.places import SolvedParts
from epipole.schemas.bridge import empty
from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.tables import POSITIONS
from epipole.tasks.name.name_objects import name_objects, number_objects, number_of

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
