"""Sensor pairs: which pairs of sensors provide seeds, and in which order.

1. `meeting_pairs` finds the sensors whose fields overlap. In crowded space each sensor is paired
   with a limited number of others.
2. `passing_pairs` finds those of which two tracklets' lines of sight pass near each other, of any
   number of sensors with few tracklets each: all round the Earth, thousands of fields overlap.
3. `SensorPairs` puts the longest baselines first, and skips a pair where earlier pairs cover all
   the space that it shares. With few sensors, `EveryPair` takes all of them.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.search.field_index import (
    AXIS,
    FEW_SENSORS,
    TANGENT,
    FieldIndex,
    cell_at,
    ground_range,
)
from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.association.search.seeds import SHORTEST_BASELINE_KM
from epipole.tasks.algorithms.association.search.shared_points import (
    MIDDLE_SHARE,
    FieldMiddles,
    edge_points,
    field_middles,
    middle_points,
)
from epipole.tasks.algorithms.association.search.sight_lines import nearest_ranges
from epipole.tasks.algorithms.association.views import (
    SIGMA_KM,
    XX,
    YY,
    Views,
    direction,
)
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

NEAREST_STEP_KM, N_STEPS = 20.0, 64  # along a cone, to test whether it meets another one
MAX_TESTED_INSTANTS = 8  # of the instants at which both sensors have tracklets
N_LEADERS = 8  # sensors of a crowded cell with which all others there are paired
MAX_OVERLAPPING = 64  # maximum number of others that a sensor is paired with, half of them leaders
MAX_TESTS = 512  # maximum number of tests per sensor of whether two fields overlap
FEW_TRACKLETS = 8  # of a sensor in a window: seeding with no more costs next to nothing
# Lines of sight pass near each other if their gap is within the sum of this angle, this distance,
# and this number of sigmas. Lines to one object miss by far less; few other lines pass so near.
PASSING_RAD, PASSING_KM, PASSING_SIGMA = 5e-3, 20.0, 5.0
N_EDGES = 8  # outermost tracklets of a sensor, one for each of these directions on its plane


def meeting_pairs(index: FieldIndex, cones: Array, farthest_km: float) -> tuple[Indices, Indices]:
    """Return pairs of sensors whose fields meet, each once; the first has the lower number.

    Up to `FEW_SENSORS` sensors, all pairs are tested. Beyond, each sensor is paired with at most
    `MAX_OVERLAPPING` others that share a cell with it: first with the leaders of its most crowded
    cells, which are the same for all sensors there, so that few pairs cover the space; then with
    sensors in its emptiest cells, where it may be one of the few that see an object.
    """
    n = len(cones)
    if index.size == 0.0:
        a, b = np.triu_indices(n, 1)
        meet = fields_meet(cones, a, b, farthest_km)
        return a[meet], b[meet]
    # Leaders at random, so that they are all around: they have long baselines with some others.
    rank = np.random.default_rng(n).permutation(n)
    pairs = _overlapping_pairs(index, rank, cones, _steps_along(farthest_km))
    key = np.unique(pairs.min(axis=1) * n + pairs.max(axis=1))
    return key // n, key % n


def fields_meet(cones: Array, a: Indices, b: Indices, farthest_km: float) -> Flags:
    """Return whether the fields of two sensors overlap anywhere, (n,) bool.

    At some of the instants at which both have tracklets, the axis of sensor a's cone is followed in
    steps. A ball about each step encloses the cone half-way to the next steps, and is tested for
    contact with the cone of b. Cones end at the ground. The result may be true if the fields do not
    overlap. It is not false if they overlap at a tested instant, at ranges from sensor a that
    exceed `NEAREST_STEP_KM`.

    Parameters
    ----------
    cones : (s, k, 7) float
        The fields, see `field_index.cones_of`.
    a, b : (n,) int
        Pairs of sensors.
    """
    return np.asarray(_meet_all(cones, _steps_along(farthest_km), a, b))


def _steps_along(farthest_km: float) -> Array:
    """Return the steps along a cone [km]."""
    return np.geomspace(NEAREST_STEP_KM, farthest_km, N_STEPS)


@kernel
def _meet_all(cones, steps, a, b):
    """Return `_meet` of each pair of sensors a (n,) and b (n,), (n,) bool."""
    meet = np.zeros(len(a), np.bool_)
    for k in range(len(a)):
        meet[k] = _meet(cones, steps, a[k], b[k])
    return meet


@borrowing_kernel
def _meet(cones, steps, a, b):
    """Return whether the fields of two sensors meet, see `fields_meet`.

    `cones` (s, k, 7) as there; `steps` (n,) [km] along the cone of sensor a grow by a fixed ratio.
    """
    ratio, common = steps[1] / steps[0], 0
    for m in range(cones.shape[1]):
        common += cones[a, m, TANGENT] > 0.0 and cones[b, m, TANGENT] > 0.0
    # Evenly spread over the common instants, first and last included.
    passed, tested, n_tested = 0, 0, min(common, MAX_TESTED_INSTANTS)
    for m in range(cones.shape[1]):
        if not (cones[a, m, TANGENT] > 0.0 and cones[b, m, TANGENT] > 0.0):
            continue
        passed += 1
        if (passed - 1) * (n_tested - 1) < tested * (common - 1):
            continue
        tested += 1
        # The ball about a step, over the range: the cone's radius and half the way to the next.
        tangent, half_b = cones[a, m, TANGENT] + (ratio - 1) / 2, np.arctan(cones[b, m, TANGENT])
        ends_a = ground_range(cones[a, m, :AXIS], cones[a, m, AXIS:TANGENT],
                              np.arctan(cones[a, m, TANGENT]))  # fmt: skip
        ends_b = ground_range(cones[b, m, :AXIS], cones[b, m, AXIS:TANGENT], half_b)
        for rho in steps:
            if rho > ratio * ends_a:
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
def _overlapping_pairs(index, rank, cones, steps):
    """Return the pairs of `meeting_pairs` among many sensors, (n, 2); some of them twice.

    `cones` (s, k, 7) and `steps` (j,) [km] are for `_meet`, `rank` (s,) for `_leaders`.
    """
    n_sensors, n_cells = len(index.by_sensor_first) - 1, len(index.first) - 1
    leader, occupied = _leaders(index, rank), np.empty(n_cells, np.int64)
    for q in range(n_cells):
        occupied[q] = index.first[q + 1] - index.first[q]
    out = np.empty((MAX_OVERLAPPING * n_sensors, 2), np.int64)
    tested = np.full(n_sensors, -1)  # the sensor that was last tested with each one
    n = 0
    for s in range(n_sensors):
        cells = index.by_sensor_cell[index.by_sensor_first[s] : index.by_sensor_first[s + 1]]
        order = np.argsort(occupied[cells], kind="mergesort")
        tested[s], count, tests = s, 0, 0
        # First the crowded cells, from the fullest on; then all, from the emptiest on.
        for turn in range(2 * len(cells)):
            crowded = turn < len(cells)
            q = cells[order[len(cells) - 1 - turn]] if crowded else cells[order[turn - len(cells)]]
            if crowded and occupied[q] <= FEW_SENSORS + 1:
                continue
            some = leader[q] if crowded else index.sensor[index.first[q] : index.first[q + 1]]
            max_count = MAX_OVERLAPPING // 2 if crowded else MAX_OVERLAPPING
            for k in range(len(some)):
                o = some[(k + s) % len(some)]  # each sensor begins elsewhere
                if count >= max_count or tests >= MAX_TESTS:
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
    """Return the `N_LEADERS` sensors with the lowest ranks in each crowded cell; -1 in others.

    They are (c, N_LEADERS) int, by rank. `rank` (s,) int is the rank of each sensor.
    """
    leader = np.full((len(index.first) - 1, N_LEADERS), -1)
    for q in range(len(leader)):
        if index.first[q + 1] - index.first[q] <= FEW_SENSORS + 1:
            continue
        for s in index.sensor[index.first[q] : index.first[q + 1]]:
            moved = s
            for k in range(N_LEADERS):
                if leader[q, k] < 0:
                    leader[q, k] = moved
                    break
                if rank[moved] < rank[leader[q, k]]:
                    leader[q, k], moved = moved, leader[q, k]
    return leader


# Pairs of sensors with few tracklets


def passing_pairs(views: Views, sparse: Flags, farthest_km: float) -> tuple[Indices, Indices]:
    """Return pairs of sensors of which two tracklets' lines of sight pass near each other.

    Each pair once; the first has the lower number. Only `sparse` sensors (s,) take part: lines of
    sight are compared each with each.
    """
    a, b = np.unique(_passing(views, sparse, farthest_km), axis=0).T
    return a, b


def _merged_pairs(
    one: tuple[Indices, Indices], other: tuple[Indices, Indices], n_sensors: int
) -> tuple[Indices, Indices]:
    """Return the pairs of both, in order."""
    key = np.union1d(*(a * n_sensors + b for a, b in (one, other)))
    return key // n_sensors, key % n_sensors


@kernel
def _passing(views, sparse, farthest_km):
    """Return pairs of sensors, (n, 2); some of them twice. Arguments as in `passing_pairs`."""
    n_tracklets, n = len(views.sensor), 0
    row, u = np.empty(n_tracklets, np.int64), np.empty((n_tracklets, 3))
    sigma, out = np.empty((n_tracklets, 2)), np.empty((64, 2), np.int64)
    for m in range(len(views.time_s)):
        count = 0
        for i in range(n_tracklets):
            if sparse[views.sensor[i]] and views.seen[i, m]:
                direction(views, i, m, u[count])
                row[count], sigma[count, 1] = i, views.sight[i, m, SIGMA_KM]
                sigma[count, 0] = np.sqrt(views.sight[i, m, XX] + views.sight[i, m, YY])
                count += 1
        for p in range(count):
            i = row[p]
            for q in range(p + 1, count):
                j, a, b = row[q], views.sensor[i], views.sensor[row[q]]
                if a == b or (m > 0 and views.seen[i, m - 1] and views.seen[j, m - 1]):
                    continue  # they were compared at the instant before
                rad = PASSING_RAD + PASSING_SIGMA * (sigma[p, 0] + sigma[q, 0])
                km = PASSING_KM + PASSING_SIGMA * (sigma[p, 1] + sigma[q, 1])
                if not _pass_near(
                    views.camera[a, m], u[p], views.camera[b, m], u[q], rad, km, farthest_km
                ):
                    continue
                if n == len(out):
                    out = doubled(out, n)
                out[n, 0], out[n, 1] = a, b
                n += 1
    return out[:n]


@borrowing_kernel
def _pass_near(camera_a, u_a, camera_b, u_b, rad, km, farthest_km):
    """Return whether two lines of sight pass within some angle and distance, above the ground.

    Nearly parallel lines always do; nearly opposite ones never. `camera_a` and `camera_b` (34,) are
    rows of `Views.camera`, of which the positions are read [km]; `u_a` and `u_b` (3,) are unit
    vectors, ICRS. `rad` [rad] and `km` [km] together limit the gap.
    """
    cosine, range_a, range_b = nearest_ranges(camera_a, u_a, camera_b, u_b)
    if 1.0 - cosine * cosine < 4.0 * rad * rad:
        return cosine > 0.0
    if not (0.0 < range_a < farthest_km and 0.0 < range_b < farthest_km):  # false for NaN
        return False
    gap2, radius2 = 0.0, 0.0
    for k in range(3):
        at_a, at_b = camera_a[k] + range_a * u_a[k], camera_b[k] + range_b * u_b[k]
        gap2 += (at_b - at_a) ** 2
        radius2 += at_a * at_a
    allowed = rad * max(range_a, range_b) + km
    return gap2 < allowed * allowed and radius2 > EARTH_RADIUS_KM**2


# Order of the pairs


def sparse_sensors(views: Views) -> Flags:
    """Return which sensors have few tracklets, (s,)."""
    return np.asarray(np.diff(views.first) <= FEW_TRACKLETS)


class EveryPair:
    """All pairs of sensors whose fields meet: among few sensors, only two may see an object."""

    def __init__(self, index: FieldIndex, cones: Array, farthest_km: float) -> None:
        a, b = meeting_pairs(index, cones, farthest_km)
        self._pairs = zip(a.tolist(), b.tolist(), strict=True)

    def next(self, enough: float = np.inf) -> tuple[int, int] | None:
        """Return the next pair, None after the last; no pair is skipped, whatever `enough` is."""
        return next(self._pairs, None)


class RankedPairs(NamedTuple):
    """The n pairs of sensors that may seed, the longest baseline first, with p points each.

    a, b : (n,) int
        The sensors.
    always : (n,) bool
        It seeds even where others cover its points.
    points : (n, p, 3) float
        Points [km], GCRF, of the space that both share; NaN where there is no such point.
    share : (n,) float
        A pair that seeds covers these points within this part of its fields' half-angles.
    waiting : (n,) bool, changed
        It has not seeded yet.
    covered : (n, p) int, changed
        How many pairs that have seeded cover each point; without a point the largest number.
    """

    a: Indices
    b: Indices
    always: Flags
    points: Array
    share: Array
    waiting: Flags
    covered: Indices


class PointsByCell(NamedTuple):
    """The points of `RankedPairs` by the cells of a `FieldIndex`.

    first, point : (c + 1,), (n p,) int
        Points of cell q are ``point[first[q]:first[q + 1]]``. Point c of pair k is number k p + c.
    """

    first: Indices
    point: Indices


class SensorPairs:
    """Pairs of sensors that may see one object, in the order in which they should seed.

    Pairs with a longer baseline across the line of sight come first: they fix a point better and
    give fewer false seeds. But they come in rounds, and no sensor takes part twice in a round.
    Pairs whose fields do not overlap are skipped. In crowded space each sensor is paired with a few
    only, see `meeting_pairs`.

    Two sensors with few tracklets always seed: that costs little, and only these two may have seen
    a passage of seconds.
    """

    def __init__(self, views: Views, farthest_km: float, index: FieldIndex, cones: Array) -> None:
        fields, n_sensors = field_middles(views, N_EDGES), len(views.camera)
        a, b = meeting_pairs(index, cones, farthest_km)
        crowded = np.bincount(np.append(a, b), minlength=n_sensors) > FEW_SENSORS
        sparse = sparse_sensors(views)
        dense = ~(sparse[a] & sparse[b])
        passing = passing_pairs(views, sparse, farthest_km)
        a, b = _merged_pairs((a[dense], b[dense]), passing, n_sensors)
        a, b = _longest_first(fields, a, b)
        self._index, self._fields = index, fields
        self.ranked = _ranked_pairs(fields, crowded, sparse, a, b, farthest_km)
        self._by_cell = _points_by_cell(index, self.ranked.points)
        self._busy = np.zeros(n_sensors, bool)  # sensors that have taken part in this round
        self._next = 0  # the pair at which the search for the next one begins

    def next(self, enough: float = np.inf) -> tuple[int, int] | None:
        """Return the next pair, None after the last.

        A pair is skipped where `enough` of the earlier pairs cover each point that it shares.
        These points are in the middle of the shared space and, if it is not crowded, at its edges.
        """
        pairs = self.ranked
        k = _next_pair(pairs, self._busy, float(enough), self._next)
        if k < 0:
            self._busy[:] = False
            k = _next_pair(pairs, self._busy, float(enough), 0)
            if k < 0:
                self._next = 0
                return None
        a, b = int(pairs.a[k]), int(pairs.b[k])
        pairs.waiting[k] = False
        self._busy[[a, b]] = True
        self._next = k + 1
        _cover(self._index, a, b, self._fields, self._by_cell, pairs)
        return a, b


def _longest_first(fields: FieldMiddles, a: Indices, b: Indices) -> tuple[Indices, Indices]:
    """Return the pairs of sensors a (n,) and b (n,), those with the longest baseline across the
    line of sight first, without those whose baseline is too short or unknown."""
    baseline = fields.position[b] - fields.position[a]
    known = np.linalg.norm(baseline, axis=1) > SHORTEST_BASELINE_KM  # false for NaN
    across = np.linalg.norm(np.cross(baseline, fields.look[a] + fields.look[b]), axis=1) / 2
    order = np.flatnonzero(known)[np.argsort(-across[known], kind="stable")]
    return a[order], b[order]


def _ranked_pairs(
    fields: FieldMiddles,
    crowded: Flags,
    sparse: Flags,
    a: Indices,
    b: Indices,
    farthest_km: float,
) -> RankedPairs:
    """Return the pairs of a (n,) and b (n,), in their order, with the points that they share.

    There is one in the middle of the shared space. Others are at its edges, if neither sensor is
    `crowded` (s,). Pairs of two `sparse` sensors (s,) always seed.
    """
    roomy = ~crowded[a] & ~crowded[b]
    points = np.full((len(a), 1 + N_EDGES, 3), np.nan)
    points[:, 0] = middle_points(fields, crowded, a, b, farthest_km)
    points[roomy, 1:] = edge_points(fields, a[roomy], b[roomy], farthest_km)
    return RankedPairs(
        a,
        b,
        always=sparse[a] & sparse[b],
        points=points,
        share=np.where(roomy, 1.0, MIDDLE_SHARE),
        waiting=np.ones(len(a), bool),
        covered=np.where(np.isfinite(points[..., 0]), 0, np.iinfo(np.int64).max),
    )


def _points_by_cell(index: FieldIndex, points: Array) -> PointsByCell:
    """Return the points (n, p, 3) [km] of pairs by cells; those in no cell come first."""
    cell = _cells_of(index, points)
    point = np.argsort(cell, axis=None, kind="stable")
    first = np.searchsorted(cell.ravel()[point], np.arange(len(index.first)))
    return PointsByCell(first, point)


@borrowing_kernel
def _next_pair(pairs, busy, enough, begin):
    """Return the first pair from `begin` on that should seed, its sensors not busy, or -1.

    Of the `RankedPairs` that are waiting, one seeds if it always does, or if one of its points is
    covered by fewer than `enough` earlier pairs. `busy` (s,) bool flags sensors that have seeded in
    this round.
    """
    a, b, covered = pairs.a, pairs.b, pairs.covered
    for k in range(begin, len(a)):
        if pairs.waiting[k] and not busy[a[k]] and not busy[b[k]]:
            if pairs.always[k]:
                return k
            for c in range(covered.shape[1]):
                if covered[k, c] < enough:
                    return k
    return -1


@kernel
def _cover(index, a, b, fields, by_cell, pairs):
    """Count the pair of sensors a and b in `pairs.covered`, for all points in both their fields.

    `index` is the `FieldIndex`, `fields` the `FieldMiddles`, `by_cell` the `PointsByCell` of
    `pairs`, which are `RankedPairs`.
    """
    look, position, half, _ = fields
    first, points, n_points = by_cell.first, pairs.points, pairs.points.shape[1]
    i, j = index.by_sensor_first[a], index.by_sensor_first[b]
    while i < index.by_sensor_first[a + 1] and j < index.by_sensor_first[b + 1]:
        p, q = index.by_sensor_cell[i], index.by_sensor_cell[j]
        if p == q:
            for number in by_cell.point[first[p] : first[p + 1]]:
                k, c = number // n_points, number % n_points
                x, share = points[k, c], pairs.share[k]
                if _in_cone(x, look[a], position[a], share * half[a]) and _in_cone(
                    x, look[b], position[b], share * half[b]
                ):
                    pairs.covered[k, c] += 1
        i += p <= q
        j += q <= p


@borrowing_kernel
def _in_cone(x, look, position, half):
    """Return whether x (3,) [km] is within `half` [rad] of the axis `look` from `position`."""
    along, length2 = 0.0, 0.0
    for q in range(3):
        d = x[q] - position[q]
        along += d * look[q]
        length2 += d * d
    return along > np.cos(half) * np.sqrt(length2)


@kernel
def _cells_of(index, points):
    """Return the cell of each point (n, p, 3) [km], (n, p); -1 for NaN."""
    out = np.full(points.shape[:2], -1)
    for k in range(out.shape[0]):
        for c in range(out.shape[1]):
            if np.isfinite(points[k, c, 0]):
                out[k, c] = cell_at(index, points[k, c])
    return out
