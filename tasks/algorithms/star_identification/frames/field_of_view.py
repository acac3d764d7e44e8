"""The field of view of a camera, with its distortion."""

import numpy as np

from epipole.tasks.algorithms.geometry.camera import Camera, undistort
from epipole.tasks.algorithms.star_identification.frames.frame import FieldOfView

EDGE_POINTS = 9  # of each edge of the image


def field_of_view(camera: Camera) -> FieldOfView:
    """Return the half diagonal and the box of the image in normalised coordinates."""
    n = EDGE_POINTS
    side = np.linspace(-0.5, camera.width - 0.5, n)
    down = np.linspace(-0.5, camera.height - 0.5, n)
    x_px = np.concatenate([side, side, np.full(n, side[0]), np.full(n, side[-1])])
    y_px = np.concatenate([np.full(n, down[0]), np.full(n, down[-1]), down, down])
    x, y = undistort(
        camera, (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    )
    half_diagonal = float(np.arctan(np.max(np.hypot(x, y))))
    return FieldOfView(
        half_diagonal, np.array([x.min(), x.max(), y.min(), y.max()]), camera.pixel_rad
    )
