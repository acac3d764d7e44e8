"""Name objects: one id in the night for each object of the spans that has a position in it."""

from collections.abc import Mapping, Sequence

import polars as pl

from epipole.io.work.places import SolvedParts
from epipole.schemas.bridge import to_polars
from epipole.schemas.spans import Span

Names = dict[str, dict[str, str]]  # by the folder of a span: old name, new name


def number_objects(solved: SolvedParts, spans: Sequence[Span]) -> Names:
    """Return the number of each span's objects, by the folder of the span.

    Objects are numbered in the order of first appearance. The numbers have leading zeros, so that
    they are in order as text.

    Parameters
    ----------
    solved
        The parts of `solve`: an object has one number in all spans.
    spans
        The spans that have a part, in order.
    """
    numbers: dict[int, str] = {}
    names = {}
    for span in spans:
        tables = [
            to_polars(rows) for rows in solved.read(span, "positions", ["epoch", "object_id"])
        ]
        rows = pl.concat(tables) if tables else pl.DataFrame(schema=["epoch", "object_id"])
        first = rows.group_by("object_id").agg(pl.col("epoch").min()).sort("epoch", "object_id")
        names[span.folder] = {
            old: numbers.setdefault(number_of(old), f"{len(numbers) + 1:09d}")
            for old in first["object_id"].to_list()
        }
    return names


def name_objects(
    numbers: Names, spans: Sequence[Span], night: str, earlier: Mapping[str, str]
) -> Names:
    """Return the ids in the night of each span's objects, by the folder of the span.

    An object that was followed from the night before keeps its id. Others get the date of the
    night and a number, in the order of first appearance. Objects that have a position only before
    or after the night have no id: the night has no row of them.

    Parameters
    ----------
    numbers
        As of `number_objects`, of all spans.
    spans
        The spans of the night, in order.
    night
        UTC date.
    earlier
        Ids of the night before, by number.
    """
    date, ids, new = night.replace("-", ""), dict[str, str](), 0
    for span in spans:
        for number in numbers.get(span.folder, {}).values():
            if number not in ids:
                new += number not in earlier
                ids[number] = earlier.get(number, f"{date}-{new:05d}")
    return {
        folder: {old: ids[number] for old, number in of_span.items() if number in ids}
        for folder, of_span in numbers.items()
    }


def number_of(span_name: str) -> int:
    """Return the number in the night of an object, from its id in a span."""
    return int(span_name.rpartition("-")[2])
