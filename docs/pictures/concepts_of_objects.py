"""What the pages about objects explain: gates, epipolar planes, triangulation, sigma, clocks."""

import re
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon
from night import Array, Night, column, covariance, rows, sights, true_place
from style import BLUE, GREEN, GREY, INK, ORANGE, TRACKS, figure, plt

from epipole.tasks.algorithms.geometry.directions import aberrate, unit_from_radec

TUTORIAL = Path(__file__).parents[1] / "first_night.md"


def draw_gates(night: Night) -> Figure:
    """Return a track that is followed through a frame that misses its object."""
    rng = np.random.default_rng(4)
    drawing, axes = figure(5.6, 2.0)
    sigma = 0.12  # of a centroid
    state, P = np.array([0.0, 1.0]), np.diag([sigma**2, 0.3**2])
    F, Q = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]) * 4e-3
    axes.plot(0, 0, "o", color=ORANGE, markersize=4)
    strays = np.column_stack([rng.uniform(-0.5, 9.8, 26), rng.uniform(-1.3, 1.3, 26)])
    axes.scatter(*strays.T, s=7, color=GREY, linewidths=0)
    for frame in range(1, 10):
        state, P = F @ state, F @ P @ F.T + Q
        gate = 3 * np.sqrt(P[0, 0] + sigma**2)
        axes.add_patch(Circle((state[0], 0), gate, facecolor=BLUE, alpha=0.13, linewidth=0))
        axes.add_patch(Circle((state[0], 0), gate, facecolor="none", edgecolor=BLUE, linewidth=0.7))
        if frame in (5, 6):
            continue
        seen = frame + rng.normal() * sigma
        axes.plot(seen, rng.normal() * sigma, "o", color=ORANGE, markersize=4)
        gain = P[:, 0] / (P[0, 0] + sigma**2)
        state, P = state + gain * (seen - state[0]), P - np.outer(gain, P[0])
    axes.annotate("two frames without a detection:\nthe gate grows", (5.5, 1.62), ha="center",
                  fontsize=7.5, color=INK, va="bottom")  # fmt: skip
    axes.set(xlim=(-0.7, 10), ylim=(-1.5, 2.5), aspect="equal", xticks=[], yticks=[])
    axes.axis("off")
    return drawing


def draw_planes(night: Night) -> Figure:
    """Return the plane of a baseline and a direction, and the planes of what two sensors saw."""
    drawing, (sketch, numbers) = plt.subplots(
        1, 2, figsize=(6.4, 2.6), layout="constrained", width_ratios=(1, 1.35)
    )
    _sketch_plane(sketch)
    first, second, pairs = _plane_angles(night, "sat3", "sat4")
    for height, angles in ((1, first), (0, second)):
        numbers.vlines(angles, height - 0.12, height + 0.12, color=GREY, linewidth=0.9)
    for number, (a, b) in enumerate(pairs):
        colour = TRACKS[number % len(TRACKS)]
        numbers.plot([a, b], [0.86, 0.14], color=colour, linewidth=0.9)
        numbers.vlines([a], 0.88, 1.12, color=colour, linewidth=1.6)
        numbers.vlines([b], -0.12, 0.12, color=colour, linewidth=1.6)
    numbers.set(yticks=[0, 1], ylim=(-0.3, 1.3), xlabel="angle about the baseline [deg]")
    numbers.set_yticklabels(["sat4", "sat3"])
    numbers.tick_params(axis="y", length=0)
    numbers.spines[["top", "right", "left"]].set_visible(False)
    return drawing


def _sketch_plane(axes: Axes) -> None:
    one, two, there = np.array([0.0, 0.0]), np.array([0.7, -1.1]), np.array([4.2, 0.5])
    axes.add_patch(Polygon([one, two, there], facecolor=BLUE, alpha=0.12, linewidth=0))
    image = np.array([[1.45, -1.45], [2.35, -1.05], [2.35, 0.1], [1.45, -0.3]])
    axes.add_patch(Polygon(image, facecolor="white", edgecolor=GREY, linewidth=0.8))
    axes.plot(*np.stack([one, there]).T, color=BLUE, linewidth=1.1)
    axes.plot(*np.stack([two, there]).T, color=ORANGE, linewidth=1.1)
    axes.plot(*np.stack([one, two]).T, color=INK, linewidth=1.3)
    axes.plot([1.45, 2.35], [-1.02, -0.1], color=BLUE, linewidth=1.5)
    axes.plot(*(two + (there - two) * 0.335), "o", color=ORANGE, markersize=4)
    for place, name, off in ((one, "sensor 1", (-4, 7)), (two, "sensor 2", (-8, -12))):
        axes.plot(*place, "s", color=INK, markersize=5)
        axes.annotate(name, place, xytext=off, textcoords="offset points", ha="center")
    axes.plot(*there, "o", color=GREEN, markersize=6)
    axes.annotate(
        "object", there, xytext=(0, 7), textcoords="offset points", ha="center", color=GREEN
    )
    axes.annotate("baseline", (0.35, -0.55), xytext=(-4, 0), textcoords="offset points", ha="right")
    axes.annotate(
        "epipolar line", (2.3, -0.2), xytext=(8, -22), textcoords="offset points", color=BLUE
    )
    axes.set(xlim=(-1.3, 4.8), ylim=(-1.9, 1.2), aspect="equal")
    axes.axis("off")


def _plane_angles(night: Night, one: str, other: str) -> tuple[Array, Array, list[Array]]:
    """Return the angles of all detections of two sensors at one epoch, and those of the objects."""
    both = night.tables["associations"].group_by("epoch").len().sort("len", "epoch")
    epoch = both["epoch"][-1]
    views = rows(night, "associations", epoch=epoch)
    found = {}
    for object_id in sorted(set(views["object_id"])):
        lines = {sight.sensor_id: sight for sight in sights(night, object_id, epoch)}
        if one in lines and other in lines:
            found[object_id] = (lines[one], lines[other])
    a, b = next(iter(found.values()))
    axis = (b.r_km - a.r_km) / np.linalg.norm(b.r_km - a.r_km)
    first = a.u - (a.u @ axis) * axis
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)

    def angle(u: Array) -> Array:
        return np.degrees(np.arctan2(u @ second, u @ first))

    pairs = [np.array([angle(x.u), angle(y.u)]) for x, y in found.values()]
    strays = [angle(_strays(night, sensor, views)) for sensor in (one, other)]
    return strays[0], strays[1], pairs


def _strays(night: Night, sensor_id: str, views: pl.DataFrame) -> Array:
    """Return the directions of what no tracklet holds, in the sensor's frame of an epoch."""
    frame = int(views.filter(sensor_id=sensor_id)["frame_number"][0])
    of_frame = {"sensor_id": sensor_id, "frame_number": frame}
    seen = rows(night, "detections", **of_frame)
    seen = seen.filter(seen["tracklet_id"].is_null())
    v_km_s = column(rows(night, "frames", **of_frame), "vx_km_s", "vy_km_s", "vz_km_s")
    ra, dec = np.radians(column(seen, "ra_deg", "dec_deg")).T
    return aberrate(unit_from_radec(ra, dec), -v_km_s)


def draw_triangulation(night: Night) -> Figure:
    """Return the ellipse of a position for lines that meet at three angles."""
    drawing, panels = plt.subplots(1, 3, figsize=(6.4, 2.0), layout="constrained")
    for axes, angle_deg in zip(panels, (10.0, 30.0, 90.0), strict=True):
        information = np.zeros((2, 2))
        for side in (-1, 1):
            half = np.radians(side * angle_deg / 2)
            along, across = [np.cos(half), np.sin(half)], [-np.sin(half), np.cos(half)]
            information += np.outer(across, across)
            for off in (-1, 0, 1):
                ends = np.outer([-20, 20], along) + np.multiply(off, across)
                axes.plot(*ends.T, color=ORANGE, linewidth=1.0 if off == 0 else 0.5,
                          linestyle="-" if off == 0 else (0, (3, 2)))  # fmt: skip
        sizes = 2 / np.sqrt(np.diag(information))  # the axes are those of the drawing
        axes.add_patch(Ellipse((0, 0), *sizes, facecolor=GREEN, alpha=0.3))
        axes.add_patch(Ellipse((0, 0), *sizes, facecolor="none", edgecolor=GREEN, linewidth=1.1))
        axes.set(xlim=(-12, 12), ylim=(-7, 7), aspect="equal", xticks=[], yticks=[])
        axes.set_title(f"lines at {angle_deg:.0f} degrees")
        axes.set_xlabel(f"{sizes[0] / 2:.1f} by {sizes[1] / 2:.1f} errors of a line")
    return drawing


def draw_sigma(night: Night) -> Figure:
    """Return the errors of all positions in sigmas, on two axes, and three circles."""
    errors = []
    for row in night.tables["positions"].to_dicts():
        error = np.array([row["x_km"], row["y_km"], row["z_km"]]) - true_place(night, row)
        errors.append(np.linalg.solve(np.linalg.cholesky(covariance(row)), error)[1:])
    z = np.array(errors)
    drawing, axes = figure(3.6, 3.4)
    axes.scatter(*z.T, s=4, color=BLUE, linewidths=0, alpha=0.7)
    for radius in (1, 2, 3):
        axes.add_patch(Circle((0, 0), radius, facecolor="none", edgecolor=ORANGE, linewidth=1.0))
        inside = 100 * np.mean(np.linalg.norm(z, axis=1) < radius)
        expected = 100 * (1 - np.exp(-(radius**2) / 2))
        axes.annotate(f"{radius} sigma: {inside:.0f} % ({expected:.0f} % expected)",
                      (0, radius), ha="center", va="bottom", fontsize=7, color=INK,
                      bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.8},
                      )  # fmt: skip
    axes.set(xlim=(-4, 4), ylim=(-4, 4), aspect="equal")
    axes.set(xlabel="error / sigma, second axis", ylabel="error / sigma, third axis")
    axes.spines[["top", "right"]].set_visible(False)
    return drawing


def draw_clocks(night: Night) -> Figure:
    """Return how far lines of sight lag behind by their rates: a late clock and a right one."""
    rng = np.random.default_rng(2)
    rate = rng.uniform(-60, 60, 90)
    drawing, axes = figure(4.2, 2.4)
    for late_s, colour, name in ((0.0, GREY, "right"), (0.2, ORANGE, "0.2 s late")):
        residual = -late_s * rate + rng.normal(size=len(rate)) * 1.5
        axes.scatter(rate, residual, s=8, color=colour, linewidths=0, label=f"clock {name}")
        axes.plot([-62, 62], [62 * late_s, -62 * late_s], color=colour, linewidth=1.0)
    axes.set(xlabel="rate of the line of sight [arcsec/s]", ylabel="residual along it [arcsec]")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper right")
    return drawing


def draw_first_night(night: Night) -> Figure:
    """Return the picture that the code of the tutorial draws."""
    text = TUTORIAL.read_text(encoding="utf-8")
    code = re.search(r"<!-- picture -->\n```python\n(.*?)```", text, re.DOTALL)
    assert code is not None, "the tutorial has its mark"
    lines = [line for line in code[1].splitlines() if "savefig" not in line]
    names = {"positions": night.tables["positions"]}
    exec("\n".join(lines), names)
    return names["figure"]
