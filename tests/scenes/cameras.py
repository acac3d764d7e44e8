"""CAMERAS of sensors, as their logs tell them."""

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import table, unstack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera


def cameras_of(optics: dict[str, Camera], cov: np.ndarray | None = None) -> pa.Table:
    """Return a row per sensor; `cov` (9, 9) is the covariance of the optics, default 0."""
    n = len(optics)
    covs = np.tile(np.zeros((9, 9)) if cov is None else cov, (n, 1, 1))
    values = {name: [getattr(c, name) for c in optics.values()] for name in Camera._fields}
    key = {"sensor_id": list(optics), "time": [1] * n}
    return table(CAMERAS, key | values | unstack_covariance("cov_{}", covs, OPTICS_AXES))
