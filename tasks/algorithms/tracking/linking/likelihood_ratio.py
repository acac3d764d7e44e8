"""Links by the likelihood ratio of one motion against two, without a window to tune.

A motion is a cubic in time on the tangent plane, with priors on acceleration and jerk that follow
from the apparent rate. `link_by_likelihood` works in these steps:

1. Each end of each fragment is reduced to sums over its detections (`_reduce`), so that a pair
   costs a few small matrices, however long its fragments are.
2. Pairs within the longest gap pass a quick test if straight lines from both ends come near each
   other in mid-gap (`_search`).
3. These pairs are compared: one cubic through both against one through each (`_compare`).
4. The gain of a link depends on the number of fragments that could have begun there
   (`_alternatives`).
5. The links with the maximum total gain are chosen (`chains.choose_links`).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import LN_2PI
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.linking.chains import (
    Fragments,
    LinkRule,
    Links,
    choose_links,
    fill_in,
)
from epipole.tasks.algorithms.tracking.sky_filter import (
    FAR_RAD_S2,
    LOW_ORBIT_S,
    acceleration,
    cubic_span,
    jerk,
)

MAX_ARC_RAD = 0.5  # maximum arc between fragments, for which a plane approximates the sky
SEARCH_SIGMA = 6.0  # gate of the quick test; most pairs fail it
MIN_JERK = LOW_ORBIT_S * FAR_RAD_S2  # [rad/s^3] `jerk` of an object that stands still
MAX_PAIRS = 10_000_000  # limit of pairs compared: beyond it, the longest gaps are not bridged


class _Ends(NamedTuple):
    """Sums over the detections near one end of each fragment, about a middle time.

    S[:, k] = sum w t^k, B[:, k] = sum w t^k (u - u0), C = sum w (u - u0)(u - u0)', with
    w = 1 / sigma^2 [rad^-2] and t [s] from the time t0. At the end itself: time `at` [s],
    direction `u` (3,), rate `w` (3,) [rad/s] with their variances (infinite for the rate of a
    single detection), and `extra`, the square of the acceleration beyond noise and beyond the
    bound that the rate sets [rad^2/s^4].

    Of g fragments, S is (g, 7), B (g, 4, 3), C (g, 3, 3); directions and rates are (g, 3), ICRS;
    all others are (g,).
    """

    t0: Array
    u0: Array
    S: Array
    B: Array
    C: Array
    at: Array
    u: Array
    w: Array
    var_u: Array
    var_w: Array
    extra: Array


class _FitScratch(NamedTuple):
    """Normal equations of two fragments, A (4, 4) and b (4, 2), and a Cholesky factor (4, 4)."""

    A_1: Array
    b_1: Array
    A_2: Array
    b_2: Array
    factor: Array


class _Plane(NamedTuple):
    """A tangent plane and a common time.

    e_1, e_2 : (3,) float, axes of the plane, ICRS
    drift : (3,) float, a straight motion [rad/s]
    centre, scale : the common time, and the unit of time about it [s]
    """

    e_1: Array
    e_2: Array
    drift: Array
    centre: float
    scale: float


@kernel
def _sums(fragments, lo, hi, ends, f):
    """Add the detections lo:hi to the sums S (7,), B (4, 3), C (3, 3) of fragment f."""
    time_s, u, sigma = fragments.time_s, fragments.u_icrs, fragments.sigma_rad
    t0, u0, S, B, C = ends.t0[f], ends.u0[f], ends.S[f], ends.B[f], ends.C[f]
    for k in range(lo, hi):
        weight, t = 1.0 / sigma[k] ** 2, time_s[k] - t0
        power = weight
        for m in range(7):
            S[m] += power
            if m < 4:
                for a in range(3):
                    B[m, a] += power * (u[k, a] - u0[a])
            power *= t
        for a in range(3):
            for b in range(3):
                C[a, b] += weight * (u[k, a] - u0[a]) * (u[k, b] - u0[b])


@kernel
def _excess_acceleration2(S, B, half, bend):
    """Return the square [rad^2/s^4] of a fragment's acceleration beyond its noise and bound.

    S (7,) and B (4, 3) are its sums, see `_Ends`; `half` [s] is half its length, `bend` [rad/s^2]
    the bound that its rate sets. The bound fails for a near object that approaches head-on: it is
    slow at first and soon fast.
    """
    # Time in units of the half-length, and a parabola free of value and slope.
    s_0, s_1, s_2 = S[0], S[1] / half, S[2] / half**2
    s_3, s_4 = S[3] / half**3, S[4] / half**4
    det = s_0 * s_2 - s_1 * s_1
    on_0 = (s_2 * s_2 - s_3 * s_1) / det
    on_1 = (s_0 * s_3 - s_1 * s_2) / det
    weight = s_4 - on_0 * s_2 - on_1 * s_3
    if not weight > 1e-9 * s_4:
        return 0.0
    square = 0.0
    for a in range(3):
        value = B[2, a] / half**2 - on_0 * B[0, a] - on_1 * B[1, a] / half
        square += (2 * value / (weight * half**2)) ** 2
    noise = 4 / (weight * half**4)  # variance of the acceleration on each of two axes
    return max(square - 16 * noise - bend * bend, 0.0)


@kernel
def _end_rows(fragments, f, last):
    """Return rows lo:hi of a fragment's last (or first) part, and the fragment's rate [rad/s].

    The part is short enough for a cubic, and has a minimum of three detections if there are three.
    """
    time_s, u = fragments.time_s, fragments.u_icrs
    lo, hi = fragments.offsets[f], fragments.offsets[f + 1]
    length = time_s[hi - 1] - time_s[lo]
    chord = 0.0
    for a in range(3):
        chord += (u[hi - 1, a] - u[lo, a]) ** 2
    rate = np.sqrt(chord) / length if length > 0 else 0.0
    # A quarter of the span on each side leaves half of it to the gap.
    reach = cubic_span(rate, fragments.sigma_rad[lo]) / 4
    if last:
        while hi - lo > 3 and time_s[hi - 1] - time_s[lo] > reach:
            lo += 1
    else:
        while hi - lo > 3 and time_s[hi - 1] - time_s[lo] > reach:
            hi -= 1
    return lo, hi, rate


@kernel
def _reduce(fragments, last, ends):
    """Fill `ends` with sums over each fragment's last (or first) part, and its straight line."""
    time_s, u = fragments.time_s, fragments.u_icrs
    for f in range(len(fragments.offsets) - 1):
        lo, hi, rate = _end_rows(fragments, f, last)
        middle = (lo + hi) // 2
        ends.t0[f], ends.at[f] = time_s[middle], time_s[hi - 1] if last else time_s[lo]
        ends.u0[f] = u[middle]
        _sums(fragments, lo, hi, ends, f)
        # A straight line for the quick test; its variances are those of the full test's prior.
        S, B = ends.S[f], ends.B[f]
        det = S[0] * S[2] - S[1] ** 2
        dt = ends.at[f] - ends.t0[f]
        half = 0.5 * (time_s[hi - 1] - time_s[lo])
        bend = acceleration(rate)
        if det > 1e-12 * S[0] * S[2]:
            for a in range(3):
                slope = (S[0] * B[1, a] - S[1] * B[0, a]) / det
                value = (S[2] * B[0, a] - S[1] * B[1, a]) / det
                ends.w[f, a] = slope
                ends.u[f, a] = ends.u0[f, a] + value + slope * dt
            ends.var_u[f] = (S[2] - 2 * S[1] * dt + S[0] * dt * dt) / det
            ends.var_u[f] += (bend * half * half) ** 2
            ends.var_w[f] = S[0] / det + (bend * half) ** 2
            ends.extra[f] = _excess_acceleration2(S, B, half, bend)
        else:
            ends.u[f] = ends.u0[f]
            ends.var_u[f], ends.var_w[f] = 1.0 / S[0], np.inf


def _ends(fragments: Fragments, last: bool) -> _Ends:
    n = len(fragments.offsets) - 1
    ends = _Ends(
        np.zeros(n), np.zeros((n, 3)), np.zeros((n, 7)), np.zeros((n, 4, 3)), np.zeros((n, 3, 3)),
        np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip
    _reduce(fragments, last, ends)
    return ends


@kernel
def _shift(ends, f, plane, out_A, out_b):
    """Fill A (4, 4) and b (4, 2) of one fragment about a common time, in a tangent plane.

    A straight drift is subtracted first. It has no prior, and the remainder is small, so that
    no digits are lost. Returns c = sum w |d|^2.
    """
    S, B, C = ends.S[f], ends.B[f], ends.C[f]
    e_1, e_2, drift, scale = plane.e_1, plane.e_2, plane.drift, plane.scale
    drifted = np.empty((4, 2))
    for k in range(4):
        x, y = 0.0, 0.0
        for a in range(3):
            value = B[k, a] - drift[a] * S[k + 1]
            x += value * e_1[a]
            y += value * e_2[a]
        drifted[k, 0], drifted[k, 1] = x, y
    c = 0.0
    for a in range(3):
        for b in range(3):
            value = C[a, b] - B[1, a] * drift[b] - drift[a] * B[1, b] + drift[a] * drift[b] * S[2]
            c += value * (e_1[a] * e_1[b] + e_2[a] * e_2[b])
    delta = ends.t0[f] - plane.centre
    total = np.empty(7)
    power = 1.0
    for k in range(7):
        # sum w (t + delta)^k by the binomial theorem, then in units of the scale.
        value, factor, shift = 0.0, 1.0, 1.0
        x, y = 0.0, 0.0
        for m in range(k, -1, -1):
            value += factor * shift * S[m]
            if k < 4:
                x += factor * shift * drifted[m, 0]
                y += factor * shift * drifted[m, 1]
            factor *= m / (k - m + 1.0)
            shift *= delta
        total[k] = value * power
        if k < 4:
            out_b[k, 0], out_b[k, 1] = x * power, y * power
        power /= scale
    for i in range(4):
        for j in range(4):
            out_A[i, j] = total[i + j]
    return c


@kernel
def _explained(A, b, prior_2, prior_3, factor):
    """Return b' (A + L)^-1 b summed over both axes, and ln det(A + L), by Cholesky.

    A (4, 4), b (4, 2); L is diagonal: prior_2 and prior_3 for acceleration and jerk, else 0.
    Writes the factor of A + L to `factor` (4, 4).
    """
    for i in range(4):
        for j in range(i + 1):
            value = A[i, j]
            if i == j:
                value += prior_2 if i == 2 else (prior_3 if i == 3 else 0.0)
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = np.sqrt(max(value, 1e-300))
            else:
                factor[i, j] = value / factor[j, j]
    explained, log_det = 0.0, 0.0
    y = np.empty((4, 2))
    for i in range(4):
        for axis in range(2):
            value = b[i, axis]
            for k in range(i):
                value -= factor[i, k] * y[k, axis]
            y[i, axis] = value / factor[i, i]
            explained += y[i, axis] ** 2
        log_det += 2 * np.log(factor[i, i])
    return explained, log_det


@kernel
def _free_parameters(factor, prior_2, prior_3):
    """Return the effective number of parameters that the data determine: 4 - tr((A + L)^-1 L).

    `factor` (4, 4) and the priors are those of `_explained`. Only the last two parameters have a
    prior: of the inverse, the lower right corner is needed.
    """
    last = 1.0 / factor[3, 3] ** 2
    corner = (1.0 + factor[3, 2] ** 2 * last) / factor[2, 2] ** 2
    return 4.0 - prior_2 * corner - prior_3 * last


@kernel
def _plane_between(tail, head, i, j, first, last):
    """Return the plane halfway between two fragments, and the rate [rad/s] between them.

    i is a row of `tail`, the `_Ends` of the fragments' last parts, j of `head`, those of their
    first parts. `first` and `last` (g,) [s] are the times of each fragment's first and last
    detection.
    """
    drift, middle = np.empty(3), np.empty(3)
    norm, rate = 0.0, 0.0
    for a in range(3):
        drift[a] = (head.u0[j, a] - tail.u0[i, a]) / (head.t0[j] - tail.t0[i])
        middle[a] = head.u0[j, a] + tail.u0[i, a]
        norm += middle[a] ** 2
        rate += drift[a] ** 2
    middle /= np.sqrt(norm)
    rate = np.sqrt(rate)
    # Any two axes across the middle: the sum over both does not depend on the choice.
    e_1, e_2 = np.zeros(3), np.empty(3)
    helper = 0
    for a in range(1, 3):
        if abs(middle[a]) < abs(middle[helper]):
            helper = a
    e_1[helper] = 1.0
    along, norm = middle[helper], 0.0
    for a in range(3):
        e_1[a] -= along * middle[a]
        norm += e_1[a] ** 2
    e_1 /= np.sqrt(norm)
    e_2[0] = middle[1] * e_1[2] - middle[2] * e_1[1]
    e_2[1] = middle[2] * e_1[0] - middle[0] * e_1[2]
    e_2[2] = middle[0] * e_1[1] - middle[1] * e_1[0]
    centre = 0.5 * (tail.at[i] + head.at[j])
    scale = max(last[j] - centre, centre - first[i])
    return _Plane(e_1, e_2, drift, centre, scale), rate


@kernel
def _compare(tail, head, i, j, first, last, scratch):
    """Return (D, degrees of freedom, ln likelihood ratio without the prior volume).

    D is the rise of chi-square from one motion for each fragment to one for both. Arguments as in
    `_plane_between`; `scratch` is a `_FitScratch`.
    """
    A_1, b_1, A_2, b_2, factor = scratch.A_1, scratch.b_1, scratch.A_2, scratch.b_2, scratch.factor
    plane, rate = _plane_between(tail, head, i, j, first, last)
    scale, extra_2 = plane.scale, max(tail.extra[i], head.extra[j])
    c_1 = _shift(tail, i, plane, A_1, b_1)
    c_2 = _shift(head, j, plane, A_2, b_2)
    bend2 = acceleration(rate) ** 2 + extra_2
    # An object that approaches at r' / r has the acceleration a = 2 r' / r times its rate, and
    # the jerk 1.5 a^2 over its rate.
    jerk_bound = jerk(rate) + 1.5 * extra_2 / max(rate, 1e-9)
    prior_2 = 4.0 / (bend2 * scale**4)
    prior_3 = 36.0 / (jerk_bound * scale**3) ** 2
    explained_1, log_1 = _explained(A_1, b_1, prior_2, prior_3, factor)
    n_free = _free_parameters(factor, prior_2, prior_3)
    explained_2, log_2 = _explained(A_2, b_2, prior_2, prior_3, factor)
    n_free += _free_parameters(factor, prior_2, prior_3)
    for a in range(4):
        for b in range(4):
            A_1[a, b] += A_2[a, b]
        for axis in range(2):
            b_1[a, axis] += b_2[a, axis]
    explained, log_both = _explained(A_1, b_1, prior_2, prior_3, factor)
    n_free -= _free_parameters(factor, prior_2, prior_3)
    D = (c_1 + c_2 - explained) - (c_1 - explained_1) - (c_2 - explained_2)
    log_ratio = log_1 + log_2 - log_both - np.log(prior_2 * prior_3) - 2 * LN_2PI
    # A rate in units of the scale: its share of the prior volume is rad^2, not rad^2 / s^2.
    return D, 2 * max(n_free, 2.0), log_ratio + 2 * np.log(scale) - 0.5 * D


@kernel
def _near(tail, head, i, j):
    """Return whether straight lines from both ends come within `SEARCH_SIGMA` in mid-gap.

    i is a row of `tail`, the `_Ends` of the fragments' last parts, j of `head`, those of their
    first parts.
    """
    gap = head.at[j] - tail.at[i]
    half, distance2, arc, rate = 0.5 * gap, 0.0, 0.0, 0.0
    for a in range(3):
        distance2 += (tail.u[i, a] + half * tail.w[i, a] - head.u[j, a] + half * head.w[j, a]) ** 2
        arc += (head.u[j, a] - tail.u[i, a]) ** 2
    rate = np.sqrt(arc) / gap
    bend2 = 0.25 * (acceleration(rate) ** 2 + max(tail.extra[i], head.extra[j])) * half**4
    allowed = tail.var_u[i] + head.var_u[j] + half * half * (tail.var_w[i] + head.var_w[j])
    allowed += 2 * bend2
    return arc < MAX_ARC_RAD**2 and distance2 < 2 * SEARCH_SIGMA**2 * allowed


@kernel
def _search(tail, head, by_start, gap_s):
    """Return the pairs (earlier, later), at most `gap_s` apart, that pass the quick test.

    They are (p,) int64 each. by_start (g,) int has the fragments in order of `head.at`.
    """
    n, capacity, count = len(head.at), 1024, 0
    first, second = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    sorted_start = head.at[by_start]
    for i in range(n):
        for k in range(np.searchsorted(sorted_start, tail.at[i], side="right"), n):
            j = by_start[k]
            if head.at[j] - tail.at[i] > gap_s:
                break
            if not _near(tail, head, i, j):
                continue
            if count == capacity:
                capacity *= 2
                first = np.concatenate((first, np.empty(count, np.int64)))
                second = np.concatenate((second, np.empty(count, np.int64)))
            first[count], second[count] = i, j
            count += 1
    return first[:count], second[:count]


@kernel
def _compare_all(tail, head, earlier, later, first, last):
    """Return the results of `_compare` for each pair: three arrays (p,).

    `earlier` and `later` (p,) int64 are the fragments of the pairs, `first` and `last` as in
    `_compare`.
    """
    n = len(earlier)
    D, free, log_ratio = np.empty(n), np.empty(n), np.empty(n)
    scratch = _FitScratch(
        np.empty((4, 4)), np.empty((4, 2)), np.empty((4, 4)), np.empty((4, 2)), np.zeros((4, 4))
    )
    for p in range(n):
        D[p], free[p], log_ratio[p] = _compare(
            tail, head, earlier[p], later[p], first, last, scratch
        )
    return D, free, log_ratio


def link_by_likelihood(fragments: Fragments, rule: LinkRule) -> Links:
    """Return which fragment continues which, by the ratio of joined against separate fits.

    Notes
    -----
    D = J(i u j) - J(i) - J(j), J the misfit of a cubic with a prior on acceleration and jerk, is
    chi-square with 4 degrees of freedom if the prior determines both, with 8 if the data do.
    The gain of a link is the log of the ratio of two marginal likelihoods, one motion against
    two. It depends on D, and on how precisely the one motion predicts the other fragment compared
    with the number of others that could have begun there. So no gap is too long if the prediction
    is good enough. Gaps are bridged as far as any motion can be predicted.
    """
    head, tail = _ends(fragments, False), _ends(fragments, True)
    offsets, time_s = fragments.offsets, fragments.time_s
    starts = np.sort(head.at)
    gap_s = _longest_gap(starts, tail.at, rule)
    by_start = np.argsort(head.at, kind="stable")
    earlier, later = _search(tail, head, by_start, gap_s)
    D, free, log_ratio = _compare_all(
        tail, head, earlier, later, time_s[offsets[:-1]], time_s[offsets[1:] - 1]
    )
    gain = log_ratio - np.log(_alternatives(starts, tail.at[earlier], head.at[later], gap_s))
    gain += np.log(rule.field_sr * _rate_area(head))
    gain[chdtri(free, 1.0 - rule.confidence) < D] = 0.0
    D = np.maximum(D, 0.0)
    links = choose_links(earlier, later, gain, D, len(offsets) - 1)
    return fill_in(links, earlier, later, gain, D)


def _longest_gap(starts: Array, ends: Array, rule: LinkRule) -> float:
    """Return the longest gap [s] that is bridged: that of the rule, or else the longest useful one.

    Over a longer one, even the jerk of the slowest object makes its direction uncertain by the
    whole field. The gap is shortened until at most `MAX_PAIRS` pairs are compared.
    """
    longest = float(np.cbrt(6 * np.sqrt(rule.field_sr) / MIN_JERK))
    if np.isfinite(rule.gap_s):
        longest = float(rule.gap_s)
    while _count_starts(starts, ends, ends + longest).sum() > MAX_PAIRS:
        longest *= 0.8
    return longest


def _count_starts(starts: Array, after: Array, until: Array) -> Indices:
    """Return the number of sorted starts after one time and up to another."""
    return np.searchsorted(starts, until, side="right") - np.searchsorted(
        starts, after, side="right"
    )


def _alternatives(starts: Array, end: Array, start: Array, gap_s: float) -> Array:
    """Return the number of fragments among which each continuation was found, normalised.

    All fragments that begin after the end and up to the start could have been the continuation.
    The prior of a link is one over this number; the harmonic sum over all that begin within the
    longest gap normalises it.
    """
    up_to, all_of = _count_starts(starts, end, start), _count_starts(starts, end, end + gap_s)
    return np.asarray(np.maximum(up_to, 1) * (np.log(np.maximum(all_of, 1)) + np.euler_gamma + 0.5))


def _rate_area(head: _Ends) -> float:
    """Return the area [rad^2/s^2] over which the fragments' rates spread.

    The mean density of a normal distribution is one over 4 pi sigma^2.
    """
    known = np.isfinite(head.var_w)
    if not known.any():
        return 1.0
    spread = head.w[known].var(axis=0).sum() / 2
    return float(4 * np.pi * (spread + np.median(head.var_w[known])))
