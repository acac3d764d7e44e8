"""The offset of all times from UTC, by known objects.

A log whose times are all GPS or TAI is consistent in itself: lines of sight meet, at a wrong time.
Satellites of a catalogue show it: all of them are early or late.

1. Tracklets are compared with the catalogue at their times. If few are known satellites, other
   offsets are tried: those in use, and some seconds. The one with most known satellites is taken.
2. There, each satellite is ahead of its prediction by some time. The times are moved by their
   weighted median and compared again, until it is nearly 0.
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

# Other offsets are tried if the known satellites are a smaller share of the tracklets than this. A
# catalogue of one in ten objects has as many; with times that are 4 s off, one in twenty is known.
FEW_KNOWN = 0.1
# Steps of the other offsets, and the largest [s]: at 2 s off, a third of the tracklets are known.
STEP_S, FARTHEST_S = 3.0, 45.0
MIN_KEPT = 0.9  # minimum share of the known satellites that are left when the times are moved
MAX_ROUNDS = 6  # of moving the times: 2 s are found in three
SETTLED_S = 0.01
# Half of the normal distribution lies within this many sigmas: a median of that many satellites has
# a sigma of 1.25 / sqrt(n) of one.
MAD_TO_SIGMA, MEDIAN_SIGMA = 1.4826, 1.2533
# Error that all low satellites share: unforeseen drag puts them 1 km ahead a day after the epoch of
# their elements, as seen in `prediction.LOW_ORBIT`.
SHARED_SIGMA_S = 0.1


class TimeOffset(NamedTuple):
    """How far all times are from UTC.

    offset_s, sigma_s : float
        Written time minus UTC, and its 1-sigma error; NaN where no satellite is known.
    n_known : int
        Number of tracklets that are known satellites, with this offset.
    n_as_written : int
        The same with the times as written.
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
    as_written = _known_pairs(tracklets, catalogue, 0.0)
    best_s, best = 0.0, as_written
    few = len(as_written.tracklet) < FEW_KNOWN * len(tracklets.time_ns)
    steps_s = np.arange(STEP_S, FARTHEST_S + STEP_S / 2, STEP_S)
    for offset_s in [*in_use_s, *(-steps_s).tolist(), *steps_s.tolist()] if few else []:
        known = _known_pairs(tracklets, catalogue, offset_s)
        if len(known.tracklet) > len(best.tracklet):
            best_s, best = offset_s, known
    if not len(best.tracklet):
        return TimeOffset(np.nan, np.nan, 0, 0)
    sigma_s = np.nan
    for _ in range(MAX_ROUNDS):
        ahead_s, sigma_s = _time_ahead(_moved(tracklets, best_s), best, catalogue)
        moved = _known_pairs(tracklets, catalogue, best_s - ahead_s)
        if len(moved.tracklet) < MIN_KEPT * len(best.tracklet):
            break
        best_s, best = best_s - ahead_s, moved
        if abs(ahead_s) < SETTLED_S:
            break
    return TimeOffset(best_s, sigma_s, len(best.tracklet), len(as_written.tracklet))


def _moved(tracklets: SeenTracklets, offset_s: float) -> SeenTracklets:
    return tracklets._replace(time_ns=tracklets.time_ns - round(offset_s * SECOND_NS))


def _known_pairs(tracklets: SeenTracklets, catalogue: KnownSatellites, offset_s: float) -> Pairs:
    """Return the sure pairs of a tracklet and its satellite, with an offset of the times."""
    moved = _moved(tracklets, offset_s)
    pairs = match_tracklets(moved, catalogue)
    names = judge_tracklets(len(moved.time_ns), pairs, weigh_pairs(moved, pairs, catalogue), SURE)
    return pairs.take(names.pair[names.status == "known"])


def _time_ahead(
    tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites
) -> tuple[float, float]:
    """Return the median time [s] by which satellites are ahead of predictions, and its sigma.

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
    ahead_s = np.sum(weighted * offset, axis=1) / information
    median_s = _weighted_median(ahead_s, information)
    scatter_s = MAD_TO_SIGMA * float(np.median(np.abs(ahead_s - median_s)))
    sigma_s = MEDIAN_SIGMA * max(
        scatter_s / np.sqrt(len(ahead_s)), 1.0 / np.sqrt(float(information.sum()))
    )
    return median_s, float(np.hypot(sigma_s, SHARED_SIGMA_S))


def _weighted_median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])
