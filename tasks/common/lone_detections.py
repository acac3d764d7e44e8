"""Lone detections: those in frames that are too few, or too far apart, for a tracklet.

They take part in the association as tracklets of one detection. Their ids are not published:
`tracklet_id` is null for them in a dataset.
"""

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import array, concat, table
from epipole.schemas.settings import TrackletSettings
from epipole.schemas.work_tables import TRACKLET_RUNS
from epipole.tasks.algorithms.time.epoch_grid import frame_interval_ns

MARK = "lone:"  # sensor ids have no colon, so no other id begins like this


def in_lone_frames(
    frame_time_ns: npt.NDArray[np.int64], settings: TrackletSettings
) -> npt.NDArray[np.bool_]:
    """Return which frames of one sensor, in time order, have too few others near for a tracklet."""
    if not len(frame_time_ns):
        return np.zeros(0, bool)
    coast_ns = (settings.max_missed + 1.5) * frame_interval_ns(frame_time_ns)
    run = np.concatenate([[0], np.cumsum(np.diff(frame_time_ns) > coast_ns)]).astype(np.int64)
    return np.asarray(np.bincount(run)[run] < settings.min_detections)


def with_lone_detections(detections: pa.Table, lone: npt.NDArray[np.bool_]) -> pa.Table:
    """Return the detections; each lone one gets an unpublished tracklet_id."""
    names = array(detections, "tracklet_id").copy()
    rows = np.flatnonzero(lone)
    sensor, frame = array(detections, "sensor_id"), array(detections, "frame_number")
    centroid = array(detections, "centroid")
    for row in rows:
        names[row] = f"{MARK}{sensor[row]}-{frame[row]}-{centroid[row]}"
    at = detections.schema.get_field_index("tracklet_id")
    return detections.set_column(at, detections.schema.field(at), pa.array(names, pa.string()))


def with_lone_tracklets(tracklets: pa.Table, views: pa.Table) -> pa.Table:
    """Return the tracklets that have views, and a row for each lone detection that has views."""
    tracklets = tracklets.filter(pc.is_in(tracklets["tracklet_id"], views["tracklet_id"]))
    lone = views.filter(is_lone(views["tracklet_id"]))
    if not lone.num_rows:
        return tracklets
    names, first = np.unique(array(lone, "tracklet_id").astype(str), return_index=True)
    lone = lone.take(first)
    n = lone.num_rows
    rows = table(
        TRACKLET_RUNS,
        {
            "tracklet_id": names,
            "track_id": names,
            "sensor_id": lone["sensor_id"],
            "start_time": lone["epoch"],
            "end_time": lone["epoch"],
            "n_detections": np.ones(n, np.int32),
            "rate_arcsec_s": np.zeros(n),
            "residual_px": np.zeros(n),
            "link_chi2": pa.nulls(n, pa.float64()),
        },
    )
    return concat(TRACKLET_RUNS, [tracklets, rows])


def with_lone_objects(detections: pa.Table, associations: pa.Table) -> pa.Table:
    """Return the detections; lone ones that a position used are of kind ``object``.

    One detection alone may be anything. A detection that several sensors agree on is an object.
    """
    is_lone_view = pc.and_(associations["used"], pc.is_null(associations["tracklet_id"]))
    key = ["sensor_id", "frame_number", "centroid"]
    lone = pl.DataFrame(associations.filter(is_lone_view).select(key)).drop_nulls().unique()
    if not len(lone):
        return detections
    marked = pl.DataFrame(detections.select(key)).join(
        lone.with_columns(is_object=True), on=key, how="left", maintain_order="left"
    )  # fmt: skip
    at = detections.schema.get_field_index("kind")
    kind = pc.if_else(marked["is_object"].fill_null(False).to_arrow(), "object", detections["kind"])
    return detections.set_column(at, detections.schema.field(at), kind)


def is_lone(tracklet_id: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return which ids are of lone detections."""
    return pc.starts_with(tracklet_id, MARK)


def published_ids(tracklet_id: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the ids; null for those of lone detections."""
    return pc.if_else(is_lone(tracklet_id), pa.scalar(None, pa.string()), tracklet_id)


def only_id(tracklet_id: npt.NDArray[np.object_]) -> str | None:
    """Return the one id in an array; None where there are several, or it is of a lone detection."""
    ids = set(tracklet_id.tolist())
    if len(ids) != 1:
        return None
    (name,) = ids
    return None if name.startswith(MARK) else str(name)
