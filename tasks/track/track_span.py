"""Track a span: one sensor's tracklets over a span and its margins, from part to part."""

import pyarrow as pa

from epipole.io.work.part_tables import TRACKED
from epipole.io.work.parts import Parts, write_part
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.track.build_tracklets import build_tracklets

# Tracklets are followed this long before and after a span, so that neighbouring spans find the same
# ones; and this long in addition, so that broken tracks are joined across the border.
MARGIN_S = 90.0
LINK_MARGIN_S = 90.0


def track_margin_ns(settings: Settings) -> int:
    """Return how far before and after a span its detections are followed."""
    return round((MARGIN_S + (settings.tracklets.link_gap_s or LINK_MARGIN_S)) * 1e9)


@stage_task(Stage.TRACK, "{sensor} {span}")
def track_span(
    sensor: Sensor,
    identified: Parts,
    span: Span,
    cameras: pa.Table,
    settings: Settings,
    parts: Parts,
) -> int:
    """Follow one sensor's detections through a span and its margins, unless the part exists.

    Parameters
    ----------
    identified
        The sensor's parts of `identify_span`.
    parts
        Where the part goes: `TRACKED`, with the tracklets' names in the span.

    Returns
    -------
    int
        Number of tracklets.
    """
    if not parts.holds(span):
        wide = span.widened(track_margin_ns(settings))
        tracked = build_tracklets(
            identified.rows_within(wide, SOLUTIONS, "solutions"),
            identified.rows_within(wide, DETECTIONS, "detections"),
            cameras,
            settings,
        )
        write_part(parts.of(span), TRACKED, tracked._asdict())
    return parts.read(span, "tracklets").num_rows
