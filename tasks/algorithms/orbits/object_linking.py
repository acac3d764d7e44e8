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
    its velocity is NaN where either is unknown. `cov` (p, 6, 6) is its covariance.
    """

    earlier: Indices
    later: Indices
    apart: Array
    cov: Array


def _pairs(
    motions: ObservedMotions,
    gap_s: float,
    allowed: Flags | None = None,
    moved: Mover | None = None,
) -> _CandidatePairs:
    """Return the pairs that may be one object, by time and energy, with their differences."""
    gap = motions.first_s - motions.last_s[:, None]
    in_time = (gap > 0.0) & (gap <= gap_s)
    if allowed is not None:
        in_time &= allowed
    moving, moves = np.isfinite(motions.tail[:, 3]), np.isfinite(motions.head[:, 3])
    kept = in_time & _energies_agree(motions)
    parts = []
    for i in np.flatnonzero(moving):  # forward, from each earlier object
        later = np.flatnonzero(kept[i])
        later = later[np.argsort(motions.head_s[later], kind="stable")]
        dt_s = motions.head_s[later] - motions.tail_s[i]
        if moved is None:
            state, cov = _propagated(motions.tail[i], motions.tail_cov[i], dt_s)
        else:
            state, cov = moved(int(i), dt_s)
        earlier = np.full(len(later), i)
        parts.append((earlier, later, motions.head[later] - state, motions.head_cov[later] + cov))
    for j in np.flatnonzero(moves):  # backward, to earlier objects of unknown velocity
        earlier = np.flatnonzero(kept[:, j] & ~moving)
        earlier = earlier[np.argsort(-motions.tail_s[earlier], kind="stable")]
        state, cov = _propagated(
            motions.head[j], motions.head_cov[j], motions.tail_s[earlier] - motions.head_s[j]
        )
        later = np.full(len(earlier), j)
        parts.append(
            (earlier, later, state - motions.tail[earlier], motions.tail_cov[earlier] + cov)
        )
    none = np.zeros(0, np.int64)
    parts.append((none, none, np.zeros((0, 6)), np.zeros((0, 6, 6))))
    return _CandidatePairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _energies_agree(motions: ObservedMotions) -> Flags:
    """Return which (earlier, later) pairs agree in energy; true where either is unknown.

    A fast, wide gate: two-body motion keeps the energy, and J2 changes it by a thousandth.
    """
    tail, tail_variance = _energy(motions.tail, motions.tail_cov)
    head, head_variance = _energy(motions.head, motions.head_cov)
    gate = MAX_ENERGY_SIGMA * np.sqrt(
        tail_variance[:, None] + head_variance
    ) + OBLATENESS_SHARE * np.abs(head)
    return ~(np.abs(tail[:, None] - head) > gate)


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
    cuts = np.flatnonzero(np.diff(pairs.later[order])) + 1
    for same_later in np.split(order, cuts) if len(order) else []:
        present = _differences_to_present(motions, int(pairs.later[same_later[0]]))
        past = pairs.earlier[same_later]
        for k in same_later:
            i, size = pairs.earlier[k], 6 if np.isfinite(pairs.apart[k]).all() else 3
            S, d = pairs.cov[k, :size, :size], pairs.apart[k, :size]
            d2 = float(d @ np.linalg.solve(S, d))
            if not d2 < 2 * gammaincinv(size / 2, GATE_SHARE):  # chi-square
                continue
            # Objects that were observed at the same time are different objects.
            distinct = (motions.first_s[past] <= motions.last_s[i]) & (
                motions.last_s[past] >= motions.first_s[i]
            )
            others = np.concatenate([pairs.apart[same_later[distinct & (past != i)]], present])
            density = _log_density(others[:, :size], S)
            gain[k] = -d2 / 2 - np.linalg.slogdet(2 * np.pi * S)[1] / 2 - density
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
    out = np.empty((int(present.sum()), 6))
    for row, k in enumerate(np.flatnonzero(present)):
        near_head = abs(motions.head_s[k] - at) < abs(motions.tail_s[k] - at)
        state, when = (
            (motions.head[k], motions.head_s[k])
            if near_head
            else (motions.tail[k], motions.tail_s[k])
        )
        if np.isfinite(state[3]):
            state = trajectory(state, np.array([at - when]))[0][0]
        out[row] = motions.head[later] - state
    return out


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
