"""Time slices: a span's rows from many parts, merged in times short enough to hold."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span

MOST_ROWS = 200_000  # in a slice, about


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
    The times depend on the number of rows only.
    """
    n_rows = sum(read().num_rows for read in tables)
    count = max(-(-n_rows // MOST_ROWS), 1)
    edges = np.linspace(span.start_ns, span.end_ns, count + 1).astype(np.int64)
    cuts = [np.searchsorted(array(_in_order(read(), column), column), edges) for read in tables]
    for k in range(count):
        yield [
            _in_order(read(), column).slice(int(cut[k]), int(cut[k + 1] - cut[k]))
            for read, cut in zip(tables, cuts, strict=True)
        ]


def _in_order(rows: pa.Table, column: str) -> pa.Table:
    time_ns = array(rows, column)
    if (np.diff(time_ns) >= 0).all():
        return rows
    return rows.take(np.argsort(time_ns, kind="stable"))
