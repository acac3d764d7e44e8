"""Gather views: all views of some objects, from the parts of all sensors."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from epipole.io.work.places import ViewedParts
from epipole.schemas.bridge import array, concat, to_polars
from epipole.schemas.spans import DAY_NS, Span, spans_between
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.common.equal_runs import group_offsets

Indices = npt.NDArray[np.int64]


def gather_views(
    viewed: ViewedParts, members: pa.Table, time: Span, every_ns: int = 1
) -> tuple[pa.Table, Indices]:
    """Return the VIEWS of objects in a time, and the number of the object of each.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    members
        OBJECT_MEMBERS of the objects.
    every_ns
        Only epochs that are multiples of this time since midnight.

    Notes
    -----
    Two fragments of a track in one sensor may both have a view of an object at an epoch. Only one
    counts: the one with a centroid in the frame, or else the first. Views at epochs at which no
    second sensor has one are left out.
    """
    tables, numbers, sensors = [], [], []
    for sensor, own in to_polars(members).group_by("sensor", maintain_order=True):
        for span in spans_between(*time):
            if not viewed[int(sensor[0])].holds(span):
                continue
            parts = viewed[int(sensor[0])]
            views = parts.read(span, "views")
            rows, number = _rows(views, parts.read(span, "tracklets"), own, time)
            kept = array(views, "epoch")[rows] % DAY_NS % every_ns == 0
            rows, number = rows[kept], number[kept]
            tables.append(views.take(rows))
            numbers.append(number)
            sensors.append(np.full(len(number), sensor[0]))
    views = concat(VIEWS, tables)
    number, sensor_number = (
        np.concatenate([*parts, np.zeros(0, np.int64)]) for parts in (numbers, sensors)
    )
    kept = _seen_by_two(views, number, sensor_number)
    return views.take(kept), number[kept]


def _rows(
    views: pa.Table, tracklets: pa.Table, members: pl.DataFrame, time: Span
) -> tuple[Indices, Indices]:
    """Return the rows of one sensor's views that are of objects, and the objects."""
    epoch_ns = array(views, "epoch")
    first = dict(zip(tracklets["tracklet_id"].to_pylist(), array(tracklets, "first_view").tolist(),
                     strict=True))  # fmt: skip
    n_views = array(tracklets, "n_views")
    count = dict(zip(first, n_views.tolist(), strict=True))
    rows, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for name, number, start_ns, end_ns in _asked(members, time):
        if name not in first:
            continue
        begin, end = first[name], first[name] + count[name]
        lo = begin + int(np.searchsorted(epoch_ns[begin:end], start_ns))
        hi = max(begin + int(np.searchsorted(epoch_ns[begin:end], end_ns, side="right")), lo)
        rows.append(np.arange(lo, hi))
        numbers.append(np.full(hi - lo, number))
    return np.concatenate(rows), np.concatenate(numbers)


def _asked(members: pl.DataFrame, time: Span) -> Iterator[tuple[str, int, int, int]]:
    """Yield tracklet, object, first and last epoch of each member within a time."""
    columns = members.select(
        "tracklet_id",
        "object",
        pl.col("first_epoch").cast(pl.Int64).clip(lower_bound=time.start_ns),
        pl.col("last_epoch").cast(pl.Int64).clip(upper_bound=time.end_ns - 1),
    )
    yield from columns.iter_rows()


def _seen_by_two(views: pa.Table, number: Indices, sensor: Indices) -> Indices:
    """Return the rows of views, one per sensor, of objects that two sensors see at the epoch; in
    the order of epochs, objects and sensors."""
    missed = ~views["centroid"].is_valid().to_numpy()
    epoch_ns = array(views, "epoch")
    order = np.lexsort((missed, sensor, number, epoch_ns))
    order = order[group_offsets(epoch_ns[order], number[order], sensor[order])[:-1]]
    count = np.diff(group_offsets(epoch_ns[order], number[order]))
    return order[np.repeat(count, count) >= 2]
