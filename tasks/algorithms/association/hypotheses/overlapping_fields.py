"""Partners: with which others a sensor may find objects."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.hypotheses.field_index import (
    AXIS,
    FEW_SENSORS,
    TANGENT,
    FieldIndex,
    ground_range,
)
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAREST_STEP_KM, N_STEPS = 20.0, 64  # along a field, to see whether it meets another one
TESTED_INSTANTS = 3
LEADERS = 8  # sensors of a crowded cell that all others are paired with
MOST_PARTNERS = 64  # of a sensor; half of them are leaders of crowded cells
MOST_TESTS = 512  # of whether two fields meet, for each sensor


def meeting_pairs(index: FieldIndex, cones: Array, farthest_km: float) -> tuple[Indices, Indices]:
    """Return pairs of sensors whose fields meet, each once; the first has the lower number.

    Up to `FEW_SENSORS` sensors: all pairs. Else those that share a cell; each sensor looks for a
    limited number of partners. First among the leaders of its most crowded cells, the same for all
    sensors there, so that few pairs cover the place. Then in its cells from the emptiest on, where
    it may be one of the few that see an object.
    """
    n = len(cones)
    if index.size == 0.0:
        a, b = np.triu_indices(n, 1)
        meet = fields_meet(cones, a, b, farthest_km)
        return a[meet], b[meet]
    # Leaders at random, so that they are all around: they have long baselines with some others.
    rank = np.random.default_rng(n).permutation(n)
    pairs = _partners(index, rank, *_tested(cones, farthest_km))
    key = np.unique(pairs.min(axis=1) * n + pairs.max(axis=1))
    return key // n, key % n


def fields_meet(cones: Array, a: Indices, b: Indices, farthest_km: float) -> npt.NDArray[np.bool_]:
    """Return whether the fields of two sensors share any place, (n,).

    At some instants, the axis of sensor a's cone is stepped through. A ball about each step holds
    the cone up to the next one. The test is whether the ball touches the cone of b. Cones end at
    the ground. It may say yes too often, never no where the fields meet.

    Parameters
    ----------
    cones : (s, k, 7) float
        The fields, see `field_index.cones_of`.
    a, b : (n,) int
        Pairs of sensors.
    """
    return np.asarray(_meet_all(*_tested(cones, farthest_km), a, b))


def _tested(cones: Array, farthest_km: float) -> tuple[Array, Array]:
    """Return the cones at the tested instants, and the steps along them [km]."""
    tested = np.unique(np.linspace(0, cones.shape[1] - 1, TESTED_INSTANTS).astype(int))
    return np.ascontiguousarray(cones[:, tested]), np.geomspace(
        NEAREST_STEP_KM, farthest_km, N_STEPS
    )


@kernel
def _meet_all(cones, steps, a, b):
    meet = np.zeros(len(a), np.bool_)
    for k in range(len(a)):
        meet[k] = _meet(cones, steps, a[k], b[k])
    return meet


@borrowing_kernel
def _meet(cones, steps, a, b):
    """Return whether the fields of two sensors meet, see `fields_meet`."""
    step = steps[1] / steps[0]
    for m in range(cones.shape[1]):
        if not (cones[a, m, TANGENT] > 0.0 and cones[b, m, TANGENT] > 0.0):
            continue
        tangent, half_b = cones[a, m, TANGENT] + (step - 1) / 2, np.arctan(cones[b, m, TANGENT])
        ends_a = ground_range(cones[a, m, :AXIS], cones[a, m, AXIS:TANGENT],
                              np.arctan(cones[a, m, TANGENT]))  # fmt: skip
        ends_b = ground_range(cones[b, m, :AXIS], cones[b, m, AXIS:TANGENT], half_b)
        for rho in steps:
            if rho > step * ends_a:
                break
            along, length2 = 0.0, 0.0
            for q in range(AXIS):
                d = cones[a, m, q] - cones[b, m, q] + rho * cones[a, m, AXIS + q]
                along += d * cones[b, m, AXIS + q]
                length2 += d * d
            distance, ball = np.sqrt(length2), rho * tangent
            if distance - ball > ends_b:
                continue
            if distance <= ball:
                return True
            off_axis = np.arccos(min(max(along / distance, -1.0), 1.0))
            if off_axis <= half_b + np.arcsin(min(ball / distance, 1.0)):
                return True
    return False


@kernel
def _partners(index, rank, cones, steps):
    """Return pairs of sensors, (n, 2); some of them twice."""
    n_sensors, n_cells = len(index.own_first) - 1, len(index.first) - 1
    leader, occupied = _leaders(index, rank), np.empty(n_cells, np.int64)
    for q in range(n_cells):
        occupied[q] = index.first[q + 1] - index.first[q]
    out = np.empty((MOST_PARTNERS * n_sensors, 2), np.int64)
    tested = np.full(n_sensors, -1)  # the sensor that was last tested with each one
    n = 0
    for s in range(n_sensors):
        own = index.own_cell[index.own_first[s] : index.own_first[s + 1]]
        order = np.argsort(occupied[own], kind="mergesort")
        tested[s], count, tests = s, 0, 0
        for turn in range(2 * len(own)):
            crowded = turn < len(own)
            q = own[order[len(own) - 1 - turn]] if crowded else own[order[turn - len(own)]]
            if crowded and occupied[q] <= FEW_SENSORS + 1:
                continue
            some = leader[q] if crowded else index.sensor[index.first[q] : index.first[q + 1]]
            most = MOST_PARTNERS // 2 if crowded else MOST_PARTNERS
            for k in range(len(some)):
                o = some[(k + s) % len(some)]  # other sensors begin with other partners
                if count >= most or tests >= MOST_TESTS:
                    break
                if tested[o] == s:
                    continue
                tested[o] = s
                tests += 1
                if _meet(cones, steps, s, o):
                    out[n, 0], out[n, 1] = s, o
                    n += 1
                    count += 1
    return out[:n]


@kernel
def _leaders(index, rank):
    """Return the sensors of the lowest rank in each crowded cell, (c, 8); -1 elsewhere."""
    leader = np.full((len(index.first) - 1, LEADERS), -1)
    for q in range(len(leader)):
        if index.first[q + 1] - index.first[q] <= FEW_SENSORS + 1:
            continue
        for s in index.sensor[index.first[q] : index.first[q + 1]]:
            moved = s
            for k in range(LEADERS):
                if leader[q, k] < 0:
                    leader[q, k] = moved
                    break
                if rank[moved] < rank[leader[q, k]]:
                    leader[q, k], moved = moved, leader[q, k]
    return leader
