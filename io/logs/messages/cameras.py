"""The calibrations of a log as CAMERAS."""

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pyarrow as pa

from epipole.io.logs.left_out import RejectList
from epipole.io.logs.messages.batches import MessageBatch, fault, known_id
from epipole.io.logs.messages.encoding import CalibrationMessage
from epipole.schemas.bridge import table, unstack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.log_bounds import (
    CORNER,
    DISTORTION,
    FOCAL_LENGTH,
    FOCAL_RATIO,
    IMAGE_SIDE,
    LINE_TIME,
)
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import CAMERAS

# Names of the distortion models: pinhole; fisheye, as ROS, OpenCV and Foxglove call it.
PINHOLE, FISHEYE = ("", "plumb_bob"), ("equidistant", "fisheye", "kannala_brandt")
# The coefficients D of each, and powers of the distance by which they move an image position.
PINHOLE_TERMS = {"k1": 2, "k2": 4, "p1": 1, "p2": 1, "k3": 6}
FISHEYE_TERMS = {"k1": 2, "k2": 4, "k3": 6, "k4": 8}
TERMS = ("k1", "k2", "p1", "p2", "k3", "k4")
# Limit of the search, in distances of the corner. Within its bounds the distortion moves nothing
# that far.
FARTHEST_UNDISTORTED = 4.0
FOLD_STEPS, FOLD_DIRECTIONS = 400, 32
ROW_BYTES = 1000  # about, of a calibration that waits


@dataclass
class CameraColumns:
    """The calibrations of a log."""

    rejects: RejectList
    _rows: list[CalibrationMessage] = field(default_factory=list)

    def add(self, batch: MessageBatch) -> None:
        """Take the valid calibrations; the others become rejects.

        A calibration without a time holds from the time it was logged at.
        """
        for calibration, offset, log_time_ns in batch.decoded(0, len(batch)):
            time_ns = calibration.time_ns or log_time_ns or None
            reason = fault(time_ns, calibration.sensor_id) or _camera_fault(calibration)
            if reason is None:
                self._rows.append(calibration._replace(time_ns=time_ns))
            else:
                self.rejects.add(
                    reason,
                    time_ns=time_ns or 0,
                    offset=offset,
                    sensor_id=known_id(calibration.sensor_id),
                )

    @property
    def n_bytes(self) -> int:
        """About the size of the rows that have not been taken."""
        return len(self._rows) * ROW_BYTES

    def take(self) -> pa.Table:
        """Return CAMERAS of the calibrations since the last call."""
        rows, self._rows = self._rows, []
        matrices = np.array([c.K for c in rows], float).reshape(-1, 9)
        distortion = np.array([_coefficients(c) for c in rows], float).reshape(-1, len(TERMS))
        return table(
            CAMERAS,
            {
                "sensor_id": [c.sensor_id for c in rows],
                "time": np.array([c.time_ns for c in rows], np.int64),
                "width": np.array([c.width for c in rows], np.int64),
                "height": np.array([c.height for c in rows], np.int64),
                "fx_px": matrices[:, 0],
                "fy_px": matrices[:, 4],
                "cx_px": matrices[:, 2],
                "cy_px": matrices[:, 5],
                **dict(zip(TERMS, distortion.T, strict=True)),
                "fisheye": [c.distortion_model in FISHEYE for c in rows],
                "line_time_s": np.array([c.line_time_s for c in rows], float),
                **unstack_covariance("cov_{}", np.zeros((len(rows), 9, 9)), OPTICS_AXES),
            },
        )


def _coefficients(calibration: CalibrationMessage) -> tuple[float, ...]:
    """Return the numbers of `TERMS`."""
    terms = FISHEYE_TERMS if calibration.distortion_model in FISHEYE else PINHOLE_TERMS
    given = dict(zip(terms, calibration.D.tolist(), strict=False))
    return tuple(given.get(name, 0.0) for name in TERMS)


def _camera_fault(calibration: CalibrationMessage) -> Reason | None:
    sides = (calibration.width, calibration.height)
    if any(side not in IMAGE_SIDE for side in sides):
        return IMAGE_SIDE.reason
    fisheye = calibration.distortion_model in FISHEYE
    if not fisheye and calibration.distortion_model not in PINHOLE:
        return Reason.UNKNOWN_DISTORTION_MODEL
    if (
        len(calibration.D) not in ((0, 4) if fisheye else (0, 4, 5))
        or not np.isfinite(calibration.D).all()
    ):
        return Reason.BAD_DISTORTION
    if calibration.line_time_s not in LINE_TIME:
        return LINE_TIME.reason
    if len(calibration.K) != 9:
        return Reason.BAD_CAMERA_MATRIX
    # A recorder may repeat one calibration with each frame.
    return _optics_fault(sides, tuple(calibration.K.tolist()), _coefficients(calibration), fisheye)


def optics_fault(
    sides: tuple[int, int], K: tuple[float, ...], D: tuple[float, ...], fisheye: bool,
    line_time_s: float,
) -> Reason | None:  # fmt: skip
    """Return why a log with these optics would be refused; None where it would not.

    Parameters
    ----------
    sides
        Width and height [px].
    K
        Camera matrix, row by row.
    D
        Distortion k1, k2, p1, p2, k3, k4.
    line_time_s
        Time from row to row.
    """
    if any(side not in IMAGE_SIDE for side in sides):
        return IMAGE_SIDE.reason
    if not np.isfinite(D).all():
        return Reason.BAD_DISTORTION
    if line_time_s not in LINE_TIME:
        return LINE_TIME.reason
    return _optics_fault(sides, K, D, fisheye)


@lru_cache(maxsize=256)
def _optics_fault(
    sides: tuple[int, int], K: tuple[float, ...], D: tuple[float, ...], fisheye: bool
) -> Reason | None:
    """Return what is wrong with the optics; D are the numbers of `TERMS`."""
    focal = K[0], abs(K[4])
    # The first focal length is positive: an image is mirrored by one negative length at most.
    if any(f not in FOCAL_LENGTH for f in focal) or focal[0] / focal[1] not in FOCAL_RATIO:
        return FOCAL_LENGTH.reason
    # The pipeline has no camera model with skew or scale. NaN is not within the scale either.
    zeros, scale = (K[1], K[3], K[6], K[7]), 1e-9 * K[0]
    if not all(abs(k) <= scale for k in zeros) or not abs(K[8] - 1.0) <= 1e-9:
        return Reason.BAD_CAMERA_MATRIX
    far = [
        max(abs(-0.5 - c), abs(side - 0.5 - c)) / f
        for side, c, f in zip(sides, (K[2], K[5]), focal, strict=True)
    ]
    corner = math.hypot(*far)
    if (math.tan(min(corner, 1.5)) if fisheye else corner) not in CORNER:
        return CORNER.reason
    powers = PINHOLE_TERMS | FISHEYE_TERMS
    if any(k * corner ** powers[name] not in DISTORTION for k, name in zip(D, TERMS, strict=True)):
        return DISTORTION.reason
    farthest = math.pi / 2 if fisheye else FARTHEST_UNDISTORTED * corner
    return Reason.FOLDED_IMAGE if any(D) and _folds(D, corner, max(far), farthest) else None


def _folds(D: tuple[float, ...], corner: float, side: float, farthest: float) -> bool:
    """Return whether the distortion folds the image before the end of its longer half axis.

    Along a ray from the boresight the distorted distance must grow until it reaches that of the
    corner, or has at least reached `side`: a wide lens shows nothing in the corners of its image.
    The derivative of the distorted position must keep its sign so far, whatever the direction.
    """
    k1, k2, p1, p2, k3, k4 = D
    r = np.linspace(0.0, farthest, FOLD_STEPS)
    r2 = r * r
    distorted = r * (1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))))
    beyond = np.flatnonzero(distorted >= corner)
    falls = np.flatnonzero(np.diff(distorted) <= 0)
    if len(beyond) and not (len(falls) and falls[0] < beyond[0]):
        last = beyond[0]
    elif len(falls) and distorted[falls[0]] >= side:
        last = np.flatnonzero(distorted >= side)[0]
    else:
        return True
    r2 = r2[: last + 1, None]
    angle = np.linspace(0.0, 2 * np.pi, FOLD_DIRECTIONS, endpoint=False)
    x, y = np.sqrt(r2) * np.cos(angle), np.sqrt(r2) * np.sin(angle)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = 2 * k1 + r2 * (4 * k2 + r2 * (6 * k3 + r2 * 8 * k4))
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return bool((xx + yy <= 0).any() or (xx * yy - xy * xy <= 0).any())
