"""Clock search: the offset at which a sensor's lines of sight meet the objects of the others.

A sensor whose clock is seconds off agrees with no other sensor, so its lines belong to no object.
But each pair of a line and an object gives an offset at which the line passes the object. The
offsets of false pairs scatter, those of true pairs are equal.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import pdtrc

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.sensor_faults.fault_judgement import MIN_OBJECTS

MAX_OFFSET_S = 5.0  # largest clock offset that is searched
# Largest residual of a line and its object at the best offset. With twice of it the same offsets
# are found in the tests; with half of it true ones are lost.
GATE_SIGMA = 4.0
QUARTER_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
SAME_SIGMA = 3.0  # offsets agree if they differ by less; with half of it true ones are lost
FAR_SIGMA = 1e9  # [sigma] stands for the residual of an object behind the sensor: beyond any gate
MAX_FALSE_ALARM = 1e-4  # largest accepted false-alarm probability


class CandidatePairs(NamedTuple):
    """All pairs of a line of sight of one sensor and an object at the same epoch.

    tracklet, object : (n,) int
        Numbers of the tracklet and of the object; any.
    u : (n, 3) float
        Direction without aberration.
    cov_noise, cov_bias : (n, 2, 2) float
        Covariance of its error on `tangent_basis(u)` [rad^2]: of the part that is new at each
        epoch, and of the part that all epochs share.
    r_km, v_sensor_km_s : (n, 3) float
        Position and velocity of the sensor, GCRF.
    sigma_km : (n,) float
        1-sigma error of its position, per axis.
    x_km, v_km_s, cov_km2 : (n, 3), (n, 3), (n, 3, 3) float
        Position, velocity and covariance of the object at the epoch, GCRF, from the other sensors.
    """

    tracklet: Indices
    object: Indices
    u: Array
    cov_noise: Array
    cov_bias: Array
    r_km: Array
    v_sensor_km_s: Array
    sigma_km: Array
    x_km: Array
    v_km_s: Array
    cov_km2: Array


class Match(NamedTuple):
    """The offset [s], reported minus true time, and the pairs that agree with it, as rows."""

    offset_s: float
    row: Indices


def search_offset(candidates: CandidatePairs) -> Match | None:
    """Return the clock offset of a sensor, None if the evidence for the best one is too weak.

    Notes
    -----
    The evidence is the number of objects that agree on an offset, each with a different tracklet.
    It is compared with the expected number of false pairs. Their density is counted at right
    angles to the direction in which an offset moves the line: there all pairs are false.
    """
    pairs, which = np.unique(
        np.column_stack([candidates.tracklet, candidates.object]), axis=0, return_inverse=True
    )
    which = which.ravel()
    residuals = _residuals(candidates)
    along, sigma = _mean_offset(residuals, which, len(pairs))
    turned = residuals._replace(rate=residuals.rate @ QUARTER_TURN)
    aside, sigma_aside = _mean_offset(turned, which, len(pairs))
    passes = (np.abs(aside) < GATE_SIGMA * sigma_aside) & (np.abs(along) < MAX_OFFSET_S)
    false = (np.abs(along) < GATE_SIGMA * sigma) & (np.abs(aside) < MAX_OFFSET_S) & ~passes
    good = np.flatnonzero(passes)
    best = _best_supported(pairs[good], along[good], sigma[good], int(false.sum()))
    if best is None:
        return None
    chosen = good[_one_to_one(pairs[good], along[good], sigma[good], best)]
    return Match(best, np.flatnonzero(np.isin(which, chosen)))


class _Residuals(NamedTuple):
    """Residuals of pairs in standard deviations, and what they depend on.

    miss, rate : (n, 2) float
        The residual, and its derivative by the offset [1/s].
    shared : (n, 2, 2) float
        Covariance of the part of the residual that all epochs of a pair share; that of the whole
        is the identity.
    """

    miss: Array
    rate: Array
    shared: Array


def _residuals(m: CandidatePairs) -> _Residuals:
    """Return the residual of each pair."""
    away = m.x_km - m.r_km
    reach = np.linalg.norm(away, axis=1)
    basis = tangent_basis(m.u) / reach[:, None, None]
    # Sensor and object are off in one direction for minutes.
    position_cov = m.cov_km2 + (m.sigma_km**2)[:, None, None] * np.eye(3)
    shared = m.cov_bias + basis @ position_cov @ np.swapaxes(basis, -1, -2)
    root = np.linalg.inv(np.linalg.cholesky(m.cov_noise + shared))
    across = root @ basis
    miss = np.einsum("nij,nj->ni", across, -away)
    ahead = np.einsum("ni,ni->n", m.u, away) > 0.5 * reach
    # With a late time stamp an object lags by its motion.
    rate = np.einsum("nij,nj->ni", across, m.v_sensor_km_s - m.v_km_s)
    miss = np.where(ahead[:, None], miss, FAR_SIGMA)
    return _Residuals(miss, rate, root @ shared @ np.swapaxes(root, -1, -2))


def _mean_offset(residuals: _Residuals, which: Indices, n: int) -> tuple[Array, Array]:
    """Return the offset [s] at which each tracklet passes its object, and its 1-sigma error [s].

    The weighted mean over the epochs of the pair; large where the object is behind the sensor. The
    part of the error that the epochs share does not average out.
    """
    miss, rate, shared = residuals
    square = np.sum(rate * rate, axis=1)
    common = np.einsum("ni,nij,nj->n", rate, shared, rate)
    weight = np.maximum(np.bincount(which, square, n), 1e-300)
    together = np.bincount(which, np.sqrt(np.maximum(common, 0.0)), n)
    variance = np.bincount(which, square - common, n) + together**2
    offset = np.bincount(which, np.sum(rate * miss, axis=1), n) / weight
    return offset, np.sqrt(np.maximum(variance, 0.0)) / weight


def _best_supported(pairs: Indices, offset: Array, sigma: Array, n_false: int) -> float | None:
    """Return the offset with the most significant agreement, None if it may be a false alarm.

    `n_false` is the number of false pairs at right angles, within the same interval of offsets.
    """
    n = len(offset)
    best: tuple[float, int, float] | None = None
    for k in range(n):
        window = SAME_SIGMA * np.hypot(sigma, sigma[k])
        near = np.flatnonzero(np.abs(offset - offset[k]) < window)
        agree = min(len(np.unique(pairs[near, 0])), len(np.unique(pairs[near, 1])))
        if agree < MIN_OBJECTS:
            continue
        expected = (n_false + 1) * min(float(np.mean(window)) / MAX_OFFSET_S, 1.0)
        with np.errstate(divide="ignore"):
            # One less: the pair in the middle agrees by definition.
            odds = float(np.log(pdtrc(agree - 2, expected)))
        if best is None or (odds, -agree) < best[:2]:  # of hundreds the odds are -inf
            weight = 1 / sigma[near] ** 2
            best = odds, -agree, float(np.sum(weight * offset[near]) / np.sum(weight))
    if best is None or best[0] + np.log(n) > np.log(MAX_FALSE_ALARM):
        return None
    return best[2]


def _one_to_one(pairs: Indices, offset: Array, sigma: Array, best: float) -> list[int]:
    """Return the pairs that agree with an offset, each tracklet and each object at most once."""
    off = np.abs(offset - best) / sigma
    chosen: list[int] = []
    for k in np.argsort(off, kind="stable").tolist():
        if off[k] < SAME_SIGMA and not (pairs[chosen] == pairs[k]).any():
            chosen.append(k)
    return chosen
