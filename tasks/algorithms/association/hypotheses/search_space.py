"""Search space: the input that all hypotheses of a search share, and their work arrays."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.chance import Chance
from epipole.tasks.algorithms.association.evidence.points import InstantPoints
from epipole.tasks.algorithms.association.sampling.views import Views
from epipole.tasks.algorithms.kernels import kernel

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

RESIDUAL_PARTS = 11  # of `views.residual`
PREDICTED_COLUMNS = 10  # of `candidates`


class SearchSpace(NamedTuple):
    """The tracklets that are searched, and the limits of the search.

    views, chance
        The tracklets, and how unrelated ones behave.
    taken : (t,) bool
        Tracklets of known objects: no new hypothesis may use them.
    shells : (j, 3) float
        Altitude prior, rows of (lowest, highest radius [km], weight); no rows: uniform.
    lowest_km, farthest_km : float
        Distances from the Earth's centre between which objects are sought.
    gate_sigma : float
        Views of one object agree within this (as a chi-square of the same probability).
    """

    views: Views
    chance: Chance
    taken: Flags
    shells: Array
    lowest_km: float
    farthest_km: float
    gate_sigma: float


class WorkSpace(NamedTuple):
    """Arrays that the kernels fill for the hypothesis at hand.

    points
        Its points.
    part : (11,) float
        Residual of one view, see `views.residual`.
    predicted : (k, 10) float
        Predictions for one sensor, see `candidates`.
    near : (s,) bool
        Sensors whose field may hold the points, see `visibility.near_fields`.
    """

    points: InstantPoints
    part: Array
    predicted: Array
    near: Flags


@kernel
def work_space(k, n_sensors):
    """Return a `WorkSpace` for k instants, without points."""
    points = InstantPoints(
        np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 3)), np.zeros(k, np.int64)
    )
    return WorkSpace(
        points,
        np.empty(RESIDUAL_PARTS),
        np.empty((k, PREDICTED_COLUMNS)),
        np.empty(n_sensors, np.bool_),
    )
