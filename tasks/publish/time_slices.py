"""Time slices: a span's rows from many parts, in times short enough to hold."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span

MOST_ROWS = 400_000  # in a slice, about: a few row groups


def slices_of(span: Span, n_rows: int) -> list[Span]:
    """Return a span in slices of about `MOST_ROWS` rows; they depend on the rows only."""
    count = max(-(-n_rows // MOST_ROWS), 1)
    edges = np.linspace(span.start_ns, span.end_ns, count + 1).astype(np.int64).tolist()
    return [Span(start, end) for start, end in zip(edges[:-1], edges[1:], strict=True)]


def rows_between(tables: Sequence[pa.Table], time: Span, column: str) -> list[pa.Table]:
    """Return the rows of each table in a time; the tables are sorted by it."""
    out = []
    for rows in tables:
        lo, hi = np.searchsorted(array(rows, column), [time.start_ns, time.end_ns]).tolist()
        out.append(rows.slice(lo, hi - lo))
    return out
