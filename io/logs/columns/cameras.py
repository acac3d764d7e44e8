"""The calibrations of a log as CAMERAS."""

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from epipole.io.logs.damage import RejectList
from epipole.io.logs.messages.batches import MessageBatch, fault, known_id
from epipole.io.logs.messages.decoded import CalibrationMessage
from epipole.schemas.bridge import table, unstack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import CAMERAS


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

    def take(self) -> pa.Table:
        """Return CAMERAS of the calibrations since the last call."""
        rows, self._rows = self._rows, []
        matrices = np.array([c.K for c in rows], float).reshape(-1, 9)
        distortion = np.zeros((len(rows), 5))
        for i, c in enumerate(rows):
            distortion[i, : len(c.D)] = c.D
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
                **dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion.T, strict=True)),
                **unstack_covariance("cov_{}", np.zeros((len(rows), 9, 9)), OPTICS_AXES),
            },
        )


def _camera_fault(calibration: CalibrationMessage) -> Reason | None:
    if calibration.width <= 0 or calibration.height <= 0:
        return Reason.BAD_IMAGE_SIZE
    if calibration.distortion_model not in ("", "plumb_bob"):
        return Reason.UNKNOWN_DISTORTION_MODEL
    if len(calibration.D) not in (0, 4, 5) or not np.isfinite(calibration.D).all():
        return Reason.BAD_DISTORTION
    K = calibration.K
    if len(K) != 9 or not np.isfinite(K).all() or K[0] <= 0 or K[4] == 0:
        return Reason.BAD_CAMERA_MATRIX
    # The pipeline has no camera model with skew or scale.
    zeros, scale = (K[1], K[3], K[6], K[7]), 1e-9 * K[0]
    if any(abs(k) > scale for k in zeros) or abs(K[8] - 1.0) > 1e-9:
        return Reason.BAD_CAMERA_MATRIX
    return None
