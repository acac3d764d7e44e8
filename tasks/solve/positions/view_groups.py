"""Views grouped by object and epoch, and the solution of each group."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.light_time import apparent_places

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class ViewGroups(NamedTuple):
    """Views grouped by epoch and object, and the solution of each group."""

    views: pa.Table
    offsets: Indices
    object_id: npt.NDArray[np.object_]
    epoch_ns: Indices
    u: Array
    r_km: Array
    cov: Array
    x_km: Array
    cov_km2: Array
    chi2: Array
    used: npt.NDArray[np.bool_]
    mean_range_km: Array
    velocity_km_s: Array
    independent: npt.NDArray[np.bool_]

    @property
    def apparent_km(self) -> Array:
        """Where each view's sensor sees the object: its light left at a time of its own."""
        group = self.group
        light_s = self.mean_range_km / SPEED_OF_LIGHT_KM_S
        return apparent_places(
            self.x_km[group], self.velocity_km_s[group], light_s[group], self.r_km
        )

    @property
    def group(self) -> Indices:
        """Group of each view."""
        return np.repeat(np.arange(len(self.epoch_ns)), np.diff(self.offsets))
