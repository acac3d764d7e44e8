"""Time slices: a span's rows from many parts, merged in times short enough to hold."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span

MOST_ROWS = 200_000  # in a slice, about
ROWS_OF_TABLE = 600  # with many tables a slice has more rows: each table is opened for each slice


def in_slices(
    tables: Sequence[Callable[[], pa.Table]], span: Span, column: str
) -> Iterator[list[pa.Table]]:
    """Yield the rows of each table in one time after the other; together they are the span.

    Parameters
    ----------
    tables
        What reads each table: it is read again for each slice, so that all of a span is never
        held. In any order of time; rows outside the span are left out.
    column
        The time of the rows.

    Notes
    -----
    The times depend on the number of rows and tables only.
    """
    times = [array(read(), column).copy() for read in tables]
    orders = [None if (np.diff(t) >= 0).all() else np.argsort(t, kind="stable") for t in times]
    most = max(MOST_ROWS, ROWS_OF_TABLE * len(tables))
    count = max(-(-sum(len(t) for t in times) // most), 1)
    edges = np.linspace(span.start_ns, span.end_ns, count + 1).astype(np.int64)
    cuts = [
        np.searchsorted(t if order is None else t[order], edges)
        for t, order in zip(times, orders, strict=True)
    ]
    del times
    for k in range(count):
        yield [
            _rows(read, order, int(cut[k]), int(cut[k + 1]))
            for read, order, cut in zip(tables, orders, cuts, strict=True)
        ]


def _rows(
    read: Callable[[], pa.Table], order: npt.NDArray[np.int64] | None, first: int, last: int
) -> pa.Table:
    """Return a copy of some rows: of a file that is mapped into memory, only these are kept."""
    rows = np.arange(first, last) if order is None else order[first:last]
    return read().take(rows)
