"""The three views of the example's night that the README and the pages of methods show."""

from typing import Any

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Ellipse
from night import Array, Night, Sight, column, covariance, rows, sights, true_place
from style import BLUE, GREEN, GREY, INK, ORANGE, TRACKS, image_axes

EARTH_KM = 6378.137
SENSOR = "sat4"  # whose frame and tracklets are shown
SIGMAS_99 = np.sqrt(9.21034)  # a plane section's 99 % ellipse, chi-square of 2 degrees of freedom


def draw_frame(axes: Axes, night: Night, frame_number: int = 30) -> None:
    """Draw a frame: its centroids, and a ring around each identified star."""
    frame = {"sensor_id": SENSOR, "frame_number": frame_number}
    stars, others = rows(night, "stars", **frame), rows(night, "detections", **frame)
    x, y = column(stars, "x_px", "y_px").T
    size = 2.2 * (10 - column(stars, "magnitude"))
    axes.scatter(x, y, s=size, color=INK, linewidths=0)
    axes.scatter(x, y, s=75, facecolors="none", edgecolors=BLUE, linewidths=1.1)
    for row in _with_room(stars, others).to_dicts():
        axes.annotate(
            f"HIP {row['star_id']}",
            (row["x_px"], row["y_px"]),
            xytext=(7, 0),
            textcoords="offset points",
            va="center",
            color=BLUE,
            fontsize=7,
        )
    axes.scatter(*column(others, "x_px", "y_px").T, s=7, color=INK, linewidths=0)
    camera = night.cameras[SENSOR]
    image_axes(axes, camera.width, camera.height)


def _with_room(stars: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """Return the stars that have room for a label on their right."""
    places = column(stars, "x_px", "y_px")
    around = np.concatenate([places, column(others, "x_px", "y_px")])
    right, down = np.moveaxis(around - places[:, None], -1, 0)
    taken = (right > 0) & (right < 160) & (np.abs(down) < 25)
    return stars.filter(~taken.any(axis=1) & (places[:, 0] < 400))


def draw_tracklets(axes: Axes, night: Night) -> None:
    """Draw a minute of one sensor's detections on the sky; each tracklet has a colour."""
    seen = rows(night, "detections", sensor_id=SENSOR)
    stray = seen.filter(pl.col("tracklet_id").is_null())
    axes.scatter(*column(stray, "ra_deg", "dec_deg").T, s=2, color="#b9c1c9", linewidths=0)
    names = rows(night, "tracklets", sensor_id=SENSOR)["tracklet_id"].to_list()
    for number, name in enumerate(names):
        track = rows(night, "detections", tracklet_id=name).sort("time")
        places = column(track, "ra_deg", "dec_deg")
        colour = TRACKS[number % len(TRACKS)]
        axes.plot(*places.T, color=colour, linewidth=1.6, solid_capstyle="round")
        axes.annotate(
            "",
            places[-1] + 0.06 * _unit(places[-1] - places[0]),
            places[-1],
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.0, "mutation_scale": 7},
        )
    dec = np.radians(column(seen, "dec_deg").mean())
    axes.set(xticks=[], yticks=[], aspect=1 / np.cos(dec))
    axes.invert_xaxis()  # east is left, as seen from inside the sphere


def draw_meeting(axes: Axes, night: Night, height_over_width: float) -> None:
    """Draw the lines of sight to one object, to scale, from above the north pole."""
    _, lines, here = _best_object(night)
    axes.add_patch(Circle((0, 0), EARTH_KM, facecolor="#dbe8f3", edgecolor=BLUE, linewidth=0.7))
    basis = _ring_plane(here)
    place = here @ basis
    for line in lines:
        axes.plot(*np.stack([line.r_km @ basis, place]).T, color=ORANGE, linewidth=0.9)
        axes.plot(*(line.r_km @ basis), marker="s", markersize=3.2, color=INK)
    axes.plot(*place, marker="o", markersize=4.5, color=GREEN)
    ring, radius = np.linspace(-0.2, 0.2, 50), np.hypot(*place)
    axes.plot(radius * np.cos(ring), radius * np.sin(ring), color=GREY, lw=0.6, ls=(0, (4, 3)))
    axes.text(0, 0, "Earth", ha="center", va="center", fontsize=7, color=BLUE)
    left, right = -8000, 46000
    half = (right - left) * height_over_width / 2
    axes.set(xticks=[], yticks=[], xlim=(left, right), ylim=(-half, half))


def draw_ellipsoid(axes: Axes, night: Night) -> None:
    """Draw the last kilometres of the lines, the 99 % ellipse and the true place.

    Distances across the lines are drawn larger than those along them: two bars say how much.
    """
    position, lines, here = _best_object(night)
    basis = _ring_plane(here)
    for line in lines:
        along = (here - line.r_km) @ line.u + np.array([-20.0, 20.0])
        ends = (line.r_km + along[:, None] * line.u - here) @ basis
        axes.plot(*ends.T, color=ORANGE, linewidth=0.9)
    squares, axis = np.linalg.eigh(basis.T @ covariance(position) @ basis)
    axes.add_patch(
        Ellipse(
            (0, 0),
            *(2 * SIGMAS_99 * np.sqrt(squares)),
            angle=np.degrees(np.arctan2(axis[1, 0], axis[0, 0])),
            facecolor=(*to_rgb(GREEN), 0.22),
            edgecolor=GREEN,
            linewidth=1.0,
        )
    )
    axes.plot(0, 0, marker="o", markersize=4.5, color=GREEN)
    true = (true_place(night, position) - here) @ basis
    axes.plot(*true, marker="x", markersize=6, mew=1.3, color=INK)
    x, y = 4.6, 0.9  # km, half of what is shown
    right, low = 0.94 * x, -0.84 * y
    axes.plot([right - 2, right, right], [low, low, low + 0.4], color=GREY, linewidth=1.2)
    axes.text(right - 2.1, low, "2 km", ha="right", va="center", fontsize=6.8, color=GREY)
    axes.text(right - 0.1, low + 0.25, "0.4 km", ha="right", va="center", fontsize=6.8, color=GREY)
    axes.text(-0.96 * x, 0.8 * y, "99 % ellipse", va="center", fontsize=7, color=GREEN)
    axes.text(
        -0.96 * x,
        0.55 * y,
        "\N{MULTIPLICATION SIGN}  true place",
        va="center",
        fontsize=7,
        color=INK,
    )
    axes.set(xticks=[], yticks=[], xlim=(-x, x), ylim=(-y, y))


def _best_object(night: Night) -> tuple[dict[str, Any], list[Sight], Array]:
    """Return a position that all sensors saw, in the middle of the minute, and its lines."""
    whole = rows(night, "positions", n_sensors=len(night.cameras)).sort("epoch", "object_id")
    position = whole.row(whole.height // 2, named=True)
    here = np.array([position["x_km"], position["y_km"], position["z_km"]])
    return position, sights(night, position["object_id"], position["epoch"]), here


def _ring_plane(here: Array) -> Array:
    """Return a (3, 2) basis of the equator's plane: away from the Earth, and across."""
    away = _unit(here * [1, 1, 0])
    return np.stack([away, np.cross([0, 0, 1], away)], axis=1)


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)
