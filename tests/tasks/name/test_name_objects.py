"""Name objects: an object of several spans has one name, in the order of first appearance."""

import numpy as np
from scenes.associations import filled

from epipole.io.work.part_tables import SOLVED
from epipole.io.work.parts import write_part
from epipole.io.work.places import SolvedParts
from epipole.schemas.bridge import empty
from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.tables import POSITIONS
from epipole.tasks.name.name_objects import name_objects, number_of

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


def test_an_object_has_one_name_in_all_spans(tmp_path):
    solved = SolvedParts(tmp_path)
    solved_piece(solved, SPANS[0], 0, (5.0, "20190401-00003"), (9.0, "20190401-00003"))
    solved_piece(solved, SPANS[1], 0, (0.0, "20190402-00003"), (1.0, "20190402-00007"))
    names = name_objects(solved, SPANS)
    assert names == {
        SPANS[0].folder: {"20190401-00003": "20190401-00001"},
        SPANS[1].folder: {"20190402-00003": "20190401-00001", "20190402-00007": "20190402-00002"},
        SPANS[2].folder: {},
    }


def test_objects_are_counted_in_the_order_of_their_first_positions_whatever_their_pieces(tmp_path):
    one, other = SolvedParts(tmp_path / "one"), SolvedParts(tmp_path / "other")
    rows = [(8.0, "20190401-00001"), (3.0, "20190401-00002"), (3.0, "20190401-00004")]
    solved_piece(one, SPANS[0], 0, *rows)
    for k, row in enumerate(rows):
        solved_piece(other, SPANS[0], k, row)
    assert name_objects(one, SPANS[:1]) == name_objects(other, SPANS[:1])
    assert list(name_objects(one, SPANS[:1])[SPANS[0].folder].items()) == [
        ("20190401-00002", "20190401-00001"), ("20190401-00004", "20190401-00002"),
        ("20190401-00001", "20190401-00003"),
    ]  # fmt: skip


def test_objects_without_a_position_have_no_name(tmp_path):
    solved = SolvedParts(tmp_path)
    solved_piece(solved, SPANS[0], 0)
    assert name_objects(solved, SPANS[:1]) == {SPANS[0].folder: {}}
    assert name_objects(SolvedParts(tmp_path / "none"), SPANS[:1]) == {SPANS[0].folder: {}}


def test_numbers_may_have_more_than_five_digits():
    assert number_of("20190401-00042") == 42
    assert number_of("20190401-1234567") == 1234567
