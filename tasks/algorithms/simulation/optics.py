"""The true camera: image places of directions in the sensor frame."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class TrueOptics(NamedTuple):
    """Pinhole and lens [px; the coefficients have no unit]."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


def bend(optics: TrueOptics, x: Array, y: Array) -> tuple[Array, Array]:
    """Return normalised coordinates behind a Brown-Conrady lens (OpenCV's five terms)."""
    r2 = x**2 + y**2
    radial = 1 + optics.k1 * r2 + optics.k2 * r2**2 + optics.k3 * r2**3
    xy = 2 * x * y
    return (
        radial * x + optics.p1 * xy + optics.p2 * (r2 + 2 * x**2),
        radial * y + optics.p2 * xy + optics.p1 * (r2 + 2 * y**2),
    )


def image_place(optics: TrueOptics, u: Array) -> tuple[Array, Array]:
    """Return columns and rows [px] of (n, 3) sensor-frame directions with z > 0."""
    x, y = bend(optics, u[:, 0] / u[:, 2], u[:, 1] / u[:, 2])
    return optics.fx_px * x + optics.cx_px, optics.fy_px * y + optics.cy_px


def on_image(optics: TrueOptics, x_px: Array, y_px: Array) -> npt.NDArray[np.bool_]:
    """Return which places are on the image; a pixel extends half a pixel about its centre."""
    return (np.abs(x_px - (optics.width - 1) / 2) < optics.width / 2) & (
        np.abs(y_px - (optics.height - 1) / 2) < optics.height / 2
    )


def field_radius(optics: TrueOptics) -> float:
    """Return the angle [rad] from the boresight to the farthest corner, plus 1 %."""
    columns = np.linspace(-0.5, optics.width - 0.5, 9)
    rows = np.linspace(-0.5, optics.height - 0.5, 9)
    x, y = (v.ravel() for v in np.meshgrid(columns, rows))
    x, y = (x - optics.cx_px) / optics.fx_px, (y - optics.cy_px) / optics.fy_px
    wanted_x, wanted_y = x, y
    for _ in range(30):  # a fixed-point iteration: the distortion is small
        got_x, got_y = bend(optics, x, y)
        x, y = x + wanted_x - got_x, y + wanted_y - got_y
    return float(np.arctan(np.max(np.hypot(x, y)))) * 1.01 + 1e-4
