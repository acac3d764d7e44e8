"""Links by the likelihood ratio of one motion against two: no window, nothing to tune.

The motion of a fragment is a cubic in time on the plane of the sky, its acceleration and
jerk held to what the apparent rate allows. Each fragment is reduced once to sums over its
detections; a pair then costs a few small matrices, however long its fragments are.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.apparent_motion import acceleration, cubic_span, jerk
from epipole.tasks.algorithms.tracking.linking.chains import Links, choose_links, fill_in

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

FARTHEST_RAD = 0.5  # arc between fragments over which a plane still serves as the sky
SEARCH_SIGMA = 6.0  # of the quick test that spares most pairs the full one


class _Ends(NamedTuple):
    """Sums over the detections near one end of each fragment, about a middle instant.

    S[:, k] = sum w t^k, B[:, k] = sum w t^k (u - u0), C = sum w (u - u0)(u - u0)', with
    w = 1 / sigma^2 and t from the instant t0; and the end itself: time, place and rate with
    their variances (infinite: a single detection has no rate), and the square of what its
    acceleration shows beyond noise and beyond the bound that its rate sets.
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


@kernel
def _sums(time_s, u, sigma, lo, hi, t0, u0, S, B, C):
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
def _unforeseen(S, B, half, bend):
    """Return the square [rad^2/s^4] of a fragment's acceleration beyond noise and bound.

    A near object that comes straight on is slow and yet soon fast: its rate sets no bound.
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
def _reduce(
    offsets, time_s, u, sigma, last, t0, u0, S, B, C, at, end_u, end_w, var_u, var_w, extra
):
    """Fill the sums of every fragment's first (or last) part, as long as a cubic serves it."""
    for f in range(len(offsets) - 1):
        lo, hi = offsets[f], offsets[f + 1]
        length = time_s[hi - 1] - time_s[lo]
        chord = 0.0
        for a in range(3):
            chord += (u[hi - 1, a] - u[lo, a]) ** 2
        rate = np.sqrt(chord) / length if length > 0 else 0.0
        # A quarter of the span on each side leaves half of it to the gap.
        reach = cubic_span(rate, sigma[lo]) / 4
        if last:
            while hi - lo > 3 and time_s[hi - 1] - time_s[lo] > reach:
                lo += 1
        else:
            while hi - lo > 3 and time_s[hi - 1] - time_s[lo] > reach:
                hi -= 1
        middle = (lo + hi) // 2
        t0[f], at[f] = time_s[middle], time_s[hi - 1] if last else time_s[lo]
        u0[f] = u[middle]
        _sums(time_s, u, sigma, lo, hi, t0[f], u0[f], S[f], B[f], C[f])
        # A straight line for the quick test; its variances are those of the full test's prior.
        det = S[f, 0] * S[f, 2] - S[f, 1] ** 2
        dt = at[f] - t0[f]
        half = 0.5 * (time_s[hi - 1] - time_s[lo])
        bend = acceleration(rate)
        if det > 1e-12 * S[f, 0] * S[f, 2]:
            for a in range(3):
                slope = (S[f, 0] * B[f, 1, a] - S[f, 1] * B[f, 0, a]) / det
                value = (S[f, 2] * B[f, 0, a] - S[f, 1] * B[f, 1, a]) / det
                end_w[f, a] = slope
                end_u[f, a] = u0[f, a] + value + slope * dt
            var_u[f] = (S[f, 2] - 2 * S[f, 1] * dt + S[f, 0] * dt * dt) / det
            var_u[f] += (bend * half * half) ** 2
            var_w[f] = S[f, 0] / det + (bend * half) ** 2
            extra[f] = _unforeseen(S[f], B[f], half, bend)
        else:
            end_u[f] = u0[f]
            var_u[f], var_w[f] = 1.0 / S[f, 0], np.inf


def _ends(offsets: Indices, time_s: Array, u: Array, sigma: Array, last: bool) -> _Ends:
    n = len(offsets) - 1
    ends = _Ends(
        np.zeros(n), np.zeros((n, 3)), np.zeros((n, 7)), np.zeros((n, 4, 3)), np.zeros((n, 3, 3)),
        np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n),
    )  # fmt: skip
    _reduce(offsets, time_s, u, sigma, last, *ends)
    return ends


@kernel
def _shift(S, B, C, e_1, e_2, drift, t0, centre, scale, out_A, out_b):
    """Fill A (4, 4) and b (4, 2) of one fragment about a common instant, in a tangent plane.

    A straight drift is taken off first: the prior says nothing of it, and what remains is
    small, so that no digits are lost. Returns c = sum w |d|^2.
    """
    moved = np.empty((4, 2))
    for k in range(4):
        x, y = 0.0, 0.0
        for a in range(3):
            value = B[k, a] - drift[a] * S[k + 1]
            x += value * e_1[a]
            y += value * e_2[a]
        moved[k, 0], moved[k, 1] = x, y
    c = 0.0
    for a in range(3):
        for b in range(3):
            value = C[a, b] - B[1, a] * drift[b] - drift[a] * B[1, b] + drift[a] * drift[b] * S[2]
            c += value * (e_1[a] * e_1[b] + e_2[a] * e_2[b])
    delta = t0 - centre
    total = np.empty(7)
    power = 1.0
    for k in range(7):
        # sum w (t + delta)^k by the binomial theorem, then in units of the scale.
        value, factor, shift = 0.0, 1.0, 1.0
        x, y = 0.0, 0.0
        for m in range(k, -1, -1):
            value += factor * shift * S[m]
            if k < 4:
                x += factor * shift * moved[m, 0]
                y += factor * shift * moved[m, 1]
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
def _misfit(A, b, prior_2, prior_3, work):
    """Return b' (A + L)^-1 b summed over both axes, and ln det(A + L), by Cholesky."""
    for i in range(4):
        for j in range(i + 1):
            value = A[i, j]
            if i == j:
                value += prior_2 if i == 2 else (prior_3 if i == 3 else 0.0)
            for k in range(j):
                value -= work[i, k] * work[j, k]
            if i == j:
                work[i, i] = np.sqrt(max(value, 1e-300))
            else:
                work[i, j] = value / work[j, j]
    explained, log_det = 0.0, 0.0
    y = np.empty((4, 2))
    for i in range(4):
        for axis in range(2):
            value = b[i, axis]
            for k in range(i):
                value -= work[i, k] * y[k, axis]
            y[i, axis] = value / work[i, i]
            explained += y[i, axis] ** 2
        log_det += 2 * np.log(work[i, i])
    return explained, log_det


@kernel
def _free_parameters(work, prior_2, prior_3):
    """Return how many of the 4 parameters the data decide: 4 - tr((A + L)^-1 L).

    Only the last two have a prior: of the inverse, the lower right corner is needed.
    """
    last = 1.0 / work[3, 3] ** 2
    corner = (1.0 + work[3, 2] ** 2 * last) / work[2, 2] ** 2
    return 4.0 - prior_2 * corner - prior_3 * last


@kernel
def _compare(
    i, j, t0_1, u0_1, S_1, B_1, C_1, t0_2, u0_2, S_2, B_2, C_2, at_1, at_2, first, last, extra_2,
    A_1, b_1, A_2, b_2, work,
):  # fmt: skip
    """Return (D, degrees of freedom, ln likelihood ratio without the prior volume)."""
    drift, middle = np.empty(3), np.empty(3)
    norm, rate = 0.0, 0.0
    for a in range(3):
        drift[a] = (u0_2[j, a] - u0_1[i, a]) / (t0_2[j] - t0_1[i])
        middle[a] = u0_2[j, a] + u0_1[i, a]
        norm += middle[a] ** 2
        rate += drift[a] ** 2
    middle /= np.sqrt(norm)
    rate = np.sqrt(rate)
    # Any two axes across the middle: the sum over both does not depend on which.
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
    centre = 0.5 * (at_1[i] + at_2[j])
    scale = max(last[j] - centre, centre - first[i])
    c_1 = _shift(S_1[i], B_1[i], C_1[i], e_1, e_2, drift, t0_1[i], centre, scale, A_1, b_1)
    c_2 = _shift(S_2[j], B_2[j], C_2[j], e_1, e_2, drift, t0_2[j], centre, scale, A_2, b_2)
    bend2 = acceleration(rate) ** 2 + extra_2
    # What approaches at r' / r bends by twice that times its rate, and that by half as much again.
    twist = jerk(rate) + 1.5 * extra_2 / max(rate, 1e-9)
    prior_2 = 4.0 / (bend2 * scale**4)
    prior_3 = 36.0 / (twist * scale**3) ** 2
    got_1, log_1 = _misfit(A_1, b_1, prior_2, prior_3, work)
    free = _free_parameters(work, prior_2, prior_3)
    got_2, log_2 = _misfit(A_2, b_2, prior_2, prior_3, work)
    free += _free_parameters(work, prior_2, prior_3)
    for a in range(4):
        for b in range(4):
            A_1[a, b] += A_2[a, b]
        for axis in range(2):
            b_1[a, axis] += b_2[a, axis]
    got, log_both = _misfit(A_1, b_1, prior_2, prior_3, work)
    free -= _free_parameters(work, prior_2, prior_3)
    D = (c_1 + c_2 - got) - (c_1 - got_1) - (c_2 - got_2)
    log_ratio = log_1 + log_2 - log_both - np.log(prior_2 * prior_3) - 2 * np.log(2 * np.pi)
    # A rate in units of the scale: its share of the prior volume is rad^2, not rad^2 / s^2.
    return D, 2 * max(free, 2.0), log_ratio + 2 * np.log(scale) - 0.5 * D


@kernel
def _near(u_1, w_1, var_u_1, var_w_1, u_2, w_2, var_u_2, var_w_2, extra, gap):
    """Return whether straight lines from both ends come near each other in mid-gap."""
    half, miss, arc, rate = 0.5 * gap, 0.0, 0.0, 0.0
    for a in range(3):
        miss += (u_1[a] + half * w_1[a] - u_2[a] + half * w_2[a]) ** 2
        arc += (u_2[a] - u_1[a]) ** 2
    rate = np.sqrt(arc) / gap
    bend2 = 0.25 * (acceleration(rate) ** 2 + extra) * half**4
    allowed = var_u_1 + var_u_2 + half * half * (var_w_1 + var_w_2) + 2 * bend2
    return arc < FARTHEST_RAD**2 and miss < 2 * SEARCH_SIGMA**2 * allowed


@kernel
def _search(by_start, start, end, gap_s, u_1, w_1, vu_1, vw_1, x_1, u_2, w_2, vu_2, vw_2, x_2):
    """Return the pairs (earlier, later) that the gap and the quick test leave."""
    n, room, count = len(start), 1024, 0
    first, second = np.empty(room, np.int64), np.empty(room, np.int64)
    sorted_start = start[by_start]
    for i in range(n):
        for k in range(np.searchsorted(sorted_start, end[i], side="right"), n):
            j = by_start[k]
            gap = start[j] - end[i]
            if gap > gap_s:
                break
            if not _near(
                u_1[i], w_1[i], vu_1[i], vw_1[i], u_2[j], w_2[j], vu_2[j], vw_2[j],
                max(x_1[i], x_2[j]), gap,
            ):  # fmt: skip
                continue
            if count == room:
                room *= 2
                first = np.concatenate((first, np.empty(count, np.int64)))
                second = np.concatenate((second, np.empty(count, np.int64)))
            first[count], second[count] = i, j
            count += 1
    return first[:count], second[:count]


@kernel
def _compare_all(
    earlier, later, t0_1, u0_1, S_1, B_1, C_1, at_1, t0_2, u0_2, S_2, B_2, C_2, at_2, first, last,
    extra_1, extra_2, out_D, out_free, out_log,
):  # fmt: skip
    A_1, b_1, A_2, b_2 = np.empty((4, 4)), np.empty((4, 2)), np.empty((4, 4)), np.empty((4, 2))
    work = np.zeros((4, 4))
    for p in range(len(earlier)):
        out_D[p], out_free[p], out_log[p] = _compare(
            earlier[p], later[p], t0_1, u0_1, S_1, B_1, C_1, t0_2, u0_2, S_2, B_2, C_2, at_1,
            at_2, first, last, max(extra_1[earlier[p]], extra_2[later[p]]), A_1, b_1, A_2, b_2,
            work,
        )  # fmt: skip


def link_by_likelihood(
    offsets: Indices,
    time_s: Array,
    u_icrs: Array,
    sigma_rad: Array,
    *,
    gap_s: float,
    kept: float,
    field_sr: float,
) -> Links:
    """Return which fragment continues which, by the ratio of joined against separate fits.

    Parameters
    ----------
    offsets : (g + 1,) int
        Fragment k has the detections ``offsets[k]:offsets[k + 1]``, in time order, at least one.
    time_s, u_icrs, sigma_rad : (n,), (n, 3), (n,) float
        Times [s], unit vectors, and their 1-sigma errors an axis [rad].
    gap_s
        Longest gap bridged.
    kept
        Share of true links that the chi-square test lets pass.
    field_sr
        Solid angle in which fragments begin: how dense they are decides what is ambiguous.

    Notes
    -----
    D = J(i u j) - J(i) - J(j), J the misfit of a cubic with a prior on acceleration and
    jerk, is chi-square with 4 degrees of freedom where the prior decides both, with 8 where
    the data do. What a link gains is the log of the ratio of the two marginal likelihoods,
    one motion against two: D, and how precisely the one motion foretold the other fragment
    against how many others could have begun there.
    """
    head = _ends(offsets, time_s, u_icrs, sigma_rad, False)
    tail = _ends(offsets, time_s, u_icrs, sigma_rad, True)
    by_start = np.argsort(head.at, kind="stable")
    earlier, later = _search(
        by_start, head.at, tail.at, float(gap_s), tail.u, tail.w, tail.var_u, tail.var_w,
        tail.extra, head.u, head.w, head.var_u, head.var_w, head.extra,
    )  # fmt: skip
    D, free, log_ratio = (np.empty(len(earlier)) for _ in range(3))
    _compare_all(
        earlier, later, *tail[:6], *head[:6], time_s[offsets[:-1]], time_s[offsets[1:] - 1],
        tail.extra, head.extra, D, free, log_ratio,
    )  # fmt: skip
    gain = log_ratio - np.log(_others(head, tail, gap_s)[earlier])
    gain += np.log(field_sr * _rate_area(head))
    gain[chdtri(free, 1.0 - kept) < D] = 0.0
    D = np.maximum(D, 0.0)
    links = choose_links(earlier, later, gain, D, len(offsets) - 1)
    return fill_in(links, earlier, later, gain, D)


def _others(head: _Ends, tail: _Ends, gap_s: float) -> Array:
    """Return how many fragments begin in the time in which each could continue."""
    starts = np.sort(head.at)
    return (
        np.searchsorted(starts, tail.at + gap_s, side="right")
        - np.searchsorted(starts, tail.at, side="right")
    ).astype(float)


def _rate_area(head: _Ends) -> float:
    """Return over what area [rad^2/s^2] the fragments' rates spread.

    The mean density of a normal distribution is one over 4 pi sigma^2.
    """
    known = np.isfinite(head.var_w)
    if not known.any():
        return 1.0
    spread = head.w[known].var(axis=0).sum() / 2
    return float(4 * np.pi * (spread + np.median(head.var_w[known])))
