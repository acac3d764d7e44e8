"""What is known of each centroid, as annotations that a viewer draws over the image.

Shapes and colours both differ (Okabe and Ito's colours, which colour-blind people tell apart): a
star is a blue ring, a detection of an object an orange square, another detection a reddish cross.
The origin of annotations is the corner of the first pixel, ours its middle: half a pixel is added.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import polars as pl
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation

BLUE, ORANGE, RED = (0.337, 0.706, 0.914), (0.902, 0.624, 0.0), (0.835, 0.369, 0.0)
BLACK = (0.0, 0.0, 0.0)  # behind words: images of the sky are dark
HALF_PX = 0.5
RING_PX, SQUARE_PX, CROSS_PX = 12.0, 8.0, 4.0  # diameter, half side, half length
TEXT_PX, LINE_PX = 10.0, 1.0


def annotations(
    time_ns: int, stars: pl.DataFrame, detections: pl.DataFrame, star_names: str
) -> bytes:
    """Return the annotations of one frame, as a serialised `foxglove.ImageAnnotations`.

    Parameters
    ----------
    stars, detections
        STARS of the frame; DETECTIONS of the frame with `object_id`, null where there is none.
    star_names
        What stands before a star's number, such as "HIP ".
    """
    message: Any = ImageAnnotations()
    for x, y, star in _rows(stars, "star_id"):
        circle = message.circles.add(diameter=RING_PX, thickness=LINE_PX)
        _time(circle.timestamp, time_ns)
        _place(circle.position, x, y)
        _colour(circle.outline_color, BLUE)
        _text(message, time_ns, (x + RING_PX / 2, y - RING_PX / 2), f"{star_names}{star}", BLUE)
    named = detections.filter(pl.col("object_id").is_not_null())
    for x, y, name in _rows(named, "object_id"):
        d = SQUARE_PX
        corners = [(x - d, y - d), (x + d, y - d), (x + d, y + d), (x - d, y + d)]
        _lines(message, time_ns, PointsAnnotation.LINE_LOOP, corners, ORANGE)
        _text(message, time_ns, (x + d, y - d), str(name), ORANGE)
    others = detections.filter(pl.col("object_id").is_null())
    for x, y, kind in _rows(others, "kind"):
        d = CROSS_PX
        ends = [(x - d, y - d), (x + d, y + d), (x - d, y + d), (x + d, y - d)]
        _lines(message, time_ns, PointsAnnotation.LINE_LIST, ends, RED)
        if kind != "unknown":
            _text(message, time_ns, (x + d, y - d), str(kind), RED)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def _rows(rows: pl.DataFrame, name: str) -> Iterable[tuple[float, float, Any]]:
    """Yield places, from the corner of the first pixel, and a column."""
    return zip(
        (rows["x_px"] + HALF_PX).to_list(),
        (rows["y_px"] + HALF_PX).to_list(),
        rows[name].to_list(),
        strict=True,
    )


def _lines(
    message: Any, time_ns: int, kind: int, places: list[tuple[float, float]], colour: Any
) -> None:
    lines = message.points.add(type=kind, thickness=LINE_PX)
    _time(lines.timestamp, time_ns)
    for x, y in places:
        _place(lines.points.add(), x, y)
    _colour(lines.outline_color, colour)


def _text(message: Any, time_ns: int, place: tuple[float, float], text: str, colour: Any) -> None:
    label = message.texts.add(text=text, font_size=TEXT_PX)
    _time(label.timestamp, time_ns)
    _place(label.position, *place)
    _colour(label.text_color, colour)
    _colour(label.background_color, BLACK, 0.5)


def _place(point: Any, x: float, y: float) -> None:
    point.x, point.y = x, y


def _colour(colour: Any, rgb: tuple[float, ...], opacity: float = 1.0) -> None:
    colour.r, colour.g, colour.b = rgb
    colour.a = opacity


def _time(stamp: Any, time_ns: int) -> None:
    stamp.seconds, stamp.nanos = divmod(int(time_ns), 1_000_000_000)


def image_of(shape: tuple[int, int], places: np.ndarray) -> np.ndarray:
    """Return a grey image (rows, columns) with a spot of 3 x 3 px at each of (n, 2) places."""
    image = np.zeros(shape, np.uint8)
    centre = np.round(places).astype(int)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            x, y = centre[:, 0] + dx, centre[:, 1] + dy
            inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
            grey = 255 if dx == dy == 0 else 120
            image[y[inside], x[inside]] = np.maximum(image[y[inside], x[inside]], grey)
    return image
