"""What the pages about one sensor explain: votes, optics, circles about stars."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from night import Array, Night, column, rows
from scipy.spatial import cKDTree
from style import GREY, INK, ORANGE, TRACKS, figure, image_axes, plt
from views import SENSOR

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera, project, unproject
from epipole.tasks.algorithms.geometry.directions import (
    east_north,
    matrix_from_quaternion,
    unit_from_radec,
)

FRAME = 30
TOLERANCE = 15 * ARCSEC  # of a separation
TURN_DEG = 1.0  # votes for one turn of the image differ by less
FAINTEST = 10.0  # magnitude
LONGEST_PX = 90.0  # arrow
SHOWN = 16


def draw_votes(night: Night) -> Figure:
    """Return the votes of a frame's centroids for what star one of them is."""
    of_frame = {"sensor_id": SENSOR, "frame_number": FRAME}
    stars = rows(night, "stars", **of_frame).sort("magnitude")
    others = rows(night, "detections", **of_frame)
    places = np.vstack([column(stars, "x_px", "y_px"), column(others, "x_px", "y_px")])
    camera = night.cameras[SENSOR]
    counts = _votes(unproject(camera, *places.T))
    drawing, (image, bars) = plt.subplots(
        1, 2, figsize=(6.4, 2.7), layout="constrained", width_ratios=(1, 1.5)
    )
    for place in places[1:]:
        image.plot(*np.stack([places[0], place]).T, color=GREY, linewidth=0.6)
    image.scatter(*places[1:].T, s=12, color=INK, linewidths=0, zorder=3)
    image.scatter(*places[0], s=40, color=ORANGE, linewidths=0, zorder=3)
    image_axes(image, camera.width, camera.height)
    image.set_title("the pivot and its separations")
    best = counts[:SHOWN]
    pivot = int(stars["star_id"][0])
    colours = [ORANGE if star == pivot else GREY for star, _ in best]
    bars.bar(np.arange(len(best)), [n for _, n in best], color=colours, width=0.7)
    bars.annotate(f"HIP {pivot}, the true one", (0.6, best[0][1] - 0.6), color=ORANGE, fontsize=7.5)
    bars.set(xticks=[], ylabel="votes", yticks=range(0, best[0][1] + 1, 2))
    bars.set_xlabel(f"{SHOWN} of {len(counts):,} stars that got votes, those with most")
    bars.spines[["top", "right"]].set_visible(False)
    return drawing


def _votes(u: Array) -> list[tuple[int, int]]:
    """Return how many companions of the first direction agree that it is a star, most first.

    A companion votes for each star that has a neighbour at the same separation, and for the turn
    of the image that puts the neighbour there; votes agree where their turns do.
    """
    catalogue = read_hipparcos()
    bright = array(catalogue, "magnitude") < FAINTEST
    ra, dec = (np.radians(array(catalogue, name)[bright]) for name in ("ra_deg", "dec_deg"))
    sky, star_id = unit_from_radec(ra, dec), array(catalogue, "star_id")[bright]
    separation = np.linalg.norm(u[1:] - u[0], axis=1)
    pairs = cKDTree(sky).query_pairs(separation.max() + TOLERANCE, output_type="ndarray")
    pairs = np.vstack([pairs, pairs[:, ::-1]])
    line = sky[pairs[:, 1]] - sky[pairs[:, 0]]
    to_east, to_north = np.einsum("nai,ni->an", east_north(sky[pairs[:, 0]]), line)
    bearing, chord = np.degrees(np.arctan2(to_east, to_north)), np.linalg.norm(line, axis=1)
    turns: dict[int, list[float]] = {}
    for there, apart in zip(u[1:] - u[0], separation, strict=True):
        near = np.abs(chord - apart) < TOLERANCE
        turn = (bearing[near] + np.degrees(np.arctan2(there[0], -there[1]))) % 360
        for star, angle in zip(star_id[pairs[near, 0]].tolist(), turn.tolist(), strict=True):
            turns.setdefault(star, []).append(angle)
    agree = {star: _most_alike(np.sort(angles)) for star, angles in turns.items()}
    return sorted(agree.items(), key=lambda of: -of[1])


def _most_alike(turns_deg: Array) -> int:
    last = np.searchsorted(turns_deg, turns_deg + TURN_DEG, side="right")
    return int((last - np.arange(len(turns_deg))).max())


def draw_optics(night: Night) -> Figure:
    """Return how far star images move in the image by three errors of the optics."""
    focal_px = 512 / np.tan(np.radians(4.0))
    camera = Camera(1024, 1024, focal_px, focal_px, 511.5, 511.5)
    changes = (
        ("focal length, 0.1 %", {"fx_px": 1.001 * focal_px, "fy_px": 1.001 * focal_px}),
        ("distortion, k1 = 0.3", {"k1": 0.3}),
        ("principal point, 5 px", {"cx_px": 511.5 + 5.0}),
    )
    drawing, panels = plt.subplots(1, 3, figsize=(6.4, 2.5), layout="constrained")
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(60, 964, 9), np.linspace(60, 964, 9)))
    for axes, (name, change) in zip(panels, changes, strict=True):
        moved = np.stack(project(camera._replace(**change), unproject(camera, x, y))) - [x, y]
        turned = np.column_stack([_by_rotation(camera, x, y, axis) for axis in np.eye(3)])
        left = moved.ravel() - turned @ np.linalg.lstsq(turned, moved.ravel(), rcond=None)[0]
        scale = np.hypot(*moved).max() / LONGEST_PX
        axes.quiver(
            x, y, *moved, color=GREY, angles="xy", scale_units="xy", scale=scale, width=0.006
        )
        axes.quiver(x, y, *left.reshape(2, -1), color=ORANGE, angles="xy", scale_units="xy",
                    scale=scale, width=0.008)  # fmt: skip
        image_axes(axes, camera.width, camera.height)
        axes.set_title(name)
        rms = np.sqrt(np.mean(left**2))
        axes.set_xlabel(f"{rms:.2g} px are left", color=ORANGE)
    return drawing


def _by_rotation(camera: Camera, x: Array, y: Array, axis: Array) -> Array:
    """Return how image places move if the sensor is turned by a small angle, for each unit."""
    small = 1e-6
    R = matrix_from_quaternion(np.append(axis * small / 2, 1.0)[None])[0]
    moved = np.stack(project(camera, unproject(camera, x, y) @ R.T)) - [x, y]
    return moved.ravel() / small


def draw_boresight(night: Night) -> Figure:
    """Return three stars of Orion, the circle about each, and the point where they meet."""
    ra_deg = np.array([81.2828, 78.6345, 86.9391])
    dec_deg = np.array([6.3497, -8.2016, -9.6696])
    names = ("Bellatrix", "Rigel", "Saiph")
    boresight = unit_from_radec(np.radians(84.0), np.radians(-1.5))
    across = east_north(boresight[None])[0]
    u = unit_from_radec(np.radians(ra_deg), np.radians(dec_deg))
    drawing, axes = figure(3.4, 3.4)
    angle = np.linspace(0, 2 * np.pi, 200)
    for star, name, colour in zip(u, names, TRACKS, strict=False):
        radius = np.arccos(star @ boresight)
        basis = east_north(star[None])[0]
        around = np.cos(radius) * star + np.sin(radius) * (
            np.outer(np.cos(angle), basis[0]) + np.outer(np.sin(angle), basis[1])
        )
        axes.plot(*_plane(around, boresight, across), color=colour, linewidth=1.0)
        place = _plane(star[None], boresight, across)[:, 0]
        axes.plot(*place, "o", color=colour, markersize=5)
        axes.plot(*np.stack([place, [0, 0]]).T, color=colour, linewidth=0.7, linestyle=(0, (3, 2)))
        axes.annotate(name, place, xytext=(6, 4), textcoords="offset points", color=colour)
    axes.add_patch(Circle((0, 0), 0.45, facecolor="none", edgecolor=INK, linewidth=1.2))
    axes.annotate("boresight", (0, 0), xytext=(9, -3), textcoords="offset points", color=INK)
    axes.set(xlim=(13, -13), ylim=(-16, 12), aspect="equal", xticks=[], yticks=[])
    return drawing


def _plane(u: Array, boresight: Array, across: Array) -> Array:
    """Return (2, n) places [deg] on the tangent plane of the boresight."""
    depth = u @ boresight
    return np.degrees((across @ u.T) / depth)
