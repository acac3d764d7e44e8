"""What is known of each centroid, as annotations that a viewer draws over the image.

Shapes and colours both differ (Okabe and Ito's colours, for people with any colour vision): a star
is a blue ring, a detection of an object an orange square, another detection a reddish cross.
The origin of annotations is the corner of the first pixel, ours its middle: half a pixel is added.
"""

import struct
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CircleAnnotation_pb2 import CircleAnnotation
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation

BLUE, ORANGE, RED = (0.337, 0.706, 0.914), (0.902, 0.624, 0.0), (0.835, 0.369, 0.0)
BLACK = (0.0, 0.0, 0.0)  # behind words: images of the sky are dark
HALF_PX = 0.5
RING_PX, SQUARE_PX, CROSS_PX = 12.0, 8.0, 4.0  # diameter, half side, half length
TEXT_PX, LINE_PX = 10.0, 1.0


class StarSpot(NamedTuple):
    """A centroid that is a star [px]."""

    x_px: float
    y_px: float
    star_id: int


class DetectedSpot(NamedTuple):
    """A centroid that is not a star [px], and the object that it shows, if any."""

    x_px: float
    y_px: float
    object_id: str | None
    kind: str


def annotations(
    time_ns: int, stars: Sequence[StarSpot], detections: Sequence[DetectedSpot], star_names: str
) -> bytes:
    """Return the annotations of one frame, as a serialised `foxglove.ImageAnnotations`.

    `star_names` is what stands before a star's number, such as "HIP ".
    """
    message: Any = ImageAnnotations()
    ring, word = _ring(time_ns), _word(time_ns, BLUE)
    for star in stars:
        x, y = star.x_px + HALF_PX, star.y_px + HALF_PX
        circle = message.circles.add()
        circle.CopyFrom(ring)
        _set_point(circle.position, x, y)
        corner = x + RING_PX / 2, y - RING_PX / 2
        _text(message, word, corner, f"{star_names}{star.star_id}")
    square, word = _lines(time_ns, PointsAnnotation.LINE_LOOP, ORANGE), _word(time_ns, ORANGE)
    cross, kind = _lines(time_ns, PointsAnnotation.LINE_LIST, RED), _word(time_ns, RED)
    for spot in sorted(detections, key=lambda spot: spot.object_id is None):
        x, y = spot.x_px + HALF_PX, spot.y_px + HALF_PX
        if spot.object_id is not None:
            d = SQUARE_PX
            corners = (x - d, y - d), (x + d, y - d), (x + d, y + d), (x - d, y + d)
            _points(message, square, corners)
            _text(message, word, (x + d, y - d), spot.object_id)
            continue
        d = CROSS_PX
        ends = (x - d, y - d), (x + d, y + d), (x - d, y + d), (x + d, y - d)
        _points(message, cross, ends)
        if spot.kind != "unknown":
            _text(message, kind, (x + d, y - d), spot.kind)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


# What all rings, words and lines of a frame share is made once, and copied: a night has millions.


def _ring(time_ns: int) -> Any:
    ring: Any = CircleAnnotation(diameter=RING_PX, thickness=LINE_PX)
    _time(ring.timestamp, time_ns)
    _colour(ring.outline_color, BLUE)
    return ring


def _lines(time_ns: int, kind: int, colour: tuple[float, ...]) -> Any:
    lines: Any = PointsAnnotation(type=kind, thickness=LINE_PX)  # type: ignore[arg-type]
    _time(lines.timestamp, time_ns)
    _colour(lines.outline_color, colour)
    return lines


def _word(time_ns: int, colour: tuple[float, ...]) -> Any:
    word: Any = TextAnnotation(font_size=TEXT_PX)
    _time(word.timestamp, time_ns)
    _colour(word.text_color, colour)
    _colour(word.background_color, BLACK, 0.5)
    return word


def _points(message: Any, like: Any, points: Sequence[tuple[float, float]]) -> None:
    lines = message.points.add()
    lines.CopyFrom(like)
    for x, y in points:
        lines.points.add(x=x, y=y)


def _text(message: Any, like: Any, corner: tuple[float, float], text: str) -> None:
    label = message.texts.add()
    label.CopyFrom(like)
    label.text = text
    _set_point(label.position, *corner)


def _set_point(point: Any, x: float, y: float) -> None:
    point.x, point.y = x, y


def _colour(colour: Any, rgb: tuple[float, ...], opacity: float = 1.0) -> None:
    colour.r, colour.g, colour.b = rgb
    colour.a = opacity


def _time(stamp: Any, time_ns: int) -> None:
    stamp.seconds, stamp.nanos = divmod(int(time_ns), 1_000_000_000)


def image_of(shape: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Return a grey image (rows, columns) with a spot of 3 x 3 px at each of (n, 2) points."""
    image = np.zeros(shape, np.uint8)
    centre = np.round(points).astype(int)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            x, y = centre[:, 0] + dx, centre[:, 1] + dy
            inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
            grey = 255 if dx == dy == 0 else 120
            image[y[inside], x[inside]] = np.maximum(image[y[inside], x[inside]], grey)
    return image


# Grey images as PNG (ISO/IEC 15948), compressed by the standard library.

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def png(image: npt.NDArray[np.uint8]) -> bytes:
    """Return a grey image (rows, columns) as a PNG file."""
    height, width = image.shape
    lines = np.zeros((height, width + 1), np.uint8)  # each begins with its filter: none
    lines[:, 1:] = image
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"".join(
        [
            _SIGNATURE,
            _chunk(b"IHDR", header),
            _chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)),
            _chunk(b"IEND", b""),
        ]
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
