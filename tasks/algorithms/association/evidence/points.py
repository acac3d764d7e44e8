"""Points: where the object of a hypothesis is at each instant."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class InstantPoints(NamedTuple):
    """One point for each of k instants, solved where at least two tracklets have a direction.

    x_km : (k, 3) float
        Positions, GCRF.
    normal, cov_km2 : (k, 3, 3) float
        Normal equations (the upper half is filled) and their inverse, the covariance.
    seen_by : (k,) int
        How many tracklets have a direction at the instant. Below 2 there is no point.
    """

    x_km: Array
    normal: Array
    cov_km2: Array
    seen_by: Indices
