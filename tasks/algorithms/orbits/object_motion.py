"""Motion of objects from span to span: velocities, independent positions, and object numbers.

- `velocities` and `neglected_motion`: velocities from positions, and the part of the motion that a
  fit of directions neglects.
- `keep_independent`: positions of an object that share no detection.
- `ObjectRegistry`: an object keeps its number from span to span while one of its tracklets lasts.
"""

import itertools
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbits.state_interpolation import gravity

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def velocities(
    offsets: npt.NDArray[np.int64], time_s: Array, r_km: Array, half_s: float
) -> tuple[Array, Array]:
    """Return each position's velocity: the slope of its object's positions around it.

    Parameters
    ----------
    offsets : (g + 1,) int
        Object k has the positions ``offsets[k]:offsets[k + 1]``, in time order.
    time_s, r_km : (n,), (n, 3) float
        Times [s] and positions [km], GCRF; NaN positions are skipped.
    half_s
        Half width of the window about each position [s].

    Returns
    -------
    v_km_s : (n, 3) float
        Velocities [km/s]; 0 where the window holds a single position.
    spread_s : (n,) float
        Rms distance of the window's times from their mean [s]: an error that the window's
        positions share in part makes an error of the velocity of at most itself over this. 0
        where the window holds a single position.

    Notes
    -----
    Gravity's part, taken at the window's mean position, is removed: it would turn the slope where
    the window is longer on one side.
    """
    v_km_s, spread_s = np.zeros_like(r_km), np.zeros(len(r_km))
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
        mean_t, square = total(t) / n, total(t * t)
        spread = square - n * mean_t**2
        cross = total(t[:, None] * x) - mean_t[:, None] * total(x)
        # The slope of half the square of the time since `at`.
        bent = (total(t * t * t) - mean_t * square) / 2 - at * spread
        fall = gravity(r_km[known[0]] + total(x) / n[:, None])
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = (cross - bent[:, None] * fall) / spread[:, None]
        # Below 1e-6 s^2 all positions are of one epoch, and the slope is rounding.
        several = spread > 1e-6
        v_km_s[lo:hi] = np.where(several[:, None], slope, 0.0)
        spread_s[lo:hi] = np.where(several, np.sqrt(np.maximum(spread, 0.0) / n), 0.0)
    return v_km_s, spread_s


def neglected_motion(object_state: Array, sensor_state: Array, moments: Array) -> Array:
    """Return how far fitted directions lie from the true ones, because motion was neglected.

    A direction fitted to detections around an instant is their weighted mean. It differs from
    the direction at the instant by the moments of their times, times the derivatives of the
    direction. For a low sensor, a geostationary object and 6 s on both sides these are 0.3 arcsec,
    towards the same side in each fit: as if the sensor were 50 m nearer to the Earth.

    Parameters
    ----------
    object_state, sensor_state : (n, 6) float
        Position [km] and velocity [km/s] of the object and of the sensor, GCRF.
    moments : (n, 3) float
        Weighted means of (time minus instant)^1, ^2, ^3 [s, s^2, s^3]; see `LocalMotion`.

    Returns
    -------
    (n, 3) float
        Fitted minus true direction, at right angles to the true one [rad].
    """
    at = [
        a - b for a, b in zip(_derivatives(object_state), _derivatives(sensor_state), strict=True)
    ]
    reach = np.linalg.norm(at[0], axis=1, keepdims=True)
    away, rate, bend, jerk = (derivative / reach for derivative in at)

    def along(a: Array, b: Array) -> Array:
        return np.einsum("ij,ij->i", a, b)[:, None]

    # Derivatives of u = d / rho, from those of d = rho u; all over rho.
    rate_rho = along(away, rate)
    u1 = rate - rate_rho * away
    bend_rho = along(away, bend) + along(u1, u1)
    u2 = bend - bend_rho * away - 2 * rate_rho * u1
    jerk_rho = along(away, jerk) + 3 * rate_rho * along(u1, u1) + 3 * along(u1, u2)
    u3 = jerk - jerk_rho * away - 3 * bend_rho * u1 - 3 * rate_rho * u2
    off = moments[:, :1] * u1 + moments[:, 1:2] * u2 / 2 + moments[:, 2:] * u3 / 6
    return np.asarray(off - along(away, off) * away)


def _derivatives(state: Array) -> tuple[Array, Array, Array, Array]:
    """Return position, velocity, acceleration by gravity, and its rate."""
    r, v = state[:, :3], state[:, 3:]
    return r, v, gravity(r), (gravity(r + v / 2) - gravity(r - v / 2))  # over one second


@kernel
def keep_independent(offsets, used, track, first_ns, last_ns, until, apart):
    """Clear `apart` where a group shares a detection with an earlier one that is kept.

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k, one object at one epoch, has the views ``offsets[k]:offsets[k + 1]``; in order of
        time.
    used : (n,) bool
        The view counts.
    track : (n,) int
        Its tracklet, from 0 on.
    first_ns, last_ns : (n,) int
        The first and the last detection that its direction was fitted to.
    until : (tracklets,) int, out
        Starts below all times: then the last detection of each tracklet that a kept group uses.
    apart : (g,) bool, in and out
        The groups that may be kept; then those that are.
    """
    for g in range(len(apart)):
        for v in range(offsets[g], offsets[g + 1]):
            if used[v] and not first_ns[v] > until[track[v]]:
                apart[g] = False
        if apart[g]:
            for v in range(offsets[g], offsets[g + 1]):
                if used[v]:
                    until[track[v]] = last_ns[v]


class ObjectRegistry:
    """Numbers for groups of tracklets, span after span.

    A group gets the object that most of its tracklets belonged to last. Of two groups that
    claim one object, the one with more of its tracklets gets it. Ties are decided by the lower
    number, so the result depends on the order of the spans only.

    Parameters
    ----------
    weight : (t,) float
        What each tracklet counts, one if missing. A long tracklet is rarely of two objects, a
        short one often.
    """

    def __init__(self, weight: npt.NDArray[np.float64] | None = None) -> None:
        self._weight = weight
        self._object_of: dict[int, int] = {}
        self._count = 0

    def name_groups(self, groups: Sequence[Indices]) -> list[int]:
        """Return the object number of each group of tracklets of one span."""
        claims = []
        for g, members in enumerate(groups):
            held: dict[int, float] = defaultdict(float)
            for t in members.tolist():
                if t in self._object_of:
                    held[self._object_of[t]] += 1.0 if self._weight is None else self._weight[t]
            claims += [(-weight, number, g) for number, weight in held.items()]
        named: dict[int, int] = {}
        for _, number, g in sorted(claims):
            if g not in named and number not in named.values():
                named[g] = number
        for g, members in enumerate(groups):
            if g not in named:
                named[g] = self._count
                self._count += 1
            for t in members.tolist():
                self._object_of[t] = named[g]
        return [named[g] for g in range(len(groups))]
