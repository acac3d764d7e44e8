"""Track a span: one sensor's tracklets over a span of time and a margin, from file to file."""

from pathlib import Path

import pyarrow as pa
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.work.files import is_written, read_part, write_part
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.common.spans import Sensor, Span, rows_within
from epipole.tasks.track.build_tracklets import build_tracklets

# A tracklet that begins before the span is seen for so long that it is the same one, and a
# broken one is joined across the span's end.
MARGIN_S = 90.0


def track_margin_ns(settings: Settings) -> int:
    """Return how far beyond a span its tracklets are followed, and those of its neighbours."""
    return round((MARGIN_S + settings.tracklets.link_gap_s) * 1e9)


@task(name="track", task_run_name="track {sensor} {span}", cache_policy=NO_CACHE)
def track_span(
    sensor: Sensor, identified: Path, span: Span, cameras: pa.Table, settings: Settings, stage: Path
) -> int:
    """Follow one sensor's detections through a span and its margins, unless that was done.

    Parameters
    ----------
    identified
        The sensor's identified parts.
    stage
        Where the part goes: `detections` and `tracklets`, named within the span.

    Returns
    -------
    int
        How many tracklets there are.
    """
    part = stage / span.folder
    if not is_written(part):
        wide = span.widened(track_margin_ns(settings))
        tracked = build_tracklets(
            rows_within(identified, wide, SOLUTIONS, "solutions"),
            rows_within(identified, wide, DETECTIONS, "detections"),
            cameras,
            settings,
        )
        write_part(part, tracked._asdict())
    return read_part(part, "tracklets").num_rows
