"""Times: time scales for pyerfa, epochs of all sensors, and the order of frames and states."""

from functools import cache

import erfa
import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array, Flags, Integers, Nanoseconds
from epipole.tasks.algorithms.constants import AU_KM, DAY_NS, DAY_S

UNIX_EPOCH_JD = 2440587.5
NODE_NS = 600_000_000_000
TT_MINUS_TAI_S = 32.184
MILLISECOND_NS = 1_000_000
# The rate of frames may change in a night. An even number: of pairs of exposures, half the
# intervals are short, and the median is half the time between the pairs.
NEAR_INTERVALS = 20
KEEP, DUPLICATE_FRAME, DUPLICATE_NUMBER, DUPLICATE_TIME = range(4)


def utc_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part UTC Julian date (whole days + 0.5, fraction) of Unix nanoseconds."""
    day, rest = np.divmod(np.asarray(time_ns, np.int64), DAY_NS)
    return UNIX_EPOCH_JD + day, rest / DAY_NS


def tai_minus_utc_s(jd_utc: Array) -> Array:
    """Return TAI-UTC [s] on UTC days, given by Julian dates.

    From erfa's table. `erfa.utctai` itself would warn of every date a few years ahead, and it
    counts a day with a leap second as 86,401 s where Unix time has 86,400 s. Before 1972 the
    value is 10 s, the first of the table: UTC drifted then, and no log is that old.
    """
    days, seconds = _leap_seconds()
    return seconds[np.maximum(np.searchsorted(days, jd_utc, side="right") - 1, 0)]


@cache
def _leap_seconds() -> tuple[Array, Array]:
    """Return the Julian dates of the steps of TAI-UTC, and its values [s] from there on."""
    steps = erfa.leap_seconds.get()
    steps = steps[steps["year"] >= 1972]
    jd1, jd2 = erfa.cal2jd(steps["year"], steps["month"], 1)
    return jd1 + jd2, np.asarray(steps["tai_utc"], float)


def tt_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part Julian date in terrestrial time."""
    day, fraction = utc_julian_date(time_ns)
    return day, fraction + (tai_minus_utc_s(day) + TT_MINUS_TAI_S) / DAY_S


def julian_year(time_ns: Nanoseconds) -> Array:
    """Return the Julian epoch, such as 2019.25, in terrestrial time."""
    jd1, jd2 = tt_julian_date(time_ns)
    return 2000.0 + ((jd1 - 2451545.0) + jd2) / 365.25


def earth_barycentric(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return Earth's barycentric position [km] and velocity [km/s], (..., 3), ICRS axes.

    TT is used for TDB: they differ by less than 2 ms, which moves Earth's velocity by 1e-8 km/s.
    """
    _, barycentric = erfa.epv00(*tt_julian_date(time_ns))
    return barycentric["p"] * AU_KM, barycentric["v"] * (AU_KM / DAY_S)


def earth_velocity(time_ns: Nanoseconds) -> Array:
    """Return Earth's barycentric velocity [km/s], (n, 3), ICRS axes, at any number of times.

    Interpolated between full ten minutes, with errors of 1e-7 km/s, 50 times faster than
    `earth_barycentric`. The result at a time does not depend on the other times.
    """
    time_ns = np.asarray(time_ns, np.int64)
    node, rest = np.divmod(time_ns, NODE_NS)
    nodes, at = np.unique(node, return_inverse=True)
    _, before = earth_barycentric(nodes * NODE_NS)
    _, after = earth_barycentric((nodes + 1) * NODE_NS)
    share = (rest / NODE_NS)[:, None]
    return (1.0 - share) * before[at] + share * after[at]


def direction_to_sun(time_ns: Nanoseconds) -> Array:
    """Return unit vectors from the Earth to the Sun, (n, 3), ICRS axes, at any number of times.

    Those of the nearest ten minutes: within 0.004 degrees.
    """
    node = (np.asarray(time_ns, np.int64) + NODE_NS // 2) // NODE_NS
    nodes, at = np.unique(node, return_inverse=True)
    from_sun, _ = erfa.epv00(*tt_julian_date(nodes * NODE_NS))
    to_sun = -from_sun["p"]
    return np.asarray(to_sun / np.linalg.norm(to_sun, axis=1, keepdims=True))[at]


# Epochs


def frame_interval_ns(time_ns: Nanoseconds) -> int:
    """Return the usual interval between a sensor's frames [ns]; 0 with fewer than two."""
    steps = np.diff(np.unique(time_ns))
    return int(np.median(steps)) if len(steps) else 0


def frame_intervals_ns(time_ns: Nanoseconds) -> Nanoseconds:
    """Return the usual interval between a sensor's frames about each of them [ns], (n,).

    It is the median of the `NEAR_INTERVALS` nearest to the frame, or that of all where they are
    longer: frames may be faster for a while. 0 with fewer than two.

    Parameters
    ----------
    time_ns : (n,) int
        Frame times [ns], increasing.
    """
    steps, usual = np.diff(time_ns), frame_interval_ns(time_ns)
    out = np.full(len(time_ns), usual, np.int64)
    if len(steps) <= NEAR_INTERVALS:
        return out
    near = np.median(np.lib.stride_tricks.sliding_window_view(steps, NEAR_INTERVALS), axis=1)
    first = np.arange(len(time_ns)) - NEAR_INTERVALS // 2
    return np.asarray(np.maximum(out, near[np.clip(first, 0, len(near) - 1)].astype(np.int64)))


def epoch_interval_ns(intervals_ns: list[int]) -> int:
    """Return the slowest sensor's frame interval [ns], rounded to 1 ms, at least 1 ms.

    Rounding keeps the grid fixed from night to night, whatever the jitter of the exposures.
    Without any interval it is one second.
    """
    slowest = max(intervals_ns, default=0)
    return max(round(slowest / MILLISECOND_NS), 1) * MILLISECOND_NS if slowest else 1_000_000_000


def instants_of(time_ns: Nanoseconds, apart_ns: int) -> Nanoseconds:
    """Return the mean times [ns] of groups of frames, split at gaps of `apart_ns` or more.

    These are the epochs of a night in which no sensor has a frame interval, hence no grid.
    """
    time_ns = np.unique(time_ns)
    group = np.concatenate([[0], np.cumsum(np.diff(time_ns) >= apart_ns)]).astype(np.int64)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    if not len(time_ns):
        return time_ns
    since = time_ns - time_ns[first][group]
    return time_ns[first] + np.bincount(group, since).astype(np.int64) // np.bincount(group)


def epoch_grid(first_ns: int, last_ns: int, interval_ns: int) -> Nanoseconds:
    """Return all multiples of the interval since midnight UTC within [first, last], in ns.

    Counting from midnight makes the grid of a night independent of its logs.
    """
    out = []
    for day in range(first_ns // DAY_NS, last_ns // DAY_NS + 1):
        midnight = day * DAY_NS
        lo = max(first_ns - midnight + interval_ns - 1, 0) // interval_ns
        hi = min(last_ns - midnight, DAY_NS - 1) // interval_ns
        out.append(midnight + np.arange(lo, hi + 1, dtype=np.int64) * interval_ns)
    return np.concatenate(out) if out else np.zeros(0, np.int64)


def nearest_frame(epoch_ns: Nanoseconds, time_ns: Nanoseconds) -> Integers:
    """Return the index of the frame nearest to each epoch; the earlier one of a tie.

    Parameters
    ----------
    epoch_ns : (e,) int
        Epochs [ns].
    time_ns : (f,) int
        Frame times [ns], increasing, f >= 1.
    """
    after = np.clip(np.searchsorted(time_ns, epoch_ns), 1, max(len(time_ns) - 1, 1))
    after = np.minimum(after, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = (epoch_ns - time_ns[before]) <= (time_ns[after] - epoch_ns)
    return np.where(closer, before, after)


# Order and duplicates

# Share of a sensor's frames at which its counter may restart, unless no more than this share of the
# restarts begin higher than the one before: bursts may be numbered from 0. Two sensors with one id
# seem to restart at each second frame, and ever higher.
MAX_RESTARTS, MAX_HIGHER = 0.1, 0.25
MIN_UNCOUNTED = 3  # frames with one number: of two, one may be a copy with another time
LARGEST_NUMBER = 2**62  # with a restart after it, sums might not fit in 64 bits


def restart_shifts(time_ns: Integers, frame_number: Integers) -> Integers:
    """Return what to add to the frame numbers of a sensor so that none comes again, (n,).

    A counter restarts with its sensor, or begins again at its end. Then the numbers go on from the
    highest one before. It has restarted where the number falls, counts up from there, and numbers
    that were used since the last restart come again: the one it falls to, or those of two frames in
    succession before the next fall. A single wrong number does not count. Where all frames have one
    number, the counter was not written: they are numbered on from it, in order of time.

    Parameters
    ----------
    time_ns, frame_number : (n,) int
        In any order; a frame may be there several times.
    """
    if len(frame_number) and frame_number.min() == frame_number.max() <= LARGEST_NUMBER:
        times_ns, rank = np.unique(time_ns, return_inverse=True)
        return rank if len(times_ns) >= MIN_UNCOUNTED else np.zeros(len(rank), np.int64)
    order = np.lexsort((frame_number, time_ns))
    t, f = time_ns[order], frame_number[order]
    first = np.ones(len(f), np.bool_)
    first[1:] = (t[1:] != t[:-1]) | (f[1:] != f[:-1])
    number = f[first]
    falls = _falls(number)
    ends = np.append(falls[1:], len(number)).tolist()
    starts, shifts = [0], [0]
    used = _used_before(number)
    for fall, end in zip(falls.tolist(), ends, strict=False):
        again = (used[fall:end] >= starts[-1]) & (used[fall:end] < fall)
        if not again[0] and not (again[1:] & again[:-1]).any():
            continue
        highest = int(number[starts[-1] : fall].max()) + shifts[-1]
        if highest > LARGEST_NUMBER:
            break
        starts.append(fall)
        shifts.append(highest + 1 - int(number[fall]))
    of_number = np.repeat(shifts, np.diff(starts, append=len(number)))
    of_number[number > LARGEST_NUMBER] = 0  # with a shift it would not fit
    out = np.zeros(len(f), np.int64)
    out[order] = of_number[np.cumsum(first) - 1]
    return out


def _falls(number: Integers) -> Integers:
    """Return where the number falls and counts up from there; none if the numbers are of two
    sensors."""
    falls = np.flatnonzero(number[1:-1] < number[:-2]) + 1
    falls = falls[(number[falls + 1] > number[falls]) & (number[falls + 1] <= number[falls - 1])]
    higher = np.count_nonzero(np.diff(number[falls]) > 0)
    many = len(falls) > max(1, MAX_RESTARTS * len(number))
    if many and higher > MAX_HIGHER * len(falls):
        return falls[:0]
    # After a single wrong number, the count goes on as before it.
    return falls[(falls < 2) | (number[falls] <= number[falls - 2])]


def _used_before(number: Integers) -> Integers:
    """Return the last index before each at which the same number stands; -1: none."""
    by_number = np.argsort(number, kind="stable")
    same = number[by_number[1:]] == number[by_number[:-1]]
    used = np.full(len(number), -1)
    used[by_number[1:][same]] = by_number[:-1][same]
    return used


def order_frames(
    sensor: Integers, time_ns: Integers, frame_number: Integers
) -> tuple[Integers, npt.NDArray[np.int8]]:
    """Return the order of frames by sensor, time and number, and a verdict on each.

    Parameters
    ----------
    sensor, time_ns, frame_number : (n,) int
        The sensor as an index. Of equal frames the first is kept.

    Returns
    -------
    order : (n,) int
        Indices that sort the frames.
    verdict : (n,) int8
        In that order. KEEP: the frame is kept. DUPLICATE_FRAME: same sensor, number and time as
        a kept frame. DUPLICATE_NUMBER: same number as an earlier kept frame, at another time (as of
        two sensors with one id). DUPLICATE_TIME: same time as a kept frame with a lower number: a
        sensor makes one exposure at a time.
    """
    order = np.lexsort((np.arange(len(sensor)), frame_number, time_ns, sensor))
    s, t, f = sensor[order], time_ns[order], frame_number[order]
    verdict = np.zeros(len(order), np.int8)
    if len(order) == 0:
        return order, verdict
    same_time = (s[1:] == s[:-1]) & (t[1:] == t[:-1])
    same_frame = same_time & (f[1:] == f[:-1])
    verdict[1:][same_time] = DUPLICATE_TIME
    verdict[1:][same_frame] = DUPLICATE_FRAME
    # By number, in order of time: all but the first repeat the number.
    rest = np.flatnonzero(verdict == KEEP)
    by_number = rest[np.lexsort((rest, f[rest], s[rest]))]
    a, b = by_number[:-1], by_number[1:]
    verdict[b[(s[a] == s[b]) & (f[a] == f[b])]] = DUPLICATE_NUMBER
    # A copy of a frame that is not kept has the verdict of that frame.
    copied = np.maximum.accumulate(np.where(verdict == DUPLICATE_FRAME, 0, np.arange(len(s))))
    copies = verdict == DUPLICATE_FRAME
    verdict[copies] = np.where(verdict[copied] == KEEP, DUPLICATE_FRAME, verdict[copied])[copies]
    return order, verdict


def order_states(
    sensor: Integers, time_ns: Integers, has_attitude: Flags, position_sigma_km: Array
) -> tuple[Integers, Flags]:
    """Return the order of states by sensor and time, and which of them repeat their predecessor.

    A state repeats if sensor and time are the same. One with an attitude is kept, of several the
    one with the smallest position sigma (0: unknown), of equal ones the first given.
    """
    sigma_km = np.where(position_sigma_km > 0, position_sigma_km, np.inf)
    order = np.lexsort((np.arange(len(sensor)), sigma_km, ~has_attitude, time_ns, sensor))
    s, t = sensor[order], time_ns[order]
    repeats = np.zeros(len(order), bool)
    repeats[1:] = (s[1:] == s[:-1]) & (t[1:] == t[:-1])
    return order, repeats
