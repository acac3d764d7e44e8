"""Object linking: an object that was lost for a while is known again by its motion.

The state of an object that ended is carried to the instant of a newly begun one. Whether the two
are one is a likelihood ratio: the difference under both covariances, against an object that
was never seen before, of which there are as many about as there are known ones nearby.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaincinv, gammaln

from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NONE = -1
FAR_SIGMA = 10.0  # energies that differ by more are not looked at
OBLATE = 2e-3  # share of its energy that the oblate Earth lends an orbit and takes back
KEPT = 0.9999  # share of true links that the chi-square test lets pass
# Never fewer than this: objects in low orbit, all sizes that are tracked, are as dense.
FEWEST_KM3 = 1e-8
VELOCITIES_KM3_S3 = 1.0  # and they fill about this much of velocity space
# Accelerations left out: Sun and Moon at geostationary height; of what pulls, the harmonics.
ACCELERATION_KM_S2 = 1e-8
SHARE_OF_GRAVITY = 1e-5


class ObservedMotions(NamedTuple):
    """Objects as they were seen: when, and their motion at both ends of that.

    first_s, last_s : (n,) float
        First and last instant at which it was seen [s].
    head_s, tail_s : (n,) float
        Instants of the motion near the first and near the last.
    head, tail : (n, 6) float
        Position [km] and velocity [km/s], GCRF; NaN velocity where only a position is known.
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
    seen: ObservedMotions, *, gap_s: float, log_odds: float
) -> tuple[Indices, Array]:
    """Return which object continues which.

    Parameters
    ----------
    seen
        Objects, in any order; a velocity must be known of one of the two that are linked.
    gap_s
        Longest time unseen.
    log_odds
        The links made as a whole must be this much likelier (ln) than the best ones without
        any one of them. So an object is linked with none where two could be it.

    Returns
    -------
    before : (n,) int
        The object that each one continues, -1 where it is new; no two continue the same.
    odds : (n,) float
        Log of the odds of the link to it; NaN where there is none.

    Notes
    -----
    Errors that the sensors keep over the gap are in both states and count twice, so the test is
    on the safe side. Forces: two bodies and J2; a constant acceleration of unknown direction stands
    for what is left out.
    """
    n = len(seen.first_s)
    before, odds = np.full(n, NONE), np.full(n, np.nan)
    pairs = _pairs(seen, gap_s)
    gain = _gains(seen, pairs)
    likely = gain > 0.0
    earlier, later, gain = pairs.earlier[likely], pairs.later[likely], gain[likely]
    graph = coo_array((np.ones(len(gain)), (earlier, later)), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    for label in np.unique(part[earlier]):
        own = np.flatnonzero(part[earlier] == label)
        for k in own[_sure(earlier[own], later[own], gain[own], log_odds)]:
            before[later[k]], odds[later[k]] = earlier[k], gain[k]
    return before, odds


def chains(before: Indices) -> Indices:
    """Return the first object of each one's chain, from what `link_by_motion` found."""
    head = np.where(before == NONE, np.arange(len(before)), before)
    while (head[head] != head).any():
        head = head[head]
    return head


class _CandidatePairs(NamedTuple):
    """Objects that ended and ones that began later, and the difference of their motions there.

    `apart` is the begun one's state minus that of the ended one, (p, 6); NaN velocity where one
    of them is unknown. `cov` is its covariance.
    """

    earlier: Indices
    later: Indices
    apart: Array
    cov: Array


def _pairs(seen: ObservedMotions, gap_s: float) -> _CandidatePairs:
    """Return the pairs that may be one object, by time and by what an orbit keeps."""
    gap = seen.first_s - seen.last_s[:, None]
    timely = (gap > 0.0) & (gap <= gap_s)
    moving, moves = np.isfinite(seen.tail[:, 3]), np.isfinite(seen.head[:, 3])
    kept = timely & _alike(seen)
    parts = []
    for i in np.flatnonzero(moving):  # forward from each that ended
        later = np.flatnonzero(kept[i])
        later = later[np.argsort(seen.head_s[later], kind="stable")]
        state, cov = _carried(seen.tail[i], seen.tail_cov[i], seen.head_s[later] - seen.tail_s[i])
        earlier = np.full(len(later), i)
        parts.append((earlier, later, seen.head[later] - state, seen.head_cov[later] + cov))
    for j in np.flatnonzero(moves):  # back to those of which no velocity is known
        earlier = np.flatnonzero(kept[:, j] & ~moving)
        earlier = earlier[np.argsort(-seen.tail_s[earlier], kind="stable")]
        state, cov = _carried(seen.head[j], seen.head_cov[j], seen.tail_s[earlier] - seen.head_s[j])
        later = np.full(len(earlier), j)
        parts.append((earlier, later, state - seen.tail[earlier], seen.tail_cov[earlier] + cov))
    none = np.zeros(0, np.int64)
    parts.append((none, none, np.zeros((0, 6)), np.zeros((0, 6, 6))))
    return _CandidatePairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _alike(seen: ObservedMotions) -> npt.NDArray[np.bool_]:
    """Return which (earlier, later) pairs agree in energy, true where it is not known of both.

    A wide gate that costs nothing: what two bodies keep, J2 changes by a thousandth.
    """
    (one, one_var), (two, two_var) = (
        _energy(seen.tail, seen.tail_cov), _energy(seen.head, seen.head_cov)
    )  # fmt: skip
    room = FAR_SIGMA * np.sqrt(one_var[:, None] + two_var) + OBLATE * np.abs(two)
    return ~(np.abs(one[:, None] - two) > room)


def _energy(state: Array, cov: Array) -> tuple[Array, Array]:
    """Return the energy of states [km^2/s^2] and its variance."""
    r, v = state[:, :3], state[:, 3:]
    distance = np.linalg.norm(r, axis=1)
    slope = np.concatenate([GM_KM3_S2 * r / distance[:, None] ** 3, v], axis=1)
    energy = np.sum(v * v, axis=1) / 2 - GM_KM3_S2 / distance
    return energy, np.einsum("ni,nij,nj->n", slope, cov, slope)


def _gains(seen: ObservedMotions, pairs: _CandidatePairs) -> Array:
    """Return the log odds of each pair; -inf where the difference is too large."""
    gain = np.full(len(pairs.later), -np.inf)
    order = np.argsort(pairs.later, kind="stable")
    cuts = np.flatnonzero(np.diff(pairs.later[order])) + 1
    for own in np.split(order, cuts) if len(order) else []:
        present = _present(seen, int(pairs.later[own[0]]))
        past = pairs.earlier[own]
        for k in own:
            i, size = pairs.earlier[k], 6 if np.isfinite(pairs.apart[k]).all() else 3
            S, d = pairs.cov[k, :size, :size], pairs.apart[k, :size]
            d2 = float(d @ np.linalg.solve(S, d))
            if not d2 < 2 * gammaincinv(size / 2, KEPT):  # chi-square
                continue
            # Two that were seen at one time are two.
            distinct = (seen.first_s[past] <= seen.last_s[i]) & (
                seen.last_s[past] >= seen.first_s[i]
            )
            others = np.concatenate([pairs.apart[own[distinct & (past != i)]], present])
            density = _log_density(others[:, :size], S)
            gain[k] = -d2 / 2 - np.linalg.slogdet(2 * np.pi * S)[1] / 2 - density
    return gain


def _carried(state: Array, cov: Array, dt_s: Array) -> tuple[Array, Array]:
    """Return a state at several times from its own, with covariances.

    What the forces leave out grows as a constant acceleration does.
    """
    there, transition = trajectory(state, dt_s)
    gravity = GM_KM3_S2 / float(state[:3] @ state[:3])
    left_out = ACCELERATION_KM_S2 + SHARE_OF_GRAVITY * gravity
    lever = np.zeros((len(dt_s), 6, 3))
    lever[:, :3] = np.eye(3) * (dt_s**2 / 2)[:, None, None]
    lever[:, 3:] = np.eye(3) * dt_s[:, None, None]
    grown = left_out**2 * lever @ np.swapaxes(lever, -1, -2)
    return there, transition @ cov @ np.swapaxes(transition, -1, -2) + grown


def _present(seen: ObservedMotions, later: int) -> Array:
    """Return a begun object's state minus those of the objects that were seen when it was."""
    at = seen.head_s[later]
    there = (seen.first_s <= seen.last_s[later]) & (seen.last_s >= seen.first_s[later])
    there[later] = False
    out = np.empty((int(there.sum()), 6))
    for row, k in enumerate(np.flatnonzero(there)):
        near_head = abs(seen.head_s[k] - at) < abs(seen.tail_s[k] - at)
        state, when = (
            (seen.head[k], seen.head_s[k]) if near_head else (seen.tail[k], seen.tail_s[k])
        )
        if np.isfinite(state[3]):
            state = trajectory(state, np.array([at - when]))[0][0]
        out[row] = seen.head[later] - state
    return out


def _log_density(apart: Array, S: Array) -> float:
    """Return the log of how many objects there are about a state, by its nearest neighbour.

    In the state's own units, km and km/s: one object fills the ellipsoid of the shape of S that
    reaches to it.
    """
    size = len(S)
    apart = apart[np.isfinite(apart).all(axis=1)]
    floor = np.log(FEWEST_KM3) - (np.log(VELOCITIES_KM3_S3) if size == 6 else 0.0)
    if not len(apart):
        return float(floor)
    d2 = np.einsum("ni,ni->n", apart, np.linalg.solve(S, apart.T).T).min()
    unit_ball = size / 2 * np.log(np.pi) - gammaln(size / 2 + 1)
    _, log_det = np.linalg.slogdet(S)
    nearest = unit_ball + size / 2 * np.log(max(d2, 1e-300)) + log_det / 2
    return float(max(-nearest, floor))


def _sure(earlier: Indices, later: Indices, gain: Array, log_odds: float) -> list[int]:
    """Return the pairs of the best assignment that no other one comes near without."""
    rows, row = np.unique(earlier, return_inverse=True)
    columns, column = np.unique(later, return_inverse=True)
    benefit = np.zeros((len(rows), len(columns)))
    benefit[row, column] = gain  # 0: both stay alone
    best, total = _assigned(benefit)
    out = []
    for k in range(len(gain)):
        if not best[row[k], column[k]]:
            continue
        without = benefit.copy()
        without[row[k], column[k]] = 0.0
        if total - _assigned(without)[1] >= log_odds:
            out.append(k)
    return out


def _assigned(benefit: Array) -> tuple[npt.NDArray[np.bool_], float]:
    """Return the one-to-one pairs of the greatest sum, and the sum."""
    row, column = linear_sum_assignment(benefit, maximize=True)
    chosen = np.zeros(benefit.shape, bool)
    chosen[row, column] = benefit[row, column] > 0.0
    return chosen, float(benefit[chosen].sum())
