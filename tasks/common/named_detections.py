"""One sensor's detections, with the names of their tracklets in the night."""

import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.places import SensorParts
from epipole.schemas.bridge import concat
from epipole.schemas.spans import Span, spans_between
from epipole.schemas.tables import DETECTIONS


def detections_within(sensor: SensorParts, span: Span) -> pa.Table:
    """Return a sensor's detections in a time, each from the part of the span it lies in."""
    rows = []
    for other in spans_between(*span):
        if not sensor.tracked.holds(other):
            continue
        detections = other.of(sensor.tracked.read(other, "detections"), "time")
        names = sensor.names.read(other, "names")
        rows.append(with_names(span.of(detections, "time"), names))
    return concat(DETECTIONS, rows)


def with_names(detections: pa.Table, names: pa.Table) -> pa.Table:
    """Return detections of a span with the names of their tracklets in the night.

    `names` are the sensor's TRACKLET_NAMES of the span.
    """
    row = pc.index_in(detections["tracklet_id"], names["span_name"])
    row = pc.if_else(detections["tracklet_id"].is_valid(), row, pa.scalar(None, pa.int32()))
    if pc.any(pc.and_(row.is_null(), detections["tracklet_id"].is_valid())).as_py():
        raise AssertionError("a detection's tracklet has no name")
    for name in ("tracklet_id", "track_id"):
        at = detections.schema.get_field_index(name)
        detections = detections.set_column(at, detections.schema.field(at), names[name].take(row))
    return detections
