"""Shared points: points of the space that two sensors share.

`field_middles` says where each sensor looks. `middle_points` gives a point in the middle of what
two sensors share, `edge_points` some at its edges.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.views import PLANE, X, Y, direction
from epipole.tasks.algorithms.kernels import kernel

# Part of a crowded field's half-angle within which a pair covers points: its edges are left out.
MIDDLE_SHARE = 0.5


class FieldMiddles(NamedTuple):
    """The middle of each sensor's tracklets, at the instant at which it has most of them.

    For s sensors, in the GCRF; NaN without tracklets, the angle 0.

    look, position : (s, 3) float
        Normal of the sensor's plane, and its position [km].
    half : (s,) float
        Largest angle of a tracklet from the normal [rad], with a margin.
    edges : (s, e, 3) float
        Directions of the outermost tracklets along e axes of the plane.
    """

    look: Array
    position: Array
    half: Array
    edges: Array


@kernel
def field_middles(views, n_edges):
    """Return the `FieldMiddles` of all sensors of `Views`, with `n_edges` outermost tracklets."""
    n = views.camera.shape[0]
    look, position, half = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.zeros(n)
    edges, axes = np.full((n, n_edges, 3), np.nan), np.empty((n_edges, 2))
    for e in range(n_edges):
        axes[e] = np.cos(e * 2 * np.pi / n_edges), np.sin(e * 2 * np.pi / n_edges)
    outermost = np.empty(n_edges, np.int64)
    for s in range(n):
        m, max_count = 0, 0
        for h in range(len(views.time_s)):
            count = views.seen[views.first[s] : views.first[s + 1], h].sum()
            if count > max_count:
                m, max_count = h, count
        if max_count == 0:
            continue
        look[s], position[s] = views.camera[s, m, PLANE + 6 : PLANE + 9], views.camera[s, m, :3]
        widest2, farthest = 0.0, np.full(n_edges, -np.inf)
        for i in range(views.first[s], views.first[s + 1]):
            if not views.seen[i, m]:
                continue
            x, y = views.sight[i, m, X], views.sight[i, m, Y]
            widest2 = max(widest2, x * x + y * y)
            for e in range(n_edges):
                out = x * axes[e, 0] + y * axes[e, 1]
                if out > farthest[e]:
                    farthest[e], outermost[e] = out, i
        for e in range(n_edges):
            direction(views, outermost[e], m, edges[s, e])
        half[s] = np.arctan(np.sqrt(widest2)) + 1e-3
    return FieldMiddles(look, position, half, edges)


def middle_points(
    fields: FieldMiddles, crowded: Flags, a: Indices, b: Indices, farthest_km: float
) -> Array:
    """Return a point [km] in the middle of the space that each pair of sensors shares, (n, 3).

    It is the closest approach of the two axes. For nearly parallel axes that point is arbitrary.
    So in crowded space, the point of another pair is taken instead, if it is well inside the field:
    of one sensor of this pair and the first that it is paired with (longest baseline).

    `crowded` (s,) are the sensors in crowded space, and a, b (n,) the pairs, the longest baseline
    first.
    """
    look, position, half, _ = fields
    range_a, _, _ = _closest_approach(position[b] - position[a], look[a], look[b])
    reach = np.where(range_a > 0, np.minimum(range_a, farthest_km), farthest_km)
    out = position[a] + reach[:, None] * look[a]
    sensors, first = np.unique(np.column_stack([a, b]), return_index=True)
    best = np.full((len(look), 3), np.nan)
    best[sensors] = out[first // 2]
    best[~crowded] = np.nan
    for one, other in ((b, a), (a, b)):
        toward = best[one] - position[other]
        along = np.sum(toward * look[other], axis=1)
        cosine = np.cos(MIDDLE_SHARE * half[other])
        well_in = along > cosine * np.linalg.norm(toward, axis=1)  # false for NaN
        out[well_in] = best[one][well_in]
    return out


def edge_points(fields: FieldMiddles, a: Indices, b: Indices, farthest_km: float) -> Array:
    """Return (n, e, 3): points [km] at the edges of fields a, where both fields of a pair see them.

    A point lies on the line of an outermost tracklet of sensor a. It is the one that is nearest to
    the axis of sensor b, or to an outermost tracklet of it, whichever passes most closely. NaN
    where this is outside the field of b.
    """
    look, position, half, edges = fields
    n_edges = edges.shape[1]
    best = np.full((len(a), n_edges), np.inf)
    points = np.full((len(a), n_edges, 3), np.nan)
    baseline = np.repeat(position[b] - position[a], n_edges, axis=0)
    u = edges[a].reshape(-1, 3)
    for towards in (*np.moveaxis(edges, 1, 0), look):
        u_b = np.repeat(towards[b], n_edges, axis=0)
        reach, beyond, miss = _closest_approach(baseline, u, u_b)
        reach = np.minimum(reach, farthest_km)
        with np.errstate(invalid="ignore"):
            miss = np.where((reach > 0) & (beyond > 0), miss / reach, np.inf)
        miss = miss.reshape(-1, n_edges)
        nearer = miss < best
        best[nearer] = miss[nearer]
        at = position[a][:, None] + (reach[:, None] * u).reshape(-1, n_edges, 3)
        points[nearer] = at[nearer]
    toward = points - position[b][:, None]
    along = np.einsum("npi,ni->np", toward, look[b])
    inside = along > np.cos(half[b])[:, None] * np.linalg.norm(toward, axis=2)
    return np.where(inside[..., None], points, np.nan)


def _closest_approach(baseline: Array, u_a: Array, u_b: Array) -> tuple[Array, Array, Array]:
    """Return the ranges [km] along two lines of their nearest points, and the gap [km]."""
    cosine = np.sum(u_a * u_b, axis=1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_a, along_b = np.sum(baseline * u_a, axis=1), np.sum(baseline * u_b, axis=1)
    range_a = (along_a - cosine * along_b) / sine2
    range_b = (cosine * along_a - along_b) / sine2
    gap = baseline + range_b[:, None] * u_b - range_a[:, None] * u_a
    return range_a, range_b, np.linalg.norm(gap, axis=1)
