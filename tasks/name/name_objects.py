"""Name objects: one id in the night for each object of the spans that has a position."""

from collections.abc import Sequence

import numpy as np
import polars as pl

from epipole.io.work.places import SolvedParts
from epipole.schemas.bridge import to_polars
from epipole.schemas.spans import Span


def name_objects(solved: SolvedParts, spans: Sequence[Span]) -> dict[str, dict[str, str]]:
    """Return the names in the night of each span's objects, by the folder of the span.

    A name is the UTC date of the first span with the object, and the object's number in the night,
    in the order of first appearance.

    Parameters
    ----------
    solved
        The parts of `solve`: an object has one number in all spans.
    spans
        The spans that have a part, in order.
    """
    ids: dict[int, str] = {}
    names = {}
    for span in spans:
        date = str(np.datetime64(span.start_ns, "ns").astype("datetime64[D]")).replace("-", "")
        tables = [
            to_polars(rows) for rows in solved.read(span, "positions", ["epoch", "object_id"])
        ]
        rows = pl.concat(tables) if tables else pl.DataFrame(schema=["epoch", "object_id"])
        first = rows.group_by("object_id").agg(pl.col("epoch").min()).sort("epoch", "object_id")
        of_span = {}
        for old in first["object_id"].to_list():
            number = number_of(old)
            of_span[old] = ids.setdefault(number, f"{date}-{len(ids) + 1:05d}")
        names[span.folder] = of_span
    return names


def number_of(span_name: str) -> int:
    """Return the number in the night of an object, from its id in a span."""
    return int(span_name.rpartition("-")[2])
