"""Seeds: pairs of tracklets whose lines of sight meet, found by sorting one angle.

The baseline of two sensors and a direction span a plane. The angle of this plane about the
baseline is one number for each direction, and equal for both sensors' views of one object. With
the angles sorted, a binary search gives the partners of a view, and pairs that cannot meet
cost nothing.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.hypotheses.search_space import SearchSpace
from epipole.tasks.algorithms.association.hypotheses.sight_lines import pair_miss, quantile
from epipole.tasks.algorithms.association.sampling.views import MOVES, SIGMA_KM, XX, YY, Views
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.sky import tangent_basis
from epipole.tasks.algorithms.kernels import kernel

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SHORTEST_BASELINE_KM = 1.0
NEAREST_KM = 300.0  # range at which errors of the baseline turn the plane most
FASTEST_KM_S = 11.0  # of an object near the Earth, which moves while light travels
LARGEST_SIGMA = 3.0  # the most that it can move counts as an error of this many sigmas
MOST_WITH_EDGES = 32  # sensors: with more, looking at the edges of the fields costs too much
NEAREST_STEP_KM, N_STEPS = 20.0, 64  # along a field, to see whether it meets another one
TESTED_INSTANTS = 3
N_EDGES = 8  # outermost tracklets of a sensor, one for each of the ways on its plane


class PlaneAngles(NamedTuple):
    """Tracklets of one sensor at one instant, by the angle of their planes about the baseline.

    items : (n,) int
        The tracklets.
    angle, sigma : (n,) float
        Angles and their 1-sigma errors [rad].
    """

    items: Indices
    angle: Array
    sigma: Array


def plane_angles(
    views: Views, s: int, m: int, items: Indices, baseline_km: Array, axes: Array
) -> PlaneAngles:
    """Return the angles of tracklets of sensor s at instant m about a baseline.

    `axes` (2, 3) are across the baseline; the angle counts from the first to the second.
    """
    unit = baseline_km / np.linalg.norm(baseline_km)
    u = _directions(views, s, m, items)
    across = np.maximum(np.sqrt(np.maximum(1 - (u @ unit) ** 2, 0)), 1e-9)
    # The trace is at least the variance along any axis.
    variance = views.sight[items, m, XX] + views.sight[items, m, YY]
    place = 2 * (views.sight[items, m, SIGMA_KM] / NEAREST_KM) ** 2
    # Light time: the ranges of two sensors differ by at most the baseline.
    moved_km = FASTEST_KM_S * np.linalg.norm(baseline_km) / SPEED_OF_LIGHT_KM_S / LARGEST_SIGMA
    place += views.sight[items, m, MOVES] * (moved_km / NEAREST_KM) ** 2
    angle = np.arctan2(u @ axes[1], u @ axes[0])
    return PlaneAngles(items, angle, np.sqrt(variance + place) / across)


def _directions(views: Views, s: int, m: int, items: Indices) -> Array:
    sight = np.column_stack([views.sight[items, m, :XX], np.ones(len(items))]) @ views.plane[s, m]
    return np.asarray(sight / np.linalg.norm(sight, axis=1, keepdims=True))


@kernel
def _meeting(space, m, a, b, out):
    """Write the pairs that meet at all instants they share; return how many there are.

    `a`, `b` are the sensors' `PlaneAngles` at instant m, those of `b` by increasing angle.
    `out` (n, 2) receives as many pairs as it has room for.
    """
    views, taken, gate_sigma = space.views, space.taken, space.gate_sigma
    widest, n = 0.0, 0
    ui, uj = np.empty(3), np.empty(3)
    for k in range(len(b.sigma)):
        widest = max(widest, b.sigma[k])
    for q in range(len(a.items)):
        i = a.items[q]
        if taken[i]:
            continue
        reach = gate_sigma * np.sqrt(a.sigma[q] ** 2 + widest**2)
        k = np.searchsorted(b.angle, a.angle[q] - reach)
        while k < len(b.items) and b.angle[k] <= a.angle[q] + reach:
            j = b.items[k]
            k += 1
            if taken[j]:
                continue
            total, shared, before = 0.0, 0, False
            for h in range(len(views.time_s)):
                if views.seen[i, h] and views.seen[j, h]:
                    if h < m:
                        before = True  # was weighed at the first instant they share
                        break
                    total += pair_miss(views, i, j, h, space.lowest_km, space.farthest_km, ui, uj)
                    shared += 1
            if before or not total <= quantile(shared, gate_sigma):  # false for NaN
                continue
            if n < len(out):
                out[n, 0], out[n, 1] = i, j
            n += 1
    return n


def seeds_between(space: SearchSpace, a: int, b: int) -> Indices:
    """Return (n, 2): free tracklets of sensors a and b whose lines of sight meet."""
    views = space.views
    pairs = []
    for m in range(len(views.time_s)):
        baseline = views.place_km[b, m] - views.place_km[a, m]
        if not np.linalg.norm(baseline) > SHORTEST_BASELINE_KM:  # false for NaN
            continue
        items_a, items_b = _free_at(space, a, m), _free_at(space, b, m)
        if not len(items_a) or not len(items_b):
            continue
        axes = _axes(baseline, views.plane[a, m, 2])
        planes_a = plane_angles(views, a, m, items_a, baseline, axes)
        planes_b = plane_angles(views, b, m, items_b, baseline, axes)
        order = np.argsort(planes_b.angle, kind="stable")
        planes_b = PlaneAngles(planes_b.items[order], planes_b.angle[order], planes_b.sigma[order])
        out = np.empty((4 * (len(items_a) + len(items_b)), 2), np.int64)
        while True:
            n = _meeting(space, m, planes_a, planes_b, out)
            if n <= len(out):
                break
            out = np.empty((n, 2), np.int64)
        pairs.append(out[:n])
    return np.concatenate([*pairs, np.zeros((0, 2), np.int64)])


def _free_at(space: SearchSpace, s: int, m: int) -> Indices:
    """Return the free tracklets of sensor s that have a direction at instant m."""
    of_sensor = slice(space.views.first[s], space.views.first[s + 1])
    free = space.views.seen[of_sensor, m] & ~space.taken[of_sensor]
    return np.asarray(space.views.first[s] + np.flatnonzero(free))


def _axes(baseline: Array, towards: Array) -> Array:
    """Return two axes across the baseline, the first (angle 0) towards the field."""
    unit = baseline / np.linalg.norm(baseline)
    first = towards - (towards @ unit) * unit
    if not np.linalg.norm(first) > 1e-9 * np.linalg.norm(towards):
        first = tangent_basis(unit)[0]
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(unit, first)])


class SensorPairs:
    """Pairs of sensors that may see one object, in the order in which they should seed.

    Pairs with a longer baseline across the line of sight come first: they fix a point better and
    have fewer chance partners. But every sensor takes part once before any takes part again.
    Pairs whose fields do not meet are skipped.
    """

    def __init__(self, views: Views, farthest_km: float) -> None:
        look, place, half = _middle(views)
        a, b = np.triu_indices(len(look), 1)
        known = np.isfinite(look[a, 0]) & np.isfinite(look[b, 0])
        a, b = a[known], b[known]
        baseline = place[b] - place[a]
        range_a, _, _ = _closest_approach(baseline, look[a], look[b])
        meet = np.linalg.norm(baseline, axis=1) > SHORTEST_BASELINE_KM
        meet[meet] = fields_meet(views, half, a[meet], b[meet], farthest_km)
        across = np.linalg.norm(np.cross(baseline, look[a] + look[b]), axis=1) / 2
        order = np.argsort(-across[meet], kind="stable")
        self._a, self._b = a[meet][order], b[meet][order]
        reach = np.where(range_a > 0, np.minimum(range_a, farthest_km), farthest_km)
        self._points = (place[a] + reach[:, None] * look[a])[meet][order][:, None]
        self._cone = half / 2
        if len(look) <= MOST_WITH_EDGES:
            edges = _shared_points(views, (look, place, half), self._a, self._b, farthest_km)
            self._points = np.concatenate([self._points, edges], axis=1)
            self._cone = half
        self._look, self._place = look, place
        self._waiting = np.ones(len(self._a), bool)
        self._busy = np.zeros(len(look), bool)
        # Earlier pairs that cover each point of a pair. A point that is not shared (NaN) counts as
        # covered.
        self._covered = np.where(np.isfinite(self._points[..., 0]), 0, np.iinfo(np.int64).max)

    def next(self, enough: float = np.inf) -> tuple[int, int] | None:
        """Return the next pair, None after the last.

        A pair is skipped where `enough` of the earlier pairs cover each point that it shares.
        These are the middle of the field and, with up to MOST_WITH_EDGES sensors, its edges.
        """
        wanted = self._waiting & (self._covered.min(axis=1) < enough)
        ready = wanted & ~self._busy[self._a] & ~self._busy[self._b]
        if not ready.any():
            self._busy[:] = False
            ready = wanted
            if not ready.any():
                return None
        k = int(np.argmax(ready))
        a, b = int(self._a[k]), int(self._b[k])
        self._waiting[k] = False
        self._busy[[a, b]] = True
        rows = np.flatnonzero(wanted)
        both = np.isfinite(self._points[rows, :, 0])
        for s in (a, b):
            toward = self._points[rows] - self._place[s]
            along = toward @ self._look[s]
            both &= along > np.cos(self._cone[s]) * np.linalg.norm(toward, axis=2)
        self._covered[rows] += both
        return a, b


def fields_meet(
    views: Views, half: Array, a: Indices, b: Indices, farthest_km: float
) -> npt.NDArray[np.bool_]:
    """Return whether the cones of tracklets of two sensors share any place, (n,).

    At some instants, the axis of sensor a's cone is stepped through. A ball about each step holds
    the cone up to the next one. The test is whether the ball touches the cone of b. It may say
    yes too often, never no where the fields meet.

    Parameters
    ----------
    half : (s,) float
        Half-angles of the sensors' cones [rad].
    a, b : (n,) int
        Pairs of sensors.
    """
    reach = np.geomspace(NEAREST_STEP_KM, farthest_km, N_STEPS)
    between = (reach[1] / reach[0] - 1) / 2
    meet = np.zeros(len(a), np.bool_)
    for m in np.unique(np.linspace(0, len(views.time_s) - 1, TESTED_INSTANTS).astype(int)):
        look, place = views.plane[:, m, 2], views.place_km[:, m]
        toward = (place[a] - place[b])[:, None] + reach[:, None] * look[a][:, None]
        ball = reach * (np.tan(half[a])[:, None] + between)
        distance = np.linalg.norm(toward, axis=2)
        along = np.einsum("npi,ni->np", toward, look[b])
        with np.errstate(invalid="ignore", divide="ignore"):
            off_axis = np.arccos(np.clip(along / distance, -1, 1))
            radius = np.arcsin(np.clip(ball / distance, 0, 1))
        inside = (distance <= ball) | (off_axis <= half[b][:, None] + radius)
        meet |= inside.any(axis=1)
    return meet


def _edges(views: Views) -> Array:
    """Return directions of each sensor's outermost tracklets, (s, 8, 3); NaN without tracklets."""
    turn = np.arange(N_EDGES) * 2 * np.pi / N_EDGES
    ways = np.column_stack([np.cos(turn), np.sin(turn)])
    edges = np.full((len(views.half_field), N_EDGES, 3), np.nan)
    for s in range(len(edges)):
        visible = views.seen[views.first[s] : views.first[s + 1]]
        if not visible.any():
            continue
        m = int(np.argmax(visible.sum(axis=0)))
        items = views.first[s] + np.flatnonzero(visible[:, m])
        outermost = np.argmax(views.sight[items, m, :XX] @ ways.T, axis=0)
        edges[s] = _directions(views, s, m, items[outermost])
    return edges


def _shared_points(
    views: Views, middle: tuple[Array, Array, Array], a: Indices, b: Indices, farthest_km: float
) -> Array:
    """Return (n, 8, 3): points [km] at the edges of fields a, where both fields of a pair see them.

    A point lies on the line of an outermost tracklet of sensor a. It is the one that is nearest to
    the axis of sensor b, or to an outermost tracklet of it, whichever passes most closely. NaN
    where this is outside the field of b. `middle` is that of `_middle`.
    """
    look, place, half = middle
    edges = _edges(views)
    best = np.full((len(a), N_EDGES), np.inf)
    points = np.full((len(a), N_EDGES, 3), np.nan)
    baseline = np.repeat(place[b] - place[a], N_EDGES, axis=0)
    u = edges[a].reshape(-1, 3)
    for towards in (*np.moveaxis(edges, 1, 0), look):
        u_b = np.repeat(towards[b], N_EDGES, axis=0)
        reach, beyond, miss = _closest_approach(baseline, u, u_b)
        reach = np.minimum(reach, farthest_km)
        with np.errstate(invalid="ignore"):
            miss = np.where((reach > 0) & (beyond > 0), miss / reach, np.inf)
        miss = miss.reshape(-1, N_EDGES)
        nearer = miss < best
        best[nearer] = miss[nearer]
        at = place[a][:, None] + (reach[:, None] * u).reshape(-1, N_EDGES, 3)
        points[nearer] = at[nearer]
    toward = points - place[b][:, None]
    along = np.einsum("npi,ni->np", toward, look[b])
    inside = along > np.cos(half[b])[:, None] * np.linalg.norm(toward, axis=2)
    return np.where(inside[..., None], points, np.nan)


def _middle(views: Views) -> tuple[Array, Array, Array]:
    """Return each sensor's mean direction, position [km], and radius of its tracklets [rad]."""
    n = len(views.half_field)
    look, place, half = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.zeros(n)
    for s in range(n):
        visible = views.seen[views.first[s] : views.first[s + 1]]
        if not visible.any():
            continue
        m = int(np.argmax(visible.sum(axis=0)))
        look[s], place[s] = views.plane[s, m, 2], views.place_km[s, m]
        at = views.sight[views.first[s] : views.first[s + 1], m, :XX][visible[:, m]]
        half[s] = np.arctan(np.sqrt((at**2).sum(axis=1).max())) + 1e-3
    return look, place, half


def _closest_approach(baseline: Array, u_a: Array, u_b: Array) -> tuple[Array, Array, Array]:
    """Return the ranges [km] along two lines of their nearest points, and the gap [km]."""
    cosine = np.sum(u_a * u_b, axis=1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_a, along_b = np.sum(baseline * u_a, axis=1), np.sum(baseline * u_b, axis=1)
    range_a = (along_a - cosine * along_b) / sine2
    range_b = (cosine * along_a - along_b) / sine2
    gap = baseline + range_b[:, None] * u_b - range_a[:, None] * u_a
    return range_a, range_b, np.linalg.norm(gap, axis=1)
