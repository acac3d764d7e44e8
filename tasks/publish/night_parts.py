"""Publish nights: the parts that their tables are made from, in slices of time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.io.datasets.dataset import publish_folders
from epipole.io.datasets.night_tables import ROWS_IN_GROUP
from epipole.io.work.work_layout import SensorParts, SolvedParts
from epipole.schemas.arrays import Integers
from epipole.schemas.bridge import array
from epipole.schemas.settings import TableSettings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import LINKED_TRACKLETS
from epipole.tasks.common.stage_tasks import stage_task

# Parts.


class NightParts(NamedTuple):
    """The parts and tables from which the tables of a night are made.

    `spans` are the night's, in order; `all_spans` also has one before and after it. `names` has,
    for the folder of each span, the names in the night of its objects. `whole` has tables that
    belong to no span: `calibrations`, `checks`, `sources`, and some of the `rejects`. `linked` are
    LINKED_TRACKLETS. `kept` says which rows are published.
    """

    night: str
    spans: list[Span]
    all_spans: list[Span]
    sensors: list[SensorParts]
    solved: SolvedParts
    names: Mapping[str, Mapping[str, str]]
    whole: Mapping[str, pa.Table]
    linked: pa.Table = LINKED_TRACKLETS.empty_table()
    kept: TableSettings = TableSettings()


# Publication: the staged tables become the dataset's, all at once.


@stage_task(Stage.PUBLISH, "all nights", retried=True)
def publish_nights(
    dataset: str, staged: Mapping[str, Path], sources: pa.Table, replace: bool
) -> None:
    """Publish the staged nights in the dataset; see `publish_folders`."""
    publish_folders(dataset, staged, sources, replace)


# Slices of time: rows of a span from many parts, merged in slices that fit in memory.

MAX_ROWS = ROWS_IN_GROUP  # in a slice, about
MAX_SAMPLED = 1_000_000  # times of rows by which a span is divided
ROWS_OF_TABLE = 200  # with many tables a slice has more rows: each table is opened for each slice


def in_slices(
    tables: Sequence[Callable[[], pa.Table]], span: Span, column: str
) -> Iterator[list[pa.Table]]:
    """Yield the rows of each table in one time after the other; together they are the span.

    Parameters
    ----------
    tables
        What reads each table: it is read again for each slice, so that a span is never
        in memory as a whole. In any order of time; rows outside the span are left out.
    column
        The time of the rows.

    Notes
    -----
    The slices depend on the times of the rows and the number of tables only. They have about as
    many rows each, wherever in the span these lie; rows of one time are never divided.
    """
    step = max(sum(read().num_rows for read in tables) // MAX_SAMPLED, 1)
    sampled = [array(read(), column)[::step].copy() for read in tables]
    edges = _edges(sampled, span, max(MAX_ROWS, ROWS_OF_TABLE * len(tables)) // step)
    orders, cuts = [], []
    for read in tables:
        times = array(read(), column)
        order = None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")
        orders.append(order)
        cuts.append(np.searchsorted(times if order is None else times[order], edges))
    for k in range(len(edges) - 1):
        yield [
            _rows(read, order, int(cut[k]), int(cut[k + 1]))
            for read, order, cut in zip(tables, orders, cuts, strict=True)
        ]


def _edges(times: Sequence[Integers], span: Span, limit: int) -> Integers:
    """Return the times that bound slices of a span, with at most about `limit` rows each."""
    together = np.concatenate([np.zeros(0, np.int64), *times])
    inside = together[(together >= span.start_ns) & (together < span.end_ns)]
    count = -(-len(inside) // limit)
    middle = np.arange(1, count) * len(inside) // max(count, 1)
    between = np.unique(np.partition(inside, middle)[middle]) if count > 1 else middle
    return np.array([span.start_ns, *between[between > span.start_ns], span.end_ns], np.int64)


def _rows(read: Callable[[], pa.Table], order: Integers | None, first: int, last: int) -> pa.Table:
    """Return a copy of some rows: of a file that is mapped into memory, only these are kept."""
    rows = np.arange(first, last) if order is None else order[first:last]
    return read().take(rows)
