"""The picture of the overlay's page: its messages, read back and drawn as a viewer draws them."""

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from night import Array, Night
from PIL import Image
from style import GREY, image_axes, plt

from epipole.flows.overlay import overlay

SENSOR = "sat4"
FRAME = 30
POINTS_OF_TEXT = 0.55  # a letter of n pixels, in points of this picture
TYPES = {1: "points", 2: "loop", 3: "strip", 4: "list"}  # foxglove.PointsAnnotation


def draw_overlay(night: Night) -> Figure:
    """Return the Image panel and the 3D panel, as they show the overlay of the example."""
    found = _messages(night)
    drawing = plt.figure(figsize=(7.0, 3.5), layout="constrained")
    left = drawing.add_subplot(1, 2, 1)
    right = drawing.add_subplot(1, 2, 2, projection="3d")
    annotations = found[f"/{SENSOR}/annotations"][FRAME]
    image = found[f"/{SENSOR}/image"][FRAME]
    _draw_image(left, image.data, annotations)
    left.set_title(f"Image panel: /{SENSOR}/image, /{SENSOR}/annotations")
    _draw_scene(right, found["/epipole/objects"])
    right.set_title("3D panel: /epipole/objects")
    return drawing


def _messages(night: Night) -> dict[str, list[Any]]:
    """Return the messages of each topic, decoded by the schemas in the file."""
    found: dict[str, list[Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "overlay.mcap"
        overlay(str(night.dataset), [str(night.log)], path, images=True)
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                found.setdefault(channel.topic, []).append(message)
    return found


def _draw_image(axes: Axes, png: bytes, annotations: Any) -> None:
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("L"))
    height, width = pixels.shape
    # The schema counts from the corner of the first pixel.
    axes.imshow(pixels, cmap="gray", extent=(0, width, height, 0), vmax=160)
    image_axes(axes, width, height)
    for circle in annotations.circles:
        place = circle.position.x, circle.position.y
        colour = _rgba(circle.outline_color)
        axes.add_patch(Circle(place, circle.diameter / 2, fill=False, color=colour, linewidth=1))
    for shape in annotations.points:
        _draw_shape(axes, TYPES[shape.type], _xy(shape.points), _rgba(shape.outline_color))
    for text in annotations.texts:
        axes.text(
            text.position.x,
            text.position.y,
            text.text,
            color=_rgba(text.text_color),
            fontsize=POINTS_OF_TEXT * text.font_size,
            clip_on=True,
            bbox={"color": _rgba(text.background_color), "pad": 0.5, "linewidth": 0},
        )


def _draw_shape(axes: Axes, kind: str, places: Array, colour: tuple[float, ...]) -> None:
    if kind == "list":  # each two points are a line
        for start in range(0, len(places), 2):
            axes.plot(*places[start : start + 2].T, color=colour, linewidth=1)
        return
    if kind == "loop":
        places = np.vstack([places, places[:1]])
    axes.plot(*places.T, "o" if kind == "points" else "-", color=colour, linewidth=1, markersize=2)


def _draw_scene(axes: Any, updates: list[Any]) -> None:
    """Draw the Earth, and the objects of an epoch with the lines of sight to them."""
    globe = next(e for update in updates for e in update.entities if e.id == "Earth")
    radius_m = globe.spheres[0].size.x / 2
    around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    ball = np.stack([np.cos(around) * np.sin(up), np.sin(around) * np.sin(up), np.cos(up)])
    axes.plot_wireframe(*(radius_m / 1e6 * ball), color=GREY, linewidth=0.3)
    shown = next(update for update in updates if any(e.lines for e in update.entities))
    for entity in shown.entities:
        if entity.id == "Earth":
            continue
        ball = entity.spheres[0]
        place = _megametres([ball.pose.position])
        axes.plot(*place.T, "o", color=_rgba(ball.color), markersize=4)
        for line in entity.lines:
            ends = _megametres(line.points)
            for start in range(0, len(ends), 2):
                axes.plot(*ends[start : start + 2].T, color=_rgba(line.color), linewidth=0.6)
    axes.set_aspect("equal")
    axes.view_init(elev=70, azim=-60)
    axes.set_axis_off()


def _xy(points: Any) -> Array:
    return np.array([(point.x, point.y) for point in points])


def _megametres(points: Any) -> Array:
    return 1e-6 * np.array([(point.x, point.y, point.z) for point in points])


def _rgba(colour: Any) -> tuple[float, ...]:
    return colour.r, colour.g, colour.b, colour.a
