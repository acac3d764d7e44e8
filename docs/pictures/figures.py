"""A figure for each page of methods."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from night import Array, Night, attitude, column, covariance, rows, sights, true_place
from style import BLUE, GREY, INK, ORANGE, TRACKS, figure, image_axes
from views import SENSOR

from epipole.tasks.algorithms.geometry.camera import project
from epipole.tasks.algorithms.geometry.directions import aberrate

ARCSEC = np.pi / 648_000


def draw_identification(night: Night) -> Figure:
    """Return the stars' residuals over what is expected of them, beside the standard normal.

    The fit of an attitude takes 3 of the 2 n degrees of freedom of n stars.
    """
    stars = night.tables["stars"].join(
        night.tables["frames"].select("sensor_id", "frame_number", "n_stars"),
        on=["sensor_id", "frame_number"],
    )
    sigma_arcsec = night.tables["detections"]["sigma_arcsec"].median()
    camera = next(iter(night.cameras.values()))
    sigma_px = sigma_arcsec * ARCSEC / camera.pixel_rad
    left = 1 - 3 / (2 * column(stars, "n_stars"))
    z = column(stars, "dx_px", "dy_px") / (sigma_px * np.sqrt(left))[:, None]
    drawing, axes = figure(4.2, 2.2)
    _against_normal(axes, z.ravel())
    axes.set(xlabel="star residual / its standard deviation", ylabel="density")
    return drawing


def draw_tracking(night: Night) -> Figure:
    """Return a part of one sensor's sky: each detection of a minute, one tracklet in colour."""
    drawing, axes = figure(4.2, 2.6)
    tracklet_id = rows(night, "tracklets", sensor_id=SENSOR).sort("tracklet_id")["tracklet_id"][2]
    seen = rows(night, "detections", sensor_id=SENSOR)
    stray = seen.filter(seen["tracklet_id"].is_null())
    axes.scatter(*column(stray, "ra_deg", "dec_deg").T, s=9, color=GREY, linewidths=0)
    track = rows(night, "detections", tracklet_id=tracklet_id)
    places = column(track, "ra_deg", "dec_deg")
    axes.scatter(*places.T, s=5, color=ORANGE, linewidths=0)
    ra, dec = places.mean(axis=0)
    axes.set(aspect=1 / np.cos(np.radians(dec)))
    axes.set(xlim=(ra + 0.2, ra - 0.2), ylim=(dec - 0.115, dec + 0.115))
    axes.set(xlabel="right ascension [deg]", ylabel="declination [deg]")
    return drawing


def draw_association(night: Night) -> Figure:
    """Return the image of one sensor with the epipolar lines of what another one saw."""
    one, other = "sat3", "sat4"
    drawing, axes = figure(3.4, 3.4)
    camera = night.cameras[other]
    both = night.tables["associations"].group_by("epoch").len().sort("len", "epoch")
    epoch = both["epoch"][-1]
    views = rows(night, "associations", epoch=epoch)
    shared = set(views.filter(sensor_id=one)["object_id"]) & set(
        views.filter(sensor_id=other)["object_id"]
    )
    frame = int(views.filter(sensor_id=other)["frame_number"][0])
    seen = rows(night, "detections", sensor_id=other, frame_number=frame)
    axes.scatter(*column(seen, "x_px", "y_px").T, s=9, color=INK, linewidths=0, zorder=3)
    R = attitude(night, other, frame)
    v_km_s = column(
        rows(night, "frames", sensor_id=other, frame_number=frame), "vx_km_s", "vy_km_s", "vz_km_s"
    )
    for number, object_id in enumerate(sorted(shared)):
        lines = {sight.sensor_id: sight for sight in sights(night, object_id, epoch)}
        range_km = np.geomspace(1.5e4, 1e6, 400)
        points = lines[one].r_km + range_km[:, None] * lines[one].u - lines[other].r_km
        u = aberrate(points / np.linalg.norm(points, axis=1)[:, None], v_km_s)
        axes.plot(*project(camera, u @ R.T), color=TRACKS[number % len(TRACKS)], linewidth=0.8)
    image_axes(axes, camera.width, camera.height)
    return drawing


def draw_positions(night: Night) -> Figure:
    """Return the errors of all positions in units of their covariance, and the normal."""
    z = [_whitened(night, row) for row in night.tables["positions"].to_dicts()]
    drawing, axes = figure(4.2, 2.2)
    _against_normal(axes, np.concatenate(z))
    axes.set(xlabel="position error / its standard deviation", ylabel="density")
    return drawing


def _whitened(night: Night, position: dict) -> Array:
    here = np.array([position["x_km"], position["y_km"], position["z_km"]])
    error = here - true_place(night, position)
    return np.linalg.solve(np.linalg.cholesky(covariance(position)), error)


def _against_normal(axes: Axes, z: Array) -> None:
    axes.hist(z, np.linspace(-4, 4, 41), density=True, color=BLUE, alpha=0.45,
              label=f"{z.size:,} values")  # fmt: skip
    x = np.linspace(-4, 4, 200)
    axes.plot(x, np.exp(-x * x / 2) / np.sqrt(2 * np.pi), color=INK, linewidth=1.0,
              label="standard normal")  # fmt: skip
    axes.set(xlim=(-4, 4))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper right")
