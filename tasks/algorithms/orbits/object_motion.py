"""Object motion: velocities from positions at neighbouring epochs."""

import itertools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def velocities(offsets: npt.NDArray[np.int64], time_s: Array, r_km: Array, half_s: float) -> Array:
    """Return each position's velocity: the slope of its object's positions around it.

    Parameters
    ----------
    offsets : (g + 1,) int
        Object k has the positions ``offsets[k]:offsets[k + 1]``, in time order.
    time_s, r_km : (n,), (n, 3) float
        Times [s] and positions [km]; NaN positions are skipped.
    half_s
        Half width of the window about each position [s].

    Returns
    -------
    (n, 3) float
        Velocities [km/s]; 0 where the window holds a single position.
    """
    out = np.zeros_like(r_km)
    for lo, hi in itertools.pairwise(offsets):
        known = lo + np.flatnonzero(np.isfinite(r_km[lo:hi, 0]))
        if len(known) < 2:
            continue
        t, x = time_s[known] - time_s[known[0]], r_km[known] - r_km[known[0]]
        at = time_s[lo:hi] - time_s[known[0]]
        first = np.searchsorted(t, at - half_s, side="left")
        last = np.searchsorted(t, at + half_s, side="right")

        def total(values: Array, first: Array = first, last: Array = last) -> Array:
            running = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
            return running[last] - running[first]

        n = np.maximum(last - first, 1)
        mean_t = total(t) / n
        spread = total(t * t) - n * mean_t**2
        cross = total(t[:, None] * x) - mean_t[:, None] * total(x)
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = cross / spread[:, None]
        # Below 1e-6 s^2 all positions are of one epoch, and the slope is rounding.
        out[lo:hi] = np.where((spread > 1e-6)[:, None], slope, 0.0)
    return out
