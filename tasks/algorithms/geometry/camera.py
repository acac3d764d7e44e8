"""The camera: a pinhole or a fisheye, then Brown-Conrady distortion.

Pixel (0, 0) is the middle of the top-left pixel; x right, y down, z out along the boresight.

A direction at the angle theta from the boresight has its ideal position at the distance tan(theta)
from the principal point with a pinhole, and theta with a fisheye, in focal lengths. Distortion
moves this position. A pinhole with it is OpenCV's and ROS's plumb_bob. A fisheye with its radial
terms alone is OpenCV's fisheye, ROS's equidistant and Foxglove's kannala_brandt: Kannala and Brandt
(2006), A generic camera model and calibration method, eq. 6, with k1 = 1.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags

# Largest angle from the boresight that a fisheye shows [rad]. Directions are compared on the plane
# at right angles to the boresight, which ends at pi / 2.
WIDEST_RAD = 1.5


class Camera(NamedTuple):
    """Intrinsics of a sensor [px; the distortion coefficients have no unit].

    A negative `fy_px` is an image whose rows count upward.

    Attributes
    ----------
    width, height : int
        Size of the image.
    fx_px, fy_px : float
        Focal lengths along columns and rows.
    cx_px, cy_px : float
        Principal point; (0, 0) is the middle of the top-left pixel.
    k1, k2, p1, p2, k3, k4 : float
        Distortion, Brown-Conrady, in the order of OpenCV; k4 is of the eighth power.
    fisheye : bool
        Without distortion, the distance from the principal point is the angle from the boresight.
    line_time_s : float
        Rolling shutter: time from the exposure of one row to that of the next [s].
    """

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
    k4: float = 0.0
    fisheye: bool = False
    line_time_s: float = 0.0

    @property
    def distorts(self) -> bool:
        """Whether positions differ from those of an ideal pinhole."""
        return self.fisheye or any((self.k1, self.k2, self.p1, self.p2, self.k3, self.k4))

    @property
    def pixel_rad(self) -> float:
        """Angle of one pixel at the principal point [rad]."""
        return 1.0 / np.sqrt(self.fx_px * abs(self.fy_px))

    @property
    def field_deg(self) -> tuple[float, float]:
        """Width and height of the field of view, without distortion [deg]."""
        sides = (self.width, self.fx_px), (self.height, abs(self.fy_px))
        across, down = (float(np.degrees(2 * self._angle_rad(n / 2 / f))) for n, f in sides)
        return across, down

    @property
    def half_field(self) -> tuple[float, float]:
        """Tangents of half the width and height of the field of view, without distortion."""
        across, down = self.width / 2 / self.fx_px, self.height / 2 / abs(self.fy_px)
        if not self.fisheye:
            return across, down
        return float(np.tan(self._angle_rad(across))), float(np.tan(self._angle_rad(down)))

    @property
    def corner_distance(self) -> float:
        """Distance of the farthest corner from the principal point [focal lengths]."""
        x = max(self.cx_px + 0.5, self.width - 0.5 - self.cx_px) / self.fx_px
        y = max(self.cy_px + 0.5, self.height - 0.5 - self.cy_px) / abs(self.fy_px)
        return float(np.hypot(x, y))

    @property
    def half_diagonal_rad(self) -> float:
        """Angle from the boresight to the farthest corner, without distortion [rad]."""
        return self._angle_rad(self.corner_distance)

    def _angle_rad(self, distance: float) -> float:
        return min(distance, WIDEST_RAD) if self.fisheye else float(np.arctan(distance))


def mirrored(camera: Camera) -> Camera:
    """Return the camera with y up instead of down; pixel positions and principal point stay.

    A mirror changes the sign of `p1`.
    """
    return camera._replace(fy_px=-camera.fy_px, p1=-camera.p1)


def flip_rows(camera: Camera, y_px: Array) -> tuple[Camera, Array]:
    """Return the same camera and pixel rows (n,) with the image's rows counted the other way."""
    last = camera.height - 1
    flipped = camera._replace(
        fy_px=-camera.fy_px, cy_px=last - camera.cy_px, line_time_s=-camera.line_time_s
    )
    return flipped, last - y_px


def row_offset_s(camera: Camera, y_px: Array) -> Array:
    """Return the time of each row (n,) after the frame's, which is that of the middle row [s]."""
    return (y_px - 0.5 * (camera.height - 1)) * camera.line_time_s


FARTHEST = 4.0  # radius up to which a fold is looked for, normalised coordinates
FOLD_STEPS = 4000


@lru_cache(maxsize=256)
def fold_radius(camera: Camera) -> float:
    """Return the ideal distance [focal lengths] where radial distortion folds back; inf: nowhere.

    Beyond it, two directions would have one pixel position; a lens shows nothing there. For a
    fisheye it is at most `WIDEST_RAD`.
    """
    farthest = WIDEST_RAD if camera.fisheye else FARTHEST
    unfolded = WIDEST_RAD if camera.fisheye else float(np.inf)
    if not any((camera.k1, camera.k2, camera.k3, camera.k4)):
        return unfolded
    r = np.linspace(0.0, farthest, FOLD_STEPS)
    r2 = r * r
    high = 7 * camera.k3 + r2 * 9 * camera.k4
    slope = 1 + r2 * (3 * camera.k1 + r2 * (5 * camera.k2 + r2 * high))
    folded = np.flatnonzero(slope <= 0)
    return float(r[folded[0] - 1]) if len(folded) else unfolded


def distort(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Return distorted normalised coordinates of directions (x, y, 1), each (n,)."""
    if not camera.distorts:
        return np.array(x, float), np.array(y, float)
    return _bend(camera, *ideal_position(camera, x, y))


def slopes(camera: Camera, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return the derivatives of `distort`: of x by x, of x by y, of y by x, of y by y."""
    if not camera.fisheye:
        across, mixed, down = _bend_slopes(camera, x, y)
        return across, mixed, mixed, down
    axx, axy, ayy = _bend_slopes(camera, *ideal_position(camera, x, y))
    bxx, bxy, byy = _fisheye_slopes(x, y)
    return (
        axx * bxx + axy * bxy,
        axx * bxy + axy * byy,
        axy * bxx + ayy * bxy,
        axy * bxy + ayy * byy,
    )


# From the direction to the ideal position.

AT_MIDDLE = 1e-4  # distances below which tangent and angle differ by less than 1e-8 of themselves


def ideal_position(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the positions of directions (x, y, 1) before distortion [focal lengths], each (n,)."""
    if not camera.fisheye:
        return x, y
    share = _angle_over_tangent(np.hypot(x, y))
    return x * share, y * share


def _angle_over_tangent(tangent: Array) -> Array:
    near = np.maximum(tangent, AT_MIDDLE)
    return np.where(tangent > AT_MIDDLE, np.arctan(near) / near, 1 - tangent * tangent / 3)


def _direction(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the inverse of `ideal_position`; NaN beyond `WIDEST_RAD`."""
    if not camera.fisheye:
        return x, y
    angle = np.hypot(x, y)
    share = _angle_over_tangent(np.tan(np.where(angle <= WIDEST_RAD, angle, np.nan)))
    return x / share, y / share


def _fisheye_slopes(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the derivatives of a fisheye's `ideal_position`: x by x, x by y (y by x), y by y."""
    r2 = x * x + y * y
    share = _angle_over_tangent(np.sqrt(r2))
    slope = (1 / (1 + r2) - share) / np.maximum(r2, AT_MIDDLE**2)  # d share / d r, over r
    slope = np.where(r2 > AT_MIDDLE**2, slope, -2.0 / 3)
    return share + slope * x * x, slope * x * y, share + slope * y * y


# From the ideal position to the image.


def _bend(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Return distorted positions (OpenCV, camera calibration, eq. plumb_bob)."""
    r2 = x * x + y * y
    radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * (camera.k3 + r2 * camera.k4)))
    xd = x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x)
    yd = y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y
    return xd, yd


def _bend_slopes(camera: Camera, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the derivatives of `_bend`: of x by x, of x by y (and y by x), of y by y."""
    k1, k2, p1, p2, k3, k4 = (
        camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, camera.k4,
    )  # fmt: skip
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + 4 * k4 * r2)))  # d radial / d r2, times 2
    return (
        radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        radial + slope * y * y + 6 * p1 * y + 2 * p2 * x,
    )


def undistort(camera: Camera, xd: Array, yd: Array) -> tuple[Array, Array]:
    """Return the normalised coordinates that `distort` maps to (xd, yd), by Newton's method.

    NaN where no direction inside the fold of the distortion has this position, as in the corners of
    a wide lens's image.
    """
    if not camera.distorts:
        return np.array(xd, float), np.array(yd, float)
    return _direction(camera, *_straighten(camera, xd, yd))


# Newton's method: maximum number of steps (ordinary lenses take four), and maximum length of a step
# over the distance from the principal point. Near a fold, an undamped step leads far away.
MAX_STEPS, LONGEST_STEP = 40, 0.2


def _straighten(camera: Camera, xd: Array, yd: Array) -> tuple[Array, Array]:
    """Return the inverse of `_bend`, NaN beyond the fold."""
    x, y = np.array(xd, float), np.array(yd, float)
    fold, longest = fold_radius(camera), LONGEST_STEP * np.hypot(x, y)
    for _ in range(MAX_STEPS):
        ex, ey = _bend(camera, x, y)
        ex -= xd
        ey -= yd
        # Convergence is quadratic: after a step from below 1e-9 the rest is rounding.
        last = max(np.abs(ex).max(initial=0.0), np.abs(ey).max(initial=0.0)) < 1e-9
        jxx, jxy, jyy = _bend_slopes(camera, x, y)
        determinant = jxx * jyy - jxy * jxy
        dx, dy = (jyy * ex - jxy * ey) / determinant, (jxx * ey - jxy * ex) / determinant
        damping = longest / np.maximum(np.hypot(dx, dy), np.maximum(longest, 1e-300))
        x, y = x - damping * dx, y - damping * dy
        if last:
            break
        if np.isfinite(fold):
            x, y = _inside_fold(fold, x, y)
    ex, ey = _bend(camera, x, y)
    found = (np.hypot(ex - xd, ey - yd) < 1e-7) & (np.hypot(x, y) <= fold)
    return np.where(found, x, np.nan), np.where(found, y, np.nan)


def ends_of_fold(camera: Camera, n: int) -> tuple[Array, Array]:
    """Return those of n directions (x, y, 1) around the fold of the distortion that are in view."""
    turn = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    r = (1 - 1e-9) * fold_radius(camera)  # rounding must not put them beyond
    if not np.isfinite(r):
        return np.empty(0), np.empty(0)
    x, y = r * np.cos(turn), r * np.sin(turn)
    xd, yd = _bend(camera, x, y)
    shown = inside(camera, camera.cx_px + camera.fx_px * xd, camera.cy_px + camera.fy_px * yd)
    return _direction(camera, x[shown], y[shown])


def _inside_fold(fold: float, x: Array, y: Array) -> tuple[Array, Array]:
    """Return points (n,); those at or beyond the fold are moved to just inside it."""
    shrunk = 0.999 * fold / np.maximum(np.hypot(x, y), 0.999 * fold)
    return x * shrunk, y * shrunk


def unproject(camera: Camera, x_px: Array, y_px: Array) -> Array:
    """Return (n, 3) unit vectors in the sensor frame of pixel positions (n,)."""
    x, y = undistort(
        camera, (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    )
    z = 1.0 / np.sqrt(1.0 + x * x + y * y)
    return np.stack([x * z, y * z, z], axis=-1)


def project(camera: Camera, u: Array) -> tuple[Array, Array]:
    """Return the pixel positions of (n, 3) sensor-frame directions; NaN behind the camera."""
    z = np.where(u[..., 2] > 0, u[..., 2], np.nan)
    x, y = distort(camera, u[..., 0] / z, u[..., 1] / z)
    return camera.cx_px + camera.fx_px * x, camera.cy_px + camera.fy_px * y


def inside(camera: Camera, x_px: Array, y_px: Array) -> Flags:
    """Return which pixel positions lie on the image; false for NaN."""
    return (
        (x_px >= -0.5) & (x_px < camera.width - 0.5) & (y_px >= -0.5) & (y_px < camera.height - 0.5)
    )


def pixel_angle(camera: Camera, u: Array) -> Array:
    """Return the angle [rad] of one pixel at (n, 3) sensor-frame directions.

    The geometric mean of both image axes (the root of the solid angle). Off the boresight a
    pixel covers less: by the cosine of the field angle on one axis, its square on the other.
    """
    solid = u[..., 2] * u[..., 2] * u[..., 2] / (camera.fx_px * abs(camera.fy_px))
    if camera.distorts:
        jxx, jxy, jyx, jyy = slopes(camera, u[..., 0] / u[..., 2], u[..., 1] / u[..., 2])
        solid /= np.maximum(np.abs(jxx * jyy - jxy * jyx), 1e-6)
    return np.sqrt(solid)
