"""Object linking: an object is recognised after a gap by its motion.

The state of an earlier object is propagated to the instant of a later one. A likelihood ratio
decides whether they are one object: the density of the difference of the states under both
covariances, against the density of new objects. The latter is taken from the objects nearby.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv, gammaln

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.earth_gravity import propagate_states
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory

# Returns the last state of an object after times (m,) [s], (m, 6), with covariances (m, 6, 6).
Mover = Callable[[int, Array], tuple[Array, Array]]

NONE = -1
MAX_ENERGY_SIGMA = 10.0  # gate of the difference of the energies
OBLATENESS_SHARE = 2e-3  # share of the two-body energy that varies because of J2
GATE_SHARE = 0.9999  # share of true links that pass the chi-square test
# Minimum density of objects [1/km^3]: that of all tracked objects in low orbit.
MIN_DENSITY_KM3 = 1e-8
VELOCITIES_KM3_S3 = 1.0  # volume that their velocities fill, about
MARGIN_S = 1.0  # of times that are looked up by rounded sums; the gap itself is compared after it
STEP_S = 60.0  # longest step of objects that are seen at one time: right to some metres
# Neglected accelerations: of Sun and Moon at geostationary height; of the higher harmonics, as a
# share of gravity.
ACCELERATION_KM_S2 = 1e-8
SHARE_OF_GRAVITY = 1e-5


class ObservedMotions(NamedTuple):
    """Objects with their states at the beginning and at the end of their observation.

    first_s, last_s : (n,) float
        First and last instant of observation [s].
    head_s, tail_s : (n,) float
        Instants of the states near the first and near the last [s].
    head, tail : (n, 6) float
        Position [km] and velocity [km/s], GCRF; the velocity is NaN where unknown.
    head_cov, tail_cov : (n, 6, 6) float
        Covariances.
    """

    first_s: Array
    last_s: Array
    head_s: Array
    tail_s: Array
    head: Array
    tail: Array
    head_cov: Array
    tail_cov: Array


def link_by_motion(
    motions: ObservedMotions,
    *,
    gap_s: float,
    log_odds: float,
    allowed: Flags | None = None,
    moved: Mover | None = None,
) -> tuple[Indices, Array]:
    """Return which earlier object each object continues.

    Parameters
    ----------
    motions
        Objects, in any order. Of two that are linked, at least one velocity must be known.
    gap_s
        Longest time between the observations [s].
    log_odds
        Minimum log odds of a link, also against any contradicting link of its two objects. So an
        object is not linked if two others could continue it equally well.
    allowed : (n, n) bool
        Whether the first may continue as the second; None: any.
    moved
        Moves the last state of an earlier object, whose velocity is known. None: two bodies and J2,
        with process noise for the neglected forces.

    Returns
    -------
    before : (n,) int
        The object that each object continues, -1 for a new one. No two continue the same.
    odds : (n,) float
        Log odds of the link by which an object was recognised; NaN for a new object.

    Notes
    -----
    Errors that the sensors keep over the gap are counted in both states: the test is conservative.
    """
    n = len(motions.first_s)
    before, odds = np.full(n, NONE), np.full(n, np.nan)
    pairs = _pairs(motions, gap_s, allowed, moved)
    links = _Links(motions, gap_s, pairs, _log_odds_of_pairs(motions, pairs))
    for members, joined in links.joined(log_odds):
        for k in range(1, len(members)):
            before[members[k]], odds[members[k]] = members[k - 1], joined[members[k]]
    return before, odds


def chains(before: Indices) -> Indices:
    """Return the first object of each object's chain of links; `before` is of `link_by_motion`."""
    head = np.where(before == NONE, np.arange(len(before)), before)
    while (head[head] != head).any():
        head = head[head]
    return head


class _CandidatePairs(NamedTuple):
    """Pairs of an earlier and a later object, and the difference of their motions.

    `apart` (p, 6) is the state of the later object minus the propagated state of the earlier one;
    its velocity is NaN where either is unknown. `d2` (p,) is its squared Mahalanobis distance, by
    position alone without a velocity. `near` (q,) are the rows of which this passes the chi-square
    test, `cov` (q, 6, 6) their covariances: those of all pairs would fill the memory.
    """

    earlier: Indices
    later: Indices
    apart: Array
    d2: Array
    near: Indices
    cov: Array


def _pairs(
    motions: ObservedMotions,
    gap_s: float,
    allowed: Flags | None = None,
    moved: Mover | None = None,
) -> _CandidatePairs:
    """Return the pairs that may be one object, by time and energy, with their differences."""
    may_be = _PossiblePairs(motions, gap_s, allowed)
    moving, moves = np.isfinite(motions.tail[:, 3]), np.isfinite(motions.head[:, 3])
    parts = []
    for i in np.flatnonzero(moving):  # forward, from each earlier object
        later = may_be.later(int(i))
        if not len(later):
            continue
        later = later[np.argsort(motions.head_s[later], kind="stable")]
        dt_s = motions.head_s[later] - motions.tail_s[i]
        if moved is None:
            state, cov = _propagated(motions.tail[i], motions.tail_cov[i], dt_s)
        else:
            state, cov = moved(int(i), dt_s)
        earlier = np.full(len(later), i)
        apart = motions.head[later] - state
        parts.append(_compared(earlier, later, apart, motions.head_cov[later] + cov))
    for j in np.flatnonzero(moves):  # backward, to earlier objects of unknown velocity
        earlier = may_be.earlier(int(j))
        earlier = earlier[~moving[earlier]]
        if not len(earlier):
            continue
        earlier = earlier[np.argsort(-motions.tail_s[earlier], kind="stable")]
        state, cov = _propagated(
            motions.head[j], motions.head_cov[j], motions.tail_s[earlier] - motions.head_s[j]
        )
        later = np.full(len(earlier), j)
        apart = state - motions.tail[earlier]
        parts.append(_compared(earlier, later, apart, motions.tail_cov[earlier] + cov))
    none = np.zeros(0, np.int64)
    parts.append(_compared(none, none, np.zeros((0, 6)), np.zeros((0, 6, 6))))
    before = np.cumsum([0, *(len(part.later) for part in parts)])
    parts = [part._replace(near=part.near + at) for part, at in zip(parts, before, strict=False)]
    return _CandidatePairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _compared(earlier: Indices, later: Indices, apart: Array, cov: Array) -> _CandidatePairs:
    """Return pairs with their distances, by the differences (p, 6) and covariances (p, 6, 6)."""
    d2, fits = np.full(len(later), np.inf), np.zeros(len(later), bool)
    is_moving = np.isfinite(apart).all(axis=1)
    for rows, size in ((np.flatnonzero(is_moving), 6), (np.flatnonzero(~is_moving), 3)):
        d, S = apart[rows, :size], cov[rows, :size, :size]
        d2[rows] = np.sum(d * np.linalg.solve(S, d[:, :, None])[:, :, 0], axis=1)
        fits[rows] = d2[rows] < 2 * gammaincinv(size / 2, GATE_SHARE)  # chi-square
    near = np.flatnonzero(fits)
    return _CandidatePairs(earlier, later, apart, d2, near, cov[near])


class _PossiblePairs:
    """Which objects agree in time and energy, object by object: all pairs would fill the memory.

    The energy is a fast, wide gate: two-body motion keeps it, and J2 changes it by a thousandth.
    Objects of unknown energy pass.
    """

    def __init__(self, motions: ObservedMotions, gap_s: float, allowed: Flags | None) -> None:
        self._motions, self._gap_s, self._allowed = motions, gap_s, allowed
        self._by_first = np.argsort(motions.first_s, kind="stable")
        self._by_last = np.argsort(motions.last_s, kind="stable")
        self._first, self._last = motions.first_s[self._by_first], motions.last_s[self._by_last]
        self._tail = _energy(motions.tail, motions.tail_cov)
        self._head = _energy(motions.head, motions.head_cov)

    def later(self, i: int) -> Indices:
        """Return the objects that object i may continue as."""
        last = self._motions.last_s[i]
        at = np.searchsorted(self._first, [last, last + self._gap_s + MARGIN_S])
        later = np.sort(self._by_first[at[0] : at[1]])
        return np.asarray(later[self._agree(np.full(len(later), i), later)])

    def earlier(self, j: int) -> Indices:
        """Return the objects that may continue as object j."""
        first = self._motions.first_s[j]
        at = np.searchsorted(self._last, [first - self._gap_s - MARGIN_S, first])
        earlier = np.sort(self._by_last[at[0] : at[1]])
        return np.asarray(earlier[self._agree(earlier, np.full(len(earlier), j))])

    def _agree(self, earlier: Indices, later: Indices) -> Flags:
        gap = self._motions.first_s[later] - self._motions.last_s[earlier]
        tail, head = self._tail[0][earlier], self._head[0][later]
        sigma = np.sqrt(self._tail[1][earlier] + self._head[1][later])
        gate = MAX_ENERGY_SIGMA * sigma + OBLATENESS_SHARE * np.abs(head)
        agree = (gap > 0.0) & (gap <= self._gap_s) & ~(np.abs(tail - head) > gate)
        return agree if self._allowed is None else agree & self._allowed[earlier, later]


def _energy(state: Array, cov: Array) -> tuple[Array, Array]:
    """Return the energy of states [km^2/s^2] and its variance."""
    r, v = state[:, :3], state[:, 3:]
    distance = np.linalg.norm(r, axis=1)
    slope = np.concatenate([GM_KM3_S2 * r / distance[:, None] ** 3, v], axis=1)
    energy = np.sum(v * v, axis=1) / 2 - GM_KM3_S2 / distance
    return energy, np.einsum("ni,nij,nj->n", slope, cov, slope)


def _log_odds_of_pairs(motions: ObservedMotions, pairs: _CandidatePairs) -> Array:
    """Return the log odds of each pair; -inf where the difference is too large."""
    gain = np.full(len(pairs.later), -np.inf)
    order = np.argsort(pairs.later, kind="stable")
    bounds = np.searchsorted(pairs.later[order], np.arange(len(motions.first_s) + 1))
    of_near = pairs.later[pairs.near]
    for j in np.unique(of_near).tolist():
        same_later = order[bounds[j] : bounds[j + 1]]
        present, past = _differences_to_present(motions, j), pairs.earlier[same_later]
        for n in np.flatnonzero(of_near == j):
            k = pairs.near[n]
            i, size = pairs.earlier[k], 6 if np.isfinite(pairs.apart[k]).all() else 3
            S = pairs.cov[n, :size, :size]
            # Objects that were observed at the same time are different objects.
            distinct = (motions.first_s[past] <= motions.last_s[i]) & (
                motions.last_s[past] >= motions.first_s[i]
            )
            others = np.concatenate([pairs.apart[same_later[distinct & (past != i)]], present])
            density = _log_density(others[:, :size], S)
            gain[k] = -pairs.d2[k] / 2 - np.linalg.slogdet(2 * np.pi * S)[1] / 2 - density
    return gain


def _propagated(state: Array, cov: Array, dt_s: Array) -> tuple[Array, Array]:
    """Return a state propagated by several times, with covariances.

    The variance of the neglected forces is half that of a constant acceleration and half that of
    white noise: the accelerations of Sun and Moon turn within hours.
    """
    propagated, transition = trajectory(state, dt_s)
    gravity = GM_KM3_S2 / float(state[:3] @ state[:3])
    neglected = ACCELERATION_KM_S2 + SHARE_OF_GRAVITY * gravity
    # Of position, of both, of velocity: constant acceleration, and white noise with the same
    # variance of the position.
    shares = np.array([[1 / 4, 1 / 2, 1.0], [1 / 4, 3 / 8, 3 / 4]]).mean(axis=0)
    of_position, of_both, of_velocity = (
        neglected**2 * shares[:, None] * dt_s ** np.array([[4], [3], [2]])
    )
    noise = np.zeros((len(dt_s), 6, 6))
    axes = np.arange(3)
    noise[:, axes, axes] = of_position[:, None]
    noise[:, axes, axes + 3] = noise[:, axes + 3, axes] = of_both[:, None]
    noise[:, axes + 3, axes + 3] = of_velocity[:, None]
    return propagated, transition @ cov @ np.swapaxes(transition, -1, -2) + noise


def _differences_to_present(motions: ObservedMotions, later: int) -> Array:
    """Return the later object's state minus the states of objects observed at the same time."""
    at = motions.head_s[later]
    present = (motions.first_s <= motions.last_s[later]) & (
        motions.last_s >= motions.first_s[later]
    )
    present[later] = False
    rows = np.flatnonzero(present)
    near_head = np.abs(motions.head_s[rows] - at) < np.abs(motions.tail_s[rows] - at)
    state = np.where(near_head[:, None], motions.head[rows], motions.tail[rows])
    dt_s = at - np.where(near_head, motions.head_s[rows], motions.tail_s[rows])
    is_moving = np.flatnonzero(np.isfinite(state[:, 3]))
    steps = int(np.ceil(np.abs(dt_s).max(initial=1.0) / STEP_S))
    r_km, v_km_s = np.split(state[is_moving], 2, axis=1)
    state[is_moving] = np.hstack(propagate_states(r_km, v_km_s, dt_s[is_moving], steps))
    return np.asarray(motions.head[later] - state)


def _log_density(apart: Array, S: Array) -> float:
    """Return the log density of objects about a state, from its nearest neighbour.

    One object per volume of the ellipsoid with the shape of S that reaches to the neighbour, per
    km^3, or per km^3 (km/s)^3 with velocities.
    """
    size = len(S)
    apart = apart[np.isfinite(apart).all(axis=1)]
    floor = np.log(MIN_DENSITY_KM3) - (np.log(VELOCITIES_KM3_S3) if size == 6 else 0.0)
    if not len(apart):
        return float(floor)
    d2 = np.einsum("ni,ni->n", apart, np.linalg.solve(S, apart.T).T).min()
    unit_ball = size / 2 * np.log(np.pi) - gammaln(size / 2 + 1)
    _, log_det = np.linalg.slogdet(S)
    nearest = unit_ball + size / 2 * np.log(max(d2, 1e-300)) + log_det / 2
    return float(max(-nearest, floor))


class _Links:
    """Possible links between objects, and the groups that they join.

    An object may be linked to several others: if one object was observed at three times and only
    one observation gives a velocity, each of the other two is compared with that one.
    """

    def __init__(
        self, motions: ObservedMotions, gap_s: float, pairs: _CandidatePairs, gain: Array
    ) -> None:
        self.motions, self.gap_s = motions, gap_s
        self.moves = np.isfinite(motions.tail[:, 3]) | np.isfinite(motions.head[:, 3])
        self.gain: dict[int, dict[int, float]] = {}
        likely = gain > 0.0
        rows = zip(pairs.earlier[likely], pairs.later[likely], gain[likely], strict=True)
        for i, j, of_pair in rows:
            self.gain.setdefault(int(i), {})[int(j)] = float(of_pair)
            self.gain.setdefault(int(j), {})[int(i)] = float(of_pair)

    def joined(self, log_odds: float) -> list[tuple[list[int], dict[int, float]]]:
        """Return the members of each group in order of time, and the log odds of their links.

        The links with the largest log odds join first.
        """
        edges = [
            (-gain, i, j)
            for i, others in self.gain.items()
            for j, gain in others.items()
            if i < j and gain >= log_odds
        ]
        group: dict[int, list[int]] = {}
        odds: dict[int, float] = {}
        for negative, i, j in sorted(edges):
            one, other = group.get(i, [i]), group.get(j, [j])
            if one is other or not all(self._compatible(a, b) for a in one for b in other):
                continue
            if self._has_rival(i, other, -negative - log_odds) or self._has_rival(
                j, one, -negative - log_odds
            ):
                continue
            odds |= {k: -negative for k in (i, j) if k not in odds}
            together = one + other
            group |= dict.fromkeys(together, together)
        groups = {id(members): members for members in group.values()}.values()
        return [(sorted(g, key=lambda k: self.motions.first_s[k]), odds) for g in groups]

    def _has_rival(self, i: int, others: list[int], minimum: float) -> bool:
        """Return whether i has a link above `minimum` to an object that contradicts the others."""
        return any(
            gain > minimum and not all(self._compatible(k, other) for other in others)
            for k, gain in self.gain[i].items()
            if k not in others
        )

    def _compatible(self, i: int, j: int) -> bool:
        """Return whether two objects may be one.

        Not if they were observed at the same time, or if their motions were compared and differ.
        """
        seen = self.motions
        gap = max(seen.first_s[i] - seen.last_s[j], seen.first_s[j] - seen.last_s[i])
        if not gap > 0.0:
            return False
        compared = gap <= self.gap_s and (self.moves[i] or self.moves[j])
        return not compared or j in self.gain.get(i, {})
