"""Motion of objects from span to span: velocities, independent positions, and object numbers.

- `velocities`: from positions.
- `neglected_motion`: the error of fitted directions because the fit neglects motion.
- `keep_independent`: selects positions of an object that share no detection.
- `ObjectRegistry`: an object keeps its number from span to span while one of its tracklets lasts.
"""

import itertools
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from epipole.schemas.arrays import Array, Indices, Integers
from epipole.tasks.algorithms.earth_gravity import gravity
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.kernels import kernel

# Least weight of a position in a velocity, over that of the best one of its object: the sums of
# smaller ones would be lost in rounding.
MIN_WEIGHT = 1e-5
# Positions that are nearer in time are of one epoch: their slope is only rounding [s].
MIN_APART_S = 2e-3


def velocities(
    offsets: Integers, time_s: Array, r_km: Array, half_s: float, sigma_km: Array | None = None
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
    sigma_km : (n,) float, optional
        1-sigma errors of the positions [km], which then weigh. Default: all are alike.

    Returns
    -------
    v_km_s : (n, 3) float
        Velocities [km/s]; 0 where the window has a single position.
    spread_s : (n,) float
        Rms distance of the window's times from their mean, weighted [s]; 0 where the window has a
        single position. An error that the positions share in part changes the velocity by at most
        the error over this.

    Notes
    -----
    The effect of gravity, at the window's mean position, is removed: it would bias the slope of a
    window that is longer on one side.
    """
    v_km_s, spread_s = np.zeros_like(r_km), np.zeros(len(r_km))
    for lo, hi in itertools.pairwise(offsets):
        known = lo + np.flatnonzero(np.isfinite(r_km[lo:hi, 0]))
        if len(known) < 2:
            continue
        t, x = time_s[known] - time_s[known[0]], r_km[known] - r_km[known[0]]
        weight = np.ones(len(known)) if sigma_km is None else _weights(sigma_km[known])
        window = _Window(t, weight, time_s[lo:hi] - time_s[known[0]], half_s)
        slope, spread = _slopes(window, x, r_km[known[0]])
        # Not by the spread: of a single poor position beside many good ones it is rounding.
        several = (window.lasts_s() > MIN_APART_S) & (spread > 0.0)
        v_km_s[lo:hi] = np.where(several[:, None], slope, 0.0)
        spread_s[lo:hi] = np.where(several, np.sqrt(np.maximum(spread, 0.0)), 0.0)
    return v_km_s, spread_s


def _weights(sigma_km: Array) -> Array:
    """Return the weights of an object's positions: 1 for the best, `MIN_WEIGHT` at least."""
    ratio = np.divide(sigma_km.min(), sigma_km, out=np.ones_like(sigma_km), where=sigma_km > 0.0)
    return np.maximum(ratio**2, MIN_WEIGHT)


class _Window:
    """Weighted sums of an object's positions, at times t [s], within `half_s` of each time `at`."""

    def __init__(self, t: Array, weight: Array, at: Array, half_s: float) -> None:
        self.t, self.weight, self.at = t, weight, at
        self._first = np.searchsorted(t, at - half_s, side="left")
        self._last = np.searchsorted(t, at + half_s, side="right")

    def total(self, values: Array) -> Array:
        """Return the weighted sum of some values of the positions in each window."""
        weighted = (values.T * self.weight).T
        running = np.concatenate([np.zeros_like(weighted[:1]), np.cumsum(weighted, axis=0)])
        return np.asarray(running[self._last] - running[self._first])

    def lasts_s(self) -> Array:
        """Return the time from the first to the last position in each window; 0 without any."""
        first, last = np.minimum(self._first, len(self.t) - 1), np.maximum(self._last - 1, 0)
        return np.where(self._last > self._first, self.t[last] - self.t[first], 0.0)


def _slopes(window: _Window, x: Array, origin_km: Array) -> tuple[Array, Array]:
    """Return the slope of the positions in each window [km/s], and the mean square distance of
    their times from the mean time [s^2].

    x (n, 3) are the positions from `origin_km` (3,) [km] on.
    """
    t, at = window.t, window.at
    n = window.total(np.ones(len(t)))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_t, square = window.total(t) / n, window.total(t * t) / n
        mean_x = window.total(x) / n[:, None]
        spread = square - mean_t**2
        cross = window.total(t[:, None] * x) / n[:, None] - mean_t[:, None] * mean_x
        # The slope of half the square of the time since `at`.
        bent = (window.total(t * t * t) / n - mean_t * square) / 2 - at * spread
        fall = gravity(origin_km + mean_x)
        return (cross - bent[:, None] * fall) / spread[:, None], spread


def neglected_motion(object_state: Array, sensor_state: Array, moments: Array) -> Array:
    """Return the error of fitted directions because the fit neglects a part of the motion.

    A direction fitted to detections around an instant is their weighted mean. It differs from
    the direction at the instant by the moments of the times, times the derivatives of the
    direction. For a low sensor, a geostationary object and 6 s on both sides the error is 0.3
    arcsec, with the same sign in each fit: as if the sensor were 50 m nearer to the Earth.

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
    reach = lengths(at[0])[:, None]
    away, rate, bend, jerk = (derivative / reach for derivative in at)

    def along(a: Array, b: Array) -> Array:
        return np.einsum("ij,ij->i", a, b)[:, None]

    # Derivatives of u = d / rho from those of d = rho u, all divided by rho.
    rate_rho = along(away, rate)
    u1 = rate - rate_rho * away
    bend_rho = along(away, bend) + along(u1, u1)
    u2 = bend - bend_rho * away - 2 * rate_rho * u1
    jerk_rho = along(away, jerk) + 3 * rate_rho * along(u1, u1) + 3 * along(u1, u2)
    u3 = jerk - jerk_rho * away - 3 * bend_rho * u1 - 3 * rate_rho * u2
    off = moments[:, :1] * u1 + moments[:, 1:2] * u2 / 2 + moments[:, 2:] * u3 / 6
    return np.asarray(off - along(away, off) * away)


def _derivatives(state: Array) -> tuple[Array, Array, Array, Array]:
    """Return position, velocity, acceleration by gravity and its derivative, each (n, 3)."""
    r, v = state[:, :3], state[:, 3:]
    return r, v, gravity(r), (gravity(r + v / 2) - gravity(r - v / 2))  # over one second


@kernel
def keep_independent(offsets, used, track, first_ns, last_ns, until, apart):
    """Clear `apart` where a group shares a detection with an earlier one that is kept.

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k, one object at one epoch, has the views ``offsets[k]:offsets[k + 1]``. The groups
        are in order of time.
    used : (n,) bool
        Whether the view is used.
    track : (n,) int
        Tracklet of the view, from 0.
    first_ns, last_ns : (n,) int
        Times of the first and last detection that the view's direction was fitted to.
    until : (tracklets,) int, in and out
        In: before all times. Out: the last detection of each tracklet in a kept group.
    apart : (g,) bool, in and out
        In: the groups that may be kept. Out: the groups that are kept.
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

    A group gets the number that most of its tracklets had last. If two groups would get one number,
    the group with more of its tracklets gets it. Ties go to the lower number, so the result depends
    on the order of the spans only.

    Parameters
    ----------
    weight : (t,) float
        Weight of each tracklet; 1 without. A long tracklet rarely mixes two objects, a short one
        often.
    """

    def __init__(self, weight: Array | None = None) -> None:
        self._weight = weight
        self._object_of: dict[int, int] = {}
        self._count = 0

    def name_groups(self, groups: Sequence[Indices]) -> list[int]:
        """Return the object number of each group of tracklets of one span."""
        votes = []
        for g, members in enumerate(groups):
            votes_of: dict[int, float] = defaultdict(float)
            for t in members.tolist():
                if t in self._object_of:
                    votes_of[self._object_of[t]] += 1.0 if self._weight is None else self._weight[t]
            votes += [(-weight, number, g) for number, weight in votes_of.items()]
        named: dict[int, int] = {}
        given: set[int] = set()
        for _, number, g in sorted(votes):
            if g not in named and number not in given:
                named[g] = number
                given.add(number)
        for g, members in enumerate(groups):
            if g not in named:
                named[g] = self._count
                self._count += 1
            for t in members.tolist():
                self._object_of[t] = named[g]
        return [named[g] for g in range(len(groups))]
