"""Seeds: pairs of tracklets whose lines of sight meet. They are found by sorting one angle.

The baseline of two sensors and a direction span a plane. The angle of this plane about the
baseline is one number for each direction, and equal for both sensors' views of one object. With
the angles sorted, a binary search gives the views that a view may meet. Pairs that cannot meet
cost nothing.
"""

import numpy as np

from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.association.search.sight_lines import pair_miss, quantile
from epipole.tasks.algorithms.association.views import HAS_RATE, PLANE, SIGMA_KM, XX, YY, direction
from epipole.tasks.algorithms.constants import ESCAPE_SPEED_KM_S, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

SHORTEST_BASELINE_KM = 1.0  # minimum baseline of a pair: below, ranges are undetermined
NEAREST_KM = 300.0  # minimum range [km]: errors of the baseline turn the plane most there
MOTION_SIGMA = 3.0  # motion during the light time, at escape speed, counts as an error of 3 sigma


@kernel
def seeds_between(space, a, b, gate_sigma):
    """Return (n, 2): free tracklets of sensors a and b whose lines of sight meet.

    `gate_sigma` is the maximum gap of the lines, as a chi-square of the same probability.
    """
    views, n = space.views, 0
    gate = np.sqrt(quantile(1, gate_sigma))  # of the instant that a pair is first compared at
    out = np.empty((4 * (_size(views, a) + _size(views, b)), 2), np.int64)
    baseline, axes = np.empty(3), np.empty((2, 3))
    for m in range(len(views.time_s)):
        for q in range(3):
            baseline[q] = views.camera[b, m, q] - views.camera[a, m, q]
        length = np.sqrt(np.sum(baseline * baseline))
        if not length > SHORTEST_BASELINE_KM:  # false for NaN
            continue
        _write_axes(views, a, m, baseline, axes)
        items_a, angle_a, sigma_a = _plane_angles(space, a, m, baseline, axes)
        items_b, angle_b, sigma_b = _plane_angles(space, b, m, baseline, axes)
        if len(items_a) == 0 or len(items_b) == 0:
            continue
        order = np.argsort(angle_b, kind="mergesort")
        items_b, angle_b, sigma_b = items_b[order], angle_b[order], sigma_b[order]
        max_sigma = sigma_b.max()
        for q in range(len(items_a)):
            reach = min(gate * np.sqrt(sigma_a[q] ** 2 + max_sigma**2), np.pi)
            for turn in range(-1, 2):  # angles near half a turn have neighbours on its other side
                angle = angle_a[q] + turn * 2 * np.pi
                if abs(angle) - reach > np.pi:
                    continue
                k = np.searchsorted(angle_b, angle - reach)
                while k < len(items_b) and angle_b[k] <= angle + reach:
                    if meet(space, items_a[q], items_b[k], m, gate_sigma, axes):
                        if n == len(out):
                            out = doubled(out, n)
                        out[n, 0], out[n, 1] = items_a[q], items_b[k]
                        n += 1
                    k += 1
    return out[:n]


@borrowing_kernel
def _size(views, s):
    """Return the number of tracklets of sensor s."""
    return views.first[s + 1] - views.first[s]


@borrowing_kernel
def meet(space, i, j, m, gate_sigma, work):
    """Return whether two tracklets meet at all instants they share, of which m is the first.

    `work` (2, 3) is work space; `seeds_between` passes `axes`, which it writes at each instant.
    """
    views, total, shared = space.views, 0.0, 0
    for h in range(len(views.time_s)):
        if views.seen[i, h] and views.seen[j, h]:
            if h < m:
                return False  # they were compared at the first instant that they share
            total += pair_miss(views, i, j, h, space.lowest_km, space.farthest_km, work[0], work[1])
            shared += 1
    return total <= quantile(shared, gate_sigma)  # false for NaN


@kernel
def _plane_angles(space, s, m, baseline, axes):
    """Return the free tracklets of sensor s at instant m, and the angles of their planes.

    Returns the tracklets, their angles about the baseline and the 1-sigma errors of these [rad].
    `axes` (2, 3) are across the baseline; the angle counts from the first to the second.
    """
    views, n = space.views, 0
    items, u = np.empty(_size(views, s), np.int64), np.empty(3)
    angle, sigma = np.empty(len(items)), np.empty(len(items))
    length = np.sqrt(np.sum(baseline * baseline))
    # Light time: the ranges of two sensors differ by at most the baseline.
    moved_km = ESCAPE_SPEED_KM_S * length / SPEED_OF_LIGHT_KM_S / MOTION_SIGMA
    for i in range(views.first[s], views.first[s + 1]):
        if space.taken[i] or not views.seen[i, m]:
            continue
        direction(views, i, m, u)
        along, first, second = 0.0, 0.0, 0.0
        for q in range(3):
            along += u[q] * baseline[q] / length
            first += u[q] * axes[0, q]
            second += u[q] * axes[1, q]
        across = max(np.sqrt(max(1.0 - along * along, 0.0)), 1e-9)
        # The trace is at least the variance along any axis.
        variance = views.sight[i, m, XX] + views.sight[i, m, YY]
        variance += 2 * (views.sight[i, m, SIGMA_KM] / NEAREST_KM) ** 2
        variance += views.sight[i, m, HAS_RATE] * (moved_km / NEAREST_KM) ** 2
        items[n], angle[n] = i, np.arctan2(second, first)
        sigma[n] = np.sqrt(variance) / across
        n += 1
    return items[:n], angle[:n], sigma[:n]


@borrowing_kernel
def _write_axes(views, a, m, baseline, axes):
    """Write two axes across the baseline, the first (angle 0) towards the field of sensor a.

    To `axes` (2, 3), unit vectors; `baseline` (3,) [km] and they are in the GCRF, at instant m.
    """
    length2, along, towards2 = 0.0, 0.0, 0.0
    for q in range(3):
        length2 += baseline[q] * baseline[q]
        along += baseline[q] * views.camera[a, m, PLANE + 6 + q]
        towards2 += views.camera[a, m, PLANE + 6 + q] ** 2
    across2 = 0.0
    for q in range(3):
        axes[0, q] = views.camera[a, m, PLANE + 6 + q] - along / length2 * baseline[q]
        across2 += axes[0, q] ** 2
    if not across2 > 1e-18 * towards2:  # the field lies along the baseline: any axis will do
        smallest = 0
        for q in range(3):
            smallest = q if abs(baseline[q]) < abs(baseline[smallest]) else smallest
        across2 = 0.0
        for q in range(3):
            axes[0, q] = (1.0 if q == smallest else 0.0) - baseline[smallest] / length2 * baseline[
                q
            ]
            across2 += axes[0, q] ** 2
    for q in range(3):
        axes[0, q] /= np.sqrt(across2)
    for q in range(3):
        p, r = (q + 1) % 3, (q + 2) % 3
        axes[1, q] = (baseline[p] * axes[0, r] - baseline[r] * axes[0, p]) / np.sqrt(length2)
