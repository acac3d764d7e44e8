"""Track a span: one sensor's tracklets over a span of time and a margin, from file to file."""

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

# A tracklet that begins before the span is followed for so long that both spans find the same
# one, and a broken one is joined across the span's end.
MARGIN_S = 90.0


def track_margin_ns(settings: Settings) -> int:
    """Return how far beyond a span its tracklets are followed, and those of its neighbours."""
    return round((MARGIN_S + settings.tracklets.link_gap_s) * 1e9)


@stage_task(Stage.TRACK, "{sensor} {span}")
def track_span(
    sensor: Sensor,
    identified: Parts,
    span: Span,
    cameras: pa.Table,
    settings: Settings,
    parts: Parts,
) -> int:
    """Follow one sensor's detections through a span and its margins, unless that was done.

    Parameters
    ----------
    identified
        The sensor's identified parts.
    parts
        Where the part goes: `detections` and `tracklets`, named within the span.

    Returns
    -------
    int
        How many tracklets there are.
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
