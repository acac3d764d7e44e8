"""Time slices: a span's rows from many parts, merged in times short enough to hold."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span

MOST_ROWS = 200_000  # in a slice, about


def in_slices(tables: Sequence[pa.Table], span: Span, column: str) -> Iterator[list[pa.Table]]:
    """Yield the rows of each table in one time after the other; together they are the span.

    Parameters
    ----------
    tables
        In any order of time; rows outside the span are left out.
    column
        The time of the rows.

    Notes
    -----
    The times depend on the number of rows only. The rows of a slice are views of the tables.
    """
    tables = [_in_order(rows, column) for rows in tables]
    count = max(-(-sum(rows.num_rows for rows in tables) // MOST_ROWS), 1)
    edges = np.linspace(span.start_ns, span.end_ns, count + 1).astype(np.int64)
    cuts = [np.searchsorted(array(rows, column), edges).tolist() for rows in tables]
    for k, _ in enumerate(itertools.pairwise(edges)):
        yield [
            rows.slice(cut[k], cut[k + 1] - cut[k]) for rows, cut in zip(tables, cuts, strict=True)
        ]


def _in_order(rows: pa.Table, column: str) -> pa.Table:
    time_ns = array(rows, column)
    if (np.diff(time_ns) >= 0).all():
        return rows
    return rows.take(np.argsort(time_ns, kind="stable"))
