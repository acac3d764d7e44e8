"""What one sensor's detections are called in the night, read from its spans."""

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.files import is_written, read_part
from epipole.schemas.bridge import concat
from epipole.schemas.tables import DETECTIONS
from epipole.tasks.common.spans import Span, spans_between


def detections_within(tracked: Path, named: Path, span: Span) -> pa.Table:
    """Return a sensor's detections in a span, each as the span it lies in has it.

    Parameters
    ----------
    tracked, named
        The sensor's parts by `track_span` and by `join_tracklets`.
    """
    parts = [one for one in spans_between(*span) if is_written(tracked / one.folder)]
    rows = []
    for one in parts:
        seen = one.of(read_part(tracked / one.folder, "detections"), "time")
        rows.append(_named(span.of(seen, "time"), read_part(named / one.folder, "names")))
    return concat(DETECTIONS, rows)


def _named(detections: pa.Table, names: pa.Table) -> pa.Table:
    row = pc.index_in(detections["tracklet_id"], names["span_name"])
    row = pc.if_else(detections["tracklet_id"].is_valid(), row, pa.scalar(None, pa.int32()))
    lost = pc.and_(row.is_null(), detections["tracklet_id"].is_valid())
    for name in ("tracklet_id", "track_id"):
        at = detections.schema.get_field_index(name)
        detections = detections.set_column(at, detections.schema.field(at), names[name].take(row))
    if not pc.any(lost).as_py():
        return detections
    raise AssertionError("a detection's tracklet has no name")
