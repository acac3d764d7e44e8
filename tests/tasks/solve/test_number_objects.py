"""Number objects: an object keeps its number in the night; pieces hold what a task may hold."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.object_members import SECOND_NS, SPANS, members

from epipole.io.work.parts import ASSOCIATED, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.settings import AssociationSettings, Settings, WorkSettings
from epipole.schemas.spans import BLOCK_NS, Span
from epipole.schemas.work_tables import OBJECT_MEMBERS
from epipole.tasks.solve.associate_block import blocks_of
from epipole.tasks.solve.number_objects import number_objects

BLOCK_S = BLOCK_NS / 1e9
SPAN_S = 3 * BLOCK_S
MARGIN_NS = 30 * SECOND_NS


def member(number, name, first, last, n_views=10, sensor=None):
    """A member whose track is its name up to a point: 'a.2' is a later tracklet of track 'a'."""
    sensor = ord(name[0]) - ord("a") if sensor is None else sensor
    return (number, sensor, name, name.split(".")[0], first, last, n_views)


def numbered(tmp_path, blocks, settings=None, spans=SPANS[:2]) -> tuple[SolvedParts, list[int]]:
    """Number objects of blocks, given by their number in the run; the others are empty."""
    settings, solved = settings or Settings(), SolvedParts(tmp_path)
    every = [block for span in spans for block in blocks_of(span, settings.association)]
    for k, block in enumerate(every):
        tables = {name: empty(schema) for name, schema in ASSOCIATED.items()}
        tables["members"] = members(*blocks[k]) if k in blocks else empty(OBJECT_MEMBERS)
        write_part(solved.blocks.of(block), ASSOCIATED, tables)
    return solved, number_objects.fn(
        spans, MARGIN_NS, settings.association, settings.work.max_views, solved
    )


def numbers(solved: SolvedParts, span: Span) -> dict[str, int]:
    """Return the number of the object of each tracklet of a span."""
    rows = solved.objects.read(span, "members")
    return dict(zip(rows["tracklet_id"].to_pylist(), rows["object"].to_pylist(), strict=True))


def test_an_object_keeps_its_number_over_blocks_and_spans_through_a_track(tmp_path):
    solved, pieces = numbered(tmp_path, {
        # In its block each object counts from 0.
        0: [member(0, "a", 0, 590), member(0, "b", 0, 590),
            member(1, "c", 0, 590), member(1, "d", 0, 590)],
        1: [member(0, "d.2", 600, 1190), member(0, "e", 600, 1190),
            member(1, "b.2", 600, 1190), member(1, "f", 600, 1190)],
        # The track of the first object's later sensor continues, no other.
        3: [member(0, "g", 1900, 2000), member(0, "h", 1900, 2000),
            member(1, "f.2", 1900, 2000), member(1, "i", 1900, 2000)],
    })  # fmt: skip
    first, second = (numbers(solved, span) for span in SPANS[:2])
    assert first == {"a": 0, "b": 0, "c": 1, "d": 1, "d.2": 1, "e": 1, "b.2": 0, "f": 0}
    assert second == {"g": 2, "h": 2, "f.2": 0, "i": 0}
    assert pieces == [1, 1]


def test_objects_without_a_common_track_are_two(tmp_path):
    solved, _ = numbered(tmp_path, {
        0: [member(0, "a", 0, 590), member(0, "b", 0, 590)],
        1: [member(0, "c", 600, 1190), member(0, "d", 600, 1190)],
    })  # fmt: skip
    assert numbers(solved, SPANS[0]) == {"a": 0, "b": 0, "c": 1, "d": 1}


def test_longer_evidence_than_a_block_makes_a_span_one_block(tmp_path):
    settings = Settings(association=AssociationSettings(window_s=900.0))
    assert blocks_of(SPANS[0], settings.association) == [SPANS[0]]
    solved, pieces = numbered(
        tmp_path, {1: [member(0, "a", 1800, 3000), member(0, "b", 1800, 3000)]}, settings
    )
    assert numbers(solved, SPANS[1]) == {"a": 0, "b": 0}
    assert pieces == [0, 1]


def test_blocks_divide_a_span():
    blocks = blocks_of(SPANS[0], AssociationSettings())
    assert [block.start_ns for block in blocks] == [
        SPANS[0].start_ns + k * BLOCK_NS for k in range(3)
    ]
    assert blocks[-1].end_ns == SPANS[0].end_ns
    assert {block.span for block in blocks} == {SPANS[0]}


def test_members_near_a_span_are_those_of_its_objects(tmp_path):
    """They show the motion at its ends; an object that is only near belongs to the neighbour."""
    border = SPAN_S
    solved, pieces = numbered(tmp_path, {
        2: [member(0, "a", border - 100, border - 1), member(0, "b", border - 100, border - 40),
            member(1, "c", border - 10, border - 1), member(1, "d", border - 10, border - 1)],
        3: [member(0, "a.2", border, border + 90), member(0, "b.2", border + 40, border + 90)],
    })  # fmt: skip
    assert numbers(solved, SPANS[0]) == {"a": 0, "b": 0, "a.2": 0, "c": 1, "d": 1}
    assert numbers(solved, SPANS[1]) == {"a": 0, "a.2": 0, "b.2": 0}
    assert pieces == [1, 1]


def many_objects(seed, n_objects=12) -> dict[int, list[tuple]]:
    """Members of objects in three blocks of the first span; each with thousands of views."""
    rng = np.random.default_rng(seed)
    blocks = {}
    for k in range(3):
        start = k * BLOCK_S
        blocks[k] = [
            (o, s, f"{s}-{o}.{k}", f"{s}-{o}", start, start + 590, int(rng.integers(500, 4000)))
            for o in range(n_objects)
            for s in range(3)
        ]
    return blocks


@pytest.mark.parametrize("memory_mib", [64, 128, 512])
def test_pieces_hold_whole_objects_and_what_a_task_may_hold(tmp_path, memory_mib):
    settings = Settings(work=WorkSettings(memory_mib=memory_mib))
    solved, pieces = numbered(tmp_path, many_objects(1), settings)
    rows = to_polars(solved.objects.read(SPANS[0], "members"))
    assert rows.group_by("object").agg(pl.col("piece").n_unique())["piece"].to_list() == [1] * 12
    held = rows.group_by("piece").agg(pl.col("n_views").sum(), pl.col("object").n_unique())
    assert sorted(held["piece"].to_list()) == list(range(pieces[0]))
    for n_views, n_objects in held.select("n_views", "object").iter_rows():
        assert n_views <= settings.work.max_views or n_objects == 1
    total = rows["n_views"].sum()
    assert pieces[0] >= total / settings.work.max_views
    assert pieces[1] == 0


def test_the_pieces_together_are_the_same_for_any_memory(tmp_path):
    found, counts = {}, []
    for memory_mib in (64, 96, 512):
        settings = Settings(work=WorkSettings(memory_mib=memory_mib))
        solved, pieces = numbered(tmp_path / str(memory_mib), many_objects(2), settings)
        rows = to_polars(solved.objects.read(SPANS[0], "members"))
        key = ["object", "sensor", "tracklet_id", "first_epoch"]
        found[memory_mib] = rows.drop("piece").sort(key)
        counts.append(pieces[0])
    assert counts[0] > counts[1] > counts[2] == 1
    assert found[64].equals(found[512])
    assert found[96].equals(found[512])


def test_the_order_of_the_rows_of_a_block_does_not_matter(tmp_path):
    rng = np.random.default_rng(0)
    blocks = many_objects(3)
    mixed = {k: [rows[j] for j in rng.permutation(len(rows))] for k, rows in blocks.items()}
    mixed = {k: sorted(rows, key=lambda row: row[0]) for k, rows in mixed.items()}
    one, _ = numbered(tmp_path / "one", blocks)
    other, _ = numbered(tmp_path / "other", mixed)
    assert one.objects.read(SPANS[0], "members").equals(other.objects.read(SPANS[0], "members"))


def test_parts_that_exist_are_not_made_again(tmp_path):
    solved, pieces = numbered(tmp_path, many_objects(1))
    before = {p: p.stat().st_ino for p in tmp_path.glob("objects/*/*")}
    assert (
        number_objects.fn(
            SPANS[:2], MARGIN_NS, AssociationSettings(), WorkSettings().max_views, solved
        )
        == pieces
    )
    assert {p: p.stat().st_ino for p in tmp_path.glob("objects/*/*")} == before


def test_no_objects_have_no_pieces(tmp_path):
    solved, pieces = numbered(tmp_path, {})
    assert pieces == [0, 0]
    rows: pa.Table = solved.objects.read(SPANS[0], "members")
    assert rows.equals(empty(OBJECT_MEMBERS))
