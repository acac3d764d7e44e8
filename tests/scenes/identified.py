"""Stars identified, and tracklets built, as the flow does it with the settings of a run."""

import pyarrow as pa

from epipole.schemas.settings import Settings
from epipole.tasks.identify.identify_stars import IdentifiedTables, identify_stars
from epipole.tasks.track.track_span import Tracked, build_tracklets


def identified(
    exposures: pa.Table,
    frame_states: pa.Table,
    cameras: pa.Table,
    catalogue: pa.Table,
    settings: Settings,
) -> IdentifiedTables:
    """Return the stars of one sensor's frames."""
    return identify_stars(
        exposures, frame_states, cameras, catalogue, settings.sensors, settings.identification,
        settings.tracklets.max_detections,
    )  # fmt: skip


def tracked(
    solutions: pa.Table,
    detections: pa.Table,
    cameras: pa.Table,
    settings: Settings,
    stars: pa.Table | None = None,
) -> Tracked:
    """Return the tracklets of one sensor's detections."""
    half_width_s = settings.alignment.window_s
    return build_tracklets(solutions, detections, cameras, settings.tracklets, half_width_s, stars)
