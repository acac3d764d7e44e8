"""Search space: what all hypotheses of a search share, and the work arrays of one hypothesis.

`likelihood` makes a `SearchSpace` for each window; the kernels of `growth`, `candidates`,
`merge_hypotheses` and `resolve_conflicts` take it with a `WorkSpace`.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.chance import Chance
from epipole.tasks.algorithms.association.samples import InstantPoints
from epipole.tasks.algorithms.association.search.field_index import FieldIndex
from epipole.tasks.algorithms.association.views import Views
from epipole.tasks.algorithms.kernels import kernel

RESIDUAL_PARTS = 14  # of `views.residual`, and the right-hand side of `instant_points`
PREDICTED_COLUMNS = 10  # of `candidates`


class SearchSpace(NamedTuple):
    """The tracklets that are searched, and the limits of the search.

    views, chance
        The tracklets, and the behaviour of unrelated ones.
    taken : (t,) bool
        Tracklets of known objects: no new hypothesis may use them.
    shells : (j, 3) float
        Altitude prior, rows of (lowest, highest radius [km], weight); no rows: uniform.
    lowest_km, farthest_km : float
        Distances from the Earth's centre between which objects are sought.
    gate_sigma : float
        Views of one object agree within this (as a chi-square of the same probability).
    fields
        The sensors whose fields share space.
    """

    views: Views
    chance: Chance
    taken: Flags
    shells: Array
    lowest_km: float
    farthest_km: float
    gate_sigma: float
    fields: FieldIndex


class WorkSpace(NamedTuple):
    """Arrays that the kernels fill for the hypothesis at hand.

    points
        Its points.
    part : (14,) float
        Residual of one view, see `views.residual`, and right-hand side, see `instant_points`.
    predicted : (k, 10) float
        Predictions for one sensor, see `candidates`.
    nearby, near, missed : (s,) int
        Lists of sensors: those that share space with two sensors, of these the ones whose field
        may hold the points, and of these the ones that miss the object. The first ones count.
    reviewed : (s,) int
        Sensors whose members are chosen again, see `growth`. The first ones count.
    stamp : (s + 1,) int
        Which sensors are in a list, by the number of the list; the last one counts the lists.
    same_sensor : (c,) int
        Tracklets of one sensor among the members, see `candidates.best_of_sensor`.
    members, before, member_chi2 : (t + 2,) int, int, float
        Members, those before a review, and the mean chi-square of their residuals.
    """

    points: InstantPoints
    part: Array
    predicted: Array
    nearby: Indices
    near: Indices
    missed: Indices
    reviewed: Indices
    stamp: Indices
    same_sensor: Indices
    members: Indices
    before: Indices
    member_chi2: Array


def work_space(views: Views) -> WorkSpace:
    """Return a `WorkSpace` without points."""
    k, n_sensors, n = len(views.time_s), len(views.camera), len(views.sensor)
    return WorkSpace(
        points=InstantPoints(
            np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 3)), np.zeros(k, np.int64)
        ),
        part=np.empty(RESIDUAL_PARTS),
        predicted=np.empty((k, PREDICTED_COLUMNS)),
        nearby=np.empty(n_sensors, np.int64),
        near=np.empty(n_sensors, np.int64),
        missed=np.empty(n_sensors, np.int64),
        reviewed=np.empty(n_sensors, np.int64),
        stamp=np.zeros(n_sensors + 1, np.int64),
        same_sensor=np.empty(int(np.diff(views.first).max(initial=0)) + 1, np.int64),
        members=np.empty(n + 2, np.int64),
        before=np.empty(n + 2, np.int64),
        member_chi2=np.empty(n + 2),
    )


@kernel
def doubled(values, n):
    """Return an array twice as long as `values` (m, ...), with the same first n rows."""
    out = np.empty((2 * len(values), *values.shape[1:]), values.dtype)
    out[:n] = values[:n]
    return out
