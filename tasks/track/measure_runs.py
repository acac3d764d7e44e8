"""Measure runs: the rate and residual of each track, and which of them stand still like stars."""

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.runs import NONE
from epipole.tasks.common.sightings import Frames, Sightings

Array = npt.NDArray[np.float64]

STAR_RATE_SIGMA = 4.0  # a run whose rate is smaller than this many sigmas stands still
# rad/s: a slower run stands still, however well its rate is known. Errors of the optics of a tenth
# of a pixel let stars drift this fast. Objects in orbit move by arcseconds per second.
STAR_DRIFT = 0.05 * ARCSEC
STAR_RATE_KNOWN = 1.0 * ARCSEC  # rad/s: with a larger sigma, a run is not taken for a star


class TrackRun(NamedTuple):
    """The sightings of one track, in order of time, and its motion."""

    members: npt.NDArray[np.int64]
    rate_rad_s: float
    stands_still: bool
    residual_px: float


def measure_runs(
    frames: Frames,
    sightings: Sightings,
    track: npt.NDArray[np.int64],
    camera: Camera,
    window_s: float,
) -> list[TrackRun]:
    """Return the runs of tracks, by track number.

    Parameters
    ----------
    track : (n,) int
        Track of each sighting; NONE where it belongs to none.
    window_s
        Half-width of the local motion that residuals are taken from.
    """
    order = np.lexsort((sightings.frame, track))
    order = order[track[order] != NONE]
    bounds = np.flatnonzero(np.diff(track[order], prepend=NONE, append=NONE))
    time_s = (frames.time_ns[sightings.frame] - frames.time_ns[0]) / 1e9
    first = np.repeat(bounds[:-1], np.diff(bounds))
    last = np.repeat(bounds[1:], np.diff(bounds))
    u, t = np.take(sightings.u_icrs, order, axis=0), time_s[order]
    noise = np.take(sightings.cov_noise, order, axis=0)
    bias = np.take(sightings.cov_bias, order, axis=0)
    smooth, *_ = directions_at(first, last, t, 0.0, t, u, noise, bias, window_s)
    miss = np.linalg.norm(u - smooth, axis=1)
    variance = np.trace(noise, axis1=1, axis2=2)
    runs = []
    for lo, hi in itertools.pairwise(bounds):
        members = order[lo:hi]
        rate, sigma = _mean_rate(t[lo:hi], u[lo:hi], variance[lo:hi])
        still = rate < max(STAR_RATE_SIGMA * sigma, STAR_DRIFT) and sigma < STAR_RATE_KNOWN
        residual = float(np.sqrt(np.mean(miss[lo:hi] ** 2) / 2)) / camera.pixel_rad
        runs.append(TrackRun(members, rate, still, residual))
    return runs


def _mean_rate(time_s: Array, u: Array, variance: Array) -> tuple[float, float]:
    """Return the mean rate of a run and its 1-sigma error [rad/s].

    `variance` is the trace of each direction's independent error [rad^2].
    """
    t = time_s - time_s.mean()
    lever = float(np.sum(t * t))
    slope = t @ (u - u[0]) / lever
    sigma = np.sqrt(np.mean(variance) / lever)
    return float(np.linalg.norm(slope)), float(sigma)
