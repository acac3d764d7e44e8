"""What a night is made of: which sensors saw it and when, and where the parts of it lie."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import concat, table
from epipole.schemas.errors import LogError
from epipole.schemas.tables import REJECTS
from epipole.tasks.common.spans import SPAN_NS, Sensor, Span
from epipole.tasks.read.order_frames import OrderedFrames

DAY_NS = 86_400_000_000_000

Spans = dict[Sensor, list[Span]]


class Work(NamedTuple):
    """A night at work."""

    frames: Path  # as `order_logs` left them
    folder: Path
    spans: Spans  # in which a sensor has frames
    cameras: pa.Table
    identified: dict[Sensor, Path]  # whose parts are the last word on a sensor's attitudes

    def parts(self, stage: str, sensor: Sensor) -> Path:
        """Return where a stage's parts of a sensor go."""
        return self.folder / stage / str(sensor.number)

    def all_spans(self) -> list[Span]:
        """Return the spans in which any sensor has frames, in order."""
        return sorted({span for spans in self.spans.values() for span in spans})

    def by_span(self) -> list[tuple[Sensor, Span]]:
        """Return each sensor's spans, by time: neighbours are then worked on together."""
        pairs = [(sensor, span) for sensor, spans in self.spans.items() for span in spans]
        return sorted(pairs, key=lambda pair: (pair[1], pair[0]))


def frames_wanted(frames: OrderedFrames, nights: Sequence[str]) -> tuple[Spans, pa.Table]:
    """Return the spans with frames of these nights and just beyond them, by sensor.

    Also a reject a sensor without calibration: it takes no part.

    Raises
    ------
    LogError
        Where no sensor has a calibration.
    """
    known = set(pc.unique(frames.cameras["sensor_id"]).to_pylist())
    days = {int(np.datetime64(night, "D").astype(np.int64)) for night in nights}
    spans: Spans = {}
    rejects = []
    for number, sensor_id in enumerate(frames.sensors):
        span = np.unique(frames.time_ns[number] // SPAN_NS)
        # A span of margin at both ends: no track is cut at midnight.
        day = (span[:, None] + [-1, 0, 1]) * SPAN_NS // DAY_NS
        wanted = span[np.isin(day, list(days)).any(axis=1)]
        if not len(wanted):
            continue
        if sensor_id in known:
            spans[Sensor(number, sensor_id)] = [
                Span(int(k) * SPAN_NS, int(k + 1) * SPAN_NS) for k in wanted
            ]
        else:
            rejects.append(_without_calibration(sensor_id, frames.time_ns[number]))
    if not spans:
        raise LogError(
            f"{', '.join(log.name for log in frames.sources)}: no sensor has a calibration "
            f"({', '.join(frames.sensors)}); record foxglove.CameraCalibration "
            "with the sensor's id as frame_id"
        )
    return spans, concat(REJECTS, rejects)


def _without_calibration(sensor_id: str, time_ns: np.ndarray) -> pa.Table:
    row: dict[str, Any] = {
        "source": None,
        "offset": None,
        "sensor_id": sensor_id,
        "time": int(time_ns[0]),
        "stage": "identify_stars",
        "reason": "no_calibration",
        "count": len(time_ns),
    }
    return table(REJECTS, {name: [value] for name, value in row.items()})
