"""The offset of all times from UTC, by known objects.

A log whose times are all GPS or TAI is consistent in itself: lines of sight meet, at a wrong time.
Satellites of a catalogue show it: all of them are early or late.

1. Tracklets are compared with the catalogue at their times. If few are known satellites, they are
   compared at times that are off by each offset in use, and by seconds. The offset with most known
   satellites is taken.
2. There, each tracklet says how late its satellite is. Their weighted median moves the times, and
   they are compared again, until it stays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.known_objects.matching import SURE, KnownSatellites
from epipole.tasks.algorithms.known_objects.tracklet_matching import (
    ErrorsOfPairs,
    judge_tracklets,
    match_tracklets,
    residuals_of,
    weigh_pairs,
)
from epipole.tasks.algorithms.known_objects.tracklet_search import Pairs, SeenTracklets

# Fewer known satellites than this share of the tracklets, and other offsets are tried. A catalogue
# that has one in ten objects is spared that; times that are 4 s off leave one in twenty known.
FEW_KNOWN = 0.1
# Offsets that are not in use are tried as well [s]; a third of the tracklets are known when they
# are 2 s off.
STEP_S, FARTHEST_S = 3.0, 45.0
FEWER = 0.9  # share of the known satellites that times keep when they move to where the median is
MAX_ROUNDS = 6  # of moving the times: 2 s are found in three
SETTLED_S = 0.01
# Half of the normal distribution lies within this many sigmas: a median of that many satellites has
# a sigma of 1.25 / sqrt(n) of one.
MAD_TO_SIGMA, MEDIAN_SIGMA = 1.4826, 1.2533
# Drag that nobody foresaw shifts all low satellites alike: they are 1 km ahead a day after the
# epoch of their elements, as seen in `prediction.LOW_ORBIT`.
SHARED_SIGMA_S = 0.1


class TimeOffset(NamedTuple):
    """How far all times are from UTC.

    offset_s, sigma_s : float
        Written time minus UTC, and its 1-sigma error; NaN where no satellite is known.
    n_known : int
        Tracklets that are known satellites if their times are off by so much.
    n_as_written : int
        Those that are if the times are UTC.
    """

    offset_s: float
    sigma_s: float
    n_known: int
    n_as_written: int


def find_time_offset(
    tracklets: SeenTracklets, catalogue: KnownSatellites, in_use_s: Sequence[float]
) -> TimeOffset:
    """Return the offset of the tracklets' times from UTC.

    Parameters
    ----------
    tracklets
        Of objects that move unlike each other, a hundred or so.
    catalogue
        With usual errors of its elements. Those learnt from the same tracklets would hide an
        offset.
    in_use_s
        Offsets to try [s], such as those of other time scales and zones.
    """
    as_written = _sure(tracklets, catalogue, 0.0)
    best_s, best = 0.0, as_written
    few = len(as_written.tracklet) < FEW_KNOWN * len(tracklets.time_ns)
    steps_s = np.arange(STEP_S, FARTHEST_S + STEP_S / 2, STEP_S)
    for offset_s in [*in_use_s, *(-steps_s).tolist(), *steps_s.tolist()] if few else []:
        sure = _sure(tracklets, catalogue, offset_s)
        if len(sure.tracklet) > len(best.tracklet):
            best_s, best = offset_s, sure
    if not len(best.tracklet):
        return TimeOffset(np.nan, np.nan, 0, 0)
    sigma_s = np.nan
    for _ in range(MAX_ROUNDS):
        late_s, sigma_s = _lateness(_moved(tracklets, best_s), best, catalogue)
        moved = _sure(tracklets, catalogue, best_s - late_s)
        if len(moved.tracklet) < FEWER * len(best.tracklet):
            break
        best_s, best = best_s - late_s, moved
        if abs(late_s) < SETTLED_S:
            break
    return TimeOffset(best_s, sigma_s, len(best.tracklet), len(as_written.tracklet))


def _moved(tracklets: SeenTracklets, offset_s: float) -> SeenTracklets:
    return tracklets._replace(time_ns=tracklets.time_ns - round(offset_s * SECOND_NS))


def _sure(tracklets: SeenTracklets, catalogue: KnownSatellites, offset_s: float) -> Pairs:
    """Return the sure pairs of tracklets and satellites if the times are off by so much."""
    moved = _moved(tracklets, offset_s)
    pairs = match_tracklets(moved, catalogue)
    names = judge_tracklets(len(moved.time_ns), pairs, weigh_pairs(moved, pairs, catalogue), SURE)
    return pairs.take(names.pair[names.status == "known"])


def _lateness(
    tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites
) -> tuple[float, float]:
    """Return by how much satellites are ahead of their predictions [s], and its 1-sigma error.

    A satellite counts once: its tracklets share the error of its elements.
    """
    _, once = np.unique(pairs.satellite, return_index=True)
    pairs = pairs.take(np.sort(once))
    residuals = residuals_of(tracklets, pairs, catalogue)
    offset, cov, jacobian = (
        np.array([getattr(of, name) for of in residuals]) for name in ("offset", "cov", "jacobian")
    )
    errors = ErrorsOfPairs(catalogue, pairs.satellite, int(np.median(tracklets.time_ns)))
    sigma = errors.sigmas(pairs.satellite, np.array([of.age_days for of in residuals]))
    S = cov + (jacobian * sigma[:, None] ** 2) @ np.swapaxes(jacobian, 1, 2)
    per_s = jacobian[:, :, 0] * np.linalg.norm(pairs.states[:, 3:], axis=1)[:, None]
    weighted = np.linalg.solve(S, per_s[:, :, None])[:, :, 0]
    information = np.sum(weighted * per_s, axis=1)
    late_s = np.sum(weighted * offset, axis=1) / information
    middle_s = _weighted_median(late_s, information)
    scatter_s = MAD_TO_SIGMA * float(np.median(np.abs(late_s - middle_s)))
    sigma_s = MEDIAN_SIGMA * max(
        scatter_s / np.sqrt(len(late_s)), 1.0 / np.sqrt(float(information.sum()))
    )
    return middle_s, float(np.hypot(sigma_s, SHARED_SIGMA_S))


def _weighted_median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])
