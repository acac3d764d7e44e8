"""Clock search: the offset at which a sensor's lines of sight meet the objects of the others.

A sensor whose clock is seconds off agrees with no other sensor, so its lines belong to no object.
But each pair of a line and an object gives the offset at which the two would meet. The offsets of
wrong pairs scatter, those of right pairs are equal.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import pdtrc

from epipole.tasks.algorithms.geometry.directions import tangent_basis

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MAX_OFFSET_S = 5.0  # maximum clock offset that is searched for
MEETS_SIGMA = 4.0  # largest miss of a line and its object at the best offset
QUARTER_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
SAME_SIGMA = 3.0  # offsets that differ by less are the same
FAR_SIGMA = 1e9  # [sigma] miss of an object behind the sensor
MIN_OBJECTS = 3  # minimum number of objects that agree on an offset
FALSE_ALARM = 1e-4  # accepted probability that the offsets agree by chance


class Meetings(NamedTuple):
    """Pairs of a line of sight of one sensor and an object of its epoch, all combinations.

    tracklet, item : (n,) int
        Tracklet of the line, and the object; any numbers.
    u, cov : (n, 3), (n, 2, 2) float
        Direction without aberration and its covariance on `tangent_basis(u)` [rad^2].
    r_km, v_sensor_km_s : (n, 3) float
        The sensor, GCRF.
    sigma_km : (n,) float
        1-sigma error of its position, per axis.
    x_km, v_km_s, cov_km2 : (n, 3), (n, 3), (n, 3, 3) float
        The object at the epoch, from the other sensors.
    """

    tracklet: Indices
    item: Indices
    u: Array
    cov: Array
    r_km: Array
    v_sensor_km_s: Array
    sigma_km: Array
    x_km: Array
    v_km_s: Array
    cov_km2: Array


class Match(NamedTuple):
    """The offset [s], reported minus true time, and the rows whose line and object then meet."""

    offset_s: float
    row: Indices


def search_offset(meetings: Meetings) -> Match | None:
    """Return the clock offset with which a sensor sees the objects, None if no offset is sure.

    Notes
    -----
    An offset is sure if more objects agree on it, each with a different tracklet, than chance
    explains. The rate of chance meetings is counted at right angles to the direction in which
    an offset moves the line: there all meetings are by chance.
    """
    pairs, which = np.unique(
        np.column_stack([meetings.tracklet, meetings.item]), axis=0, return_inverse=True
    )
    which = which.ravel()
    miss, rate = _passes(meetings)
    along, sigma = _mean_offset(miss, rate, which, len(pairs))
    aside, sigma_aside = _mean_offset(miss, rate @ QUARTER_TURN, which, len(pairs))
    meets = (np.abs(aside) < MEETS_SIGMA * sigma_aside) & (np.abs(along) < MAX_OFFSET_S)
    wrong = (np.abs(along) < MEETS_SIGMA * sigma) & (np.abs(aside) < MAX_OFFSET_S) & ~meets
    good = np.flatnonzero(meets)
    best = _surest(pairs[good], along[good], sigma[good], int(wrong.sum()))
    if best is None:
        return None
    chosen = good[_one_to_one(pairs[good], along[good], sigma[good], best)]
    return Match(best, np.flatnonzero(np.isin(which, chosen)))


def _passes(m: Meetings) -> tuple[Array, Array]:
    """Return the miss of each line and object (n, 2), and its rate with the offset (n, 2).

    In units of the errors, and the same per second.
    """
    away = m.x_km - m.r_km
    reach = np.linalg.norm(away, axis=1)
    basis = tangent_basis(m.u) / reach[:, None, None]
    position_cov = m.cov_km2 + (m.sigma_km**2)[:, None, None] * np.eye(3)
    cov = m.cov + basis @ position_cov @ np.swapaxes(basis, -1, -2)
    across = np.linalg.inv(np.linalg.cholesky(cov)) @ basis
    miss = np.einsum("nij,nj->ni", across, -away)
    ahead = np.einsum("ni,ni->n", m.u, away) > 0.5 * reach
    # With a late time stamp an object lags by its motion.
    rate = np.einsum("nij,nj->ni", across, m.v_sensor_km_s - m.v_km_s)
    return np.where(ahead[:, None], miss, FAR_SIGMA), rate


def _mean_offset(miss: Array, rate: Array, which: Indices, n: int) -> tuple[Array, Array]:
    """Return the offset [s] at which each tracklet is nearest to its object, and its sigma.

    The mean over the epochs of the pair; large where the object is behind the sensor.
    """
    weight = np.bincount(which, np.sum(rate * rate, axis=1), n)
    weight = np.maximum(weight, 1e-300)
    return np.bincount(which, np.sum(rate * miss, axis=1), n) / weight, 1 / np.sqrt(weight)


def _surest(pairs: Indices, offset: Array, sigma: Array, n_aside: int) -> float | None:
    """Return the offset on which most objects agree, None where that may be chance.

    `n_aside` is the number of pairs that certainly met by chance.
    """
    n = len(offset)
    best: tuple[float, float] | None = None
    for k in range(n):
        window = SAME_SIGMA * np.hypot(sigma, sigma[k])
        near = np.flatnonzero(np.abs(offset - offset[k]) < window)
        agree = min(len(np.unique(pairs[near, 0])), len(np.unique(pairs[near, 1])))
        if agree < MIN_OBJECTS:
            continue
        chance = (n_aside + 1) * min(float(np.mean(window)) / MAX_OFFSET_S, 1.0)
        with np.errstate(divide="ignore"):  # log of 0: no chance at all
            odds = float(
                np.log(pdtrc(agree - 2, chance))
            )  # the pair at the middle agrees by definition
        if best is None or odds < best[0]:
            weight = 1 / sigma[near] ** 2
            best = odds, float(np.sum(weight * offset[near]) / np.sum(weight))
    if best is None or best[0] + np.log(n) > np.log(FALSE_ALARM):
        return None
    return best[1]


def _one_to_one(pairs: Indices, offset: Array, sigma: Array, best: float) -> list[int]:
    """Return the pairs that agree with an offset, each tracklet and each object at most once."""
    off = np.abs(offset - best) / sigma
    chosen: list[int] = []
    for k in np.argsort(off, kind="stable").tolist():
        if off[k] < SAME_SIGMA and not (pairs[chosen] == pairs[k]).any():
            chosen.append(k)
    return chosen
