"""The messages of a span of a night: of each frame, of each epoch, and of what was left out."""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import polars as pl
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log

from epipole.schemas.bridge import to_polars
from epipole.schemas.columns import POSITION
from epipole.schemas.rejects import sentence_of
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.overlay.annotations import (
    DetectedSpot,
    StarSpot,
    annotations,
    image_of,
    png,
)
from epipole.tasks.overlay.scene import objects, points, transform

ANNOTATIONS, CALIBRATION, IMAGE = (
    "foxglove.ImageAnnotations", "foxglove.CameraCalibration", "foxglove.CompressedImage",
)  # fmt: skip
TRANSFORM, SCENE, LOG = "foxglove.FrameTransform", "foxglove.SceneUpdate", "foxglove.Log"
CLOUD, POINTS = "foxglove.PointCloud", "/epipole/points"
OBJECTS, TRANSFORMS, LEFT_OUT = "/epipole/objects", "/epipole/transforms", "/epipole/rejects"

StarOrDetected = TypeVar("StarOrDetected", StarSpot, DetectedSpot)


class ViewerMessage(NamedTuple):
    """A message to be written; messages are sorted by time, then by topic."""

    time_ns: int
    topic: str
    schema: str
    data: bytes


class SpanTables(NamedTuple):
    """Rows of a span: FRAMES, STARS, DETECTIONS with `object_id`, used ASSOCIATIONS, POSITIONS."""

    frames: pl.DataFrame
    stars: pl.DataFrame
    detections: pl.DataFrame
    associations: pl.DataFrame
    positions: pl.DataFrame


class ImageShapes(NamedTuple):
    """The sizes (rows, columns) of a sensor's images, each from a time on, in order of time."""

    since_ns: list[int]
    sizes: list[tuple[int, int]]

    def at(self, time_ns: int) -> tuple[int, int]:
        """Return the size at a time; the first one also counts before its time."""
        return self.sizes[max(bisect_right(self.since_ns, time_ns) - 1, 0)]


def frame_messages(
    tables: SpanTables, star_names: str, shapes: Mapping[str, ImageShapes]
) -> Iterator[ViewerMessage]:
    """Yield annotations and transforms of all frames.

    `shapes` are of the sensors whose images are drawn; others get none.
    """
    stars = _of_frames(tables.stars, StarSpot)
    detections = _of_frames(tables.detections, DetectedSpot)
    for row in _timed(tables.frames, "time").iter_rows(named=True):
        sensor, number, time_ns = row["sensor_id"], row["frame_number"], row["time_ns"]
        marks = stars.get((sensor, number), []), detections.get((sensor, number), [])
        data = annotations(time_ns, *marks, star_names)
        yield ViewerMessage(time_ns, f"/{sensor}/annotations", ANNOTATIONS, data)
        if sensor in shapes:
            shape = shapes[sensor].at(time_ns)
            data = _image(time_ns, sensor, shape, [*marks[0], *marks[1]])
            yield ViewerMessage(time_ns, f"/{sensor}/image", IMAGE, data)
        if row["qw"] is not None and row["x_km"] is not None:
            yield ViewerMessage(time_ns, TRANSFORMS, TRANSFORM, transform(time_ns, sensor, row))


def _of_frames(
    rows: pl.DataFrame, spot: Callable[..., StarOrDetected]
) -> dict[tuple[str, int], list[StarOrDetected]]:
    """Return the spots of each frame, by sensor and frame number."""
    key, fields = ["sensor_id", "frame_number"], spot._fields  # type: ignore[attr-defined]
    found = rows.group_by(key, maintain_order=True).agg(*fields)
    return {
        (sensor, number): [spot(*each) for each in zip(*columns, strict=True)]
        for sensor, number, *columns in found.select(*key, *fields).iter_rows()
    }


def _image(
    time_ns: int, sensor: str, shape: tuple[int, int], spots: Sequence[StarSpot | DetectedSpot]
) -> bytes:
    message: Any = CompressedImage(frame_id=sensor, format="png")
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    points = np.array([spot[:2] for spot in spots], float).reshape(-1, 2)
    message.data = png(image_of(shape, points))
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def epoch_messages(tables: SpanTables, lifetime_ns: int) -> Iterator[ViewerMessage]:
    """Yield the objects of each epoch, with the lines of sight to them; and as points."""
    sensors = tables.frames.select("sensor_id", "frame_number", *POSITION)
    lines = tables.associations.join(sensors, on=["sensor_id", "frame_number"], how="inner")
    lines = (
        lines.drop_nulls(POSITION).group_by("epoch", "object_id", maintain_order=True).agg(POSITION)
    )
    seen_from: dict[Any, dict[str, list[tuple[float, ...]]]] = defaultdict(dict)
    for epoch, name, *km in lines.select("epoch", "object_id", *POSITION).iter_rows():
        seen_from[epoch][name] = list(zip(*km, strict=True))
    for (epoch,), positions in (
        _timed(tables.positions, "epoch")
        .partition_by("epoch", as_dict=True, maintain_order=True)
        .items()
    ):
        time_ns = positions["time_ns"][0]
        data = objects(time_ns, positions, seen_from.get(epoch, {}), lifetime_ns)
        yield ViewerMessage(time_ns, OBJECTS, SCENE, data)
        yield ViewerMessage(time_ns, POINTS, CLOUD, points(time_ns, positions))


def log_messages(rejects: pl.DataFrame, first_ns: int = 0) -> Iterator[ViewerMessage]:
    """Yield a line of log for each row of REJECTS, at its time or `first_ns`, the later one."""
    for row in _timed(rejects, "time").iter_rows(named=True):
        about = " ".join(filter(None, (row["source"], row["sensor_id"], row["tracklet_id"])))
        what = f"{sentence_of(row['reason'])} ({row['count']:,})"
        text = f"{about}: {what}" if about else what
        yield log_message(max(row["time_ns"], first_ns), Log.Level.WARNING, row["stage"], text)


def log_message(time_ns: int, level: int, name: str, text: str) -> ViewerMessage:
    """Return a line of log."""
    message: Any = Log(level=level, name=name, message=text)  # type: ignore[arg-type]
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 1_000_000_000)
    return ViewerMessage(time_ns, LEFT_OUT, LOG, message.SerializeToString(deterministic=True))


def with_objects(detections: pl.DataFrame, associations: pl.DataFrame) -> pl.DataFrame:
    """Return DETECTIONS with the object that their tracklet shows, if it shows one."""
    shown = associations.select("tracklet_id", "object_id").unique().sort("tracklet_id")
    shown = shown.unique("tracklet_id", keep="first", maintain_order=True)
    return detections.join(shown, on="tracklet_id", how="left", maintain_order="left")


def camera_shapes(cameras: Any) -> dict[str, ImageShapes]:
    """Return the sizes of each sensor's images, of CAMERAS."""
    assert cameras.schema.equals(CAMERAS)
    found: dict[str, ImageShapes] = {}
    rows = _timed(to_polars(cameras), "time").select("sensor_id", "time_ns", "height", "width")
    for sensor, time_ns, *size in rows.iter_rows():
        shapes = found.setdefault(sensor, ImageShapes([], []))
        shapes.since_ns.append(time_ns)
        shapes.sizes.append((size[0], size[1]))
    return found


def _timed(rows: pl.DataFrame, column: str) -> pl.DataFrame:
    """Return the rows by time, with it as nanoseconds."""
    return rows.sort(column, maintain_order=True).with_columns(
        time_ns=pl.col(column).dt.timestamp("ns")
    )
