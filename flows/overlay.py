"""A night drawn over its logs, for viewers of MCAP files: stars, tracks, objects, what is left out.

It is written half an hour at a time, so that a night of any size fits into memory.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
from foxglove_schemas_protobuf.Log_pb2 import Log

from epipole.flows.night.log_choice import find_logs
from epipole.io.datasets.dataset import night_row, nights_in, read_table
from epipole.io.datasets.rows_by_night import nights_of
from epipole.io.logs.listing import list_logs
from epipole.io.logs.reader import read_log_pieces
from epipole.io.logs.writer import ViewerFile
from epipole.io.paths import is_one_of
from epipole.schemas.bridge import array, to_polars
from epipole.schemas.errors import DatasetError, LogError, NoFramesError
from epipole.schemas.options import star_ids_of
from epipole.schemas.settings import Assumption
from epipole.schemas.spans import DAY_NS, SPAN_NS, Span, day_of, spans_between
from epipole.tasks.overlay.layout import viewer_layout
from epipole.tasks.overlay.messages import (
    OBJECTS,
    SCENE,
    SpanTables,
    ViewerMessage,
    camera_shapes,
    epoch_messages,
    frame_messages,
    log_message,
    log_messages,
    with_objects,
)
from epipole.tasks.overlay.scene import earth
from epipole.tasks.read.assume_readings import as_assumed

LIFETIME_EPOCHS = 3  # an object is shown as long, if no later epoch has it


@dataclass(frozen=True)
class Overlay:
    """What was written."""

    out: str
    layout: str
    nights: list[str]
    frames: int
    epochs: int
    log_lines: int
    without_rows: int  # frames of the logs that the dataset does not have


class _Logs:
    """What the logs have: calibrations, sensors, and the times of the frames of each.

    Read as their run assumed them: the times of its tables are those that it read.
    """

    def __init__(self, paths: Sequence[str], assume: Sequence[Assumption]) -> None:
        cameras, exposures = [], []
        for path in paths:
            for written in read_log_pieces(path):
                piece = as_assumed(written, assume)
                cameras.append(piece.cameras)
                exposures.append(piece.exposures.select(["sensor_id", "time"]))
        self.cameras: pa.Table = pa.concat_tables(cameras)
        frames = pl.concat([to_polars(rows) for rows in exposures])
        self.frames = frames.unique().sort("time", "sensor_id")
        if not len(self.frames):
            raise LogError(f"{', '.join(paths)}: no frames in these logs; give others")
        self.sensors: list[str] = sorted(set(self.frames["sensor_id"]))
        self.nights = nights_of(self.frames["time"].dt.timestamp("ns").to_numpy())


def overlay(
    dataset: str,
    logs: Sequence[str],
    out: Path,
    night: str | None = None,
    images: bool = False,
    assume: Sequence[Assumption] = (),
) -> Overlay:
    """Write what the dataset says of the frames of the logs, and a layout of panels beside it.

    Parameters
    ----------
    night
        Only this UTC date; None: all nights of the logs that the dataset has.
    images
        Also write an image for each frame, drawn from its centroids.
    assume
        `sensors.assume` of the run that made the dataset.

    Raises
    ------
    EpipoleError
        Where the dataset has no night of the logs, or the file is one of them or cannot be written.
    """
    paths = find_logs(logs, None).paths
    listed = [path for where in logs for path in list_logs(where)[0]]
    if is_one_of(out, listed):
        raise LogError(f"{out}: is one of the logs, and would be lost; give another file to write")
    given = _Logs(paths, assume)
    nights = [date for date in nights_in(dataset) if date in given.nights and night in (None, date)]
    if not nights:
        asked = night or ", ".join(given.nights)
        raise NoFramesError(
            f"{dataset}: has no night of these logs ({asked}); run them first, or give --assume "
            "as their run did"
        )
    counts = {"frames": 0, "epochs": 0, "log_lines": 0}
    try:
        with ViewerFile(out) as file:
            for date in nights:
                _calibrations(file, given, date)
                for message in _of_night(dataset, date, given, images, counts):
                    file.message(message.topic, message.schema, message.time_ns, message.data)
        layout = out.with_suffix(".layout.json")
        panels = viewer_layout(given.sensors)
        layout.write_text(json.dumps(panels, indent=1) + "\n")
    except OSError as error:
        raise DatasetError(f"{out}: cannot be written: {error.strerror}; give another") from error
    asked_frames = given.frames.filter(pl.col("time").dt.date().cast(pl.String).is_in(nights))
    return Overlay(
        str(out),
        str(layout),
        nights,
        **counts,
        without_rows=max(len(asked_frames) - counts["frames"], 0),
    )


def _calibrations(file: ViewerFile, given: _Logs, night: str) -> None:
    """Write the calibrations of a night: the last one before it, and those in it.

    The first of a sensor holds from its first frame.
    """
    start_ns = day_of(night) * DAY_NS
    end_ns = start_ns + DAY_NS
    first_ns = dict(
        given.frames.group_by("sensor_id")
        .agg(pl.col("time").min().dt.timestamp("ns"))
        .sort("sensor_id")
        .iter_rows()
    )
    rows = to_polars(given.cameras).sort("sensor_id", "time").unique(maintain_order=True)
    for (sensor,), cameras in rows.partition_by(
        "sensor_id", as_dict=True, maintain_order=True
    ).items():
        times_ns = cameras["time"].dt.timestamp("ns").to_list()
        times_ns[0] = min([first_ns.get(sensor, times_ns[0]), *times_ns[1:2]])
        ends_ns = [*times_ns[1:], end_ns]
        named = cameras.iter_rows(named=True)
        for since_ns, until_ns, row in zip(times_ns, ends_ns, named, strict=True):
            if since_ns < end_ns and until_ns > start_ns:
                file.calibration(str(sensor), max(since_ns, start_ns), row)


def _of_night(
    dataset: str, night: str, given: _Logs, images: bool, counts: dict[str, int]
) -> Iterator[ViewerMessage]:
    times_ns = given.frames["time"].dt.timestamp("ns").to_numpy()
    row = night_row(dataset, night)
    ids = star_ids_of(row)
    shapes = camera_shapes(given.cameras) if images else {}
    positions = array(read_table(dataset, "positions", night, ["epoch"]), "epoch")
    apart_ns = np.diff(np.unique(positions))
    lifetime_ns = LIFETIME_EPOCHS * int(np.median(apart_ns)) if len(apart_ns) else SPAN_NS
    day = day_of(night)
    spans = [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in np.unique(times_ns // SPAN_NS).tolist()]
    of_night = [span for span in spans if span.start_ns // DAY_NS == day]
    start_ns = int(times_ns[times_ns // DAY_NS == day].min())
    yield ViewerMessage(start_ns, OBJECTS, SCENE, earth(start_ns))
    for fault in row["faults"] if row is not None else ():
        yield log_message(start_ns, Log.Level.ERROR, "check", fault)
    yield from _left_out(dataset, night, Span(day * DAY_NS, day * DAY_NS + 1), start_ns, counts)
    for span in spans_between(of_night[0].start_ns, of_night[-1].end_ns):
        timed = Span(max(span.start_ns, day * DAY_NS + 1), span.end_ns)
        messages = _left_out(dataset, night, timed, start_ns, counts)
        if span in of_night:
            tables = _tables(dataset, night, span, given.sensors)
            messages += frame_messages(tables, f"{ids} " if ids else "", shapes)
            messages += epoch_messages(tables, lifetime_ns)
            counts["frames"] += len(tables.frames)
            counts["epochs"] += tables.positions["epoch"].n_unique()
        yield from sorted(messages)


def _left_out(
    dataset: str, night: str, during: Span, first_ns: int, counts: dict[str, int]
) -> list[ViewerMessage]:
    """Return the lines of log of a time, those before the first frame at its time: what has no time
    stands at the start of the night."""
    rejects = to_polars(read_table(dataset, "rejects", night, during=during))
    lines = list(log_messages(rejects, first_ns))
    counts["log_lines"] += len(lines)
    return lines


def _tables(dataset: str, night: str, span: Span, sensors: Sequence[str]) -> SpanTables:
    def read(table: str) -> pl.DataFrame:
        return to_polars(read_table(dataset, table, night, during=span))

    seen = pl.col("sensor_id").is_in(sensors)
    associations = read("associations")
    return SpanTables(
        read("frames").filter(seen),
        read("stars").filter(seen),
        with_objects(read("detections").filter(seen), associations),
        associations.filter(pl.col("used") & seen),
        read("positions"),
    )
