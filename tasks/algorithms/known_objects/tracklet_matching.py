"""Matching of tracklets: the probability that a tracklet shows a given satellite of a catalogue.

1. `tracklet_search.find_pairs` finds the satellites that each tracklet may show.
2. `weigh_pairs` compares direction and rates with the prediction. The difference has a density if
   the tracklet shows this satellite, an unlisted companion of it, or an unrelated object.
3. `judge_tracklets` decides between all pairs of a tracklet, as `matching.judge` does for objects.

The errors of a satellite's elements move it as neighbours in a circular orbit move: along the
track, by an eccentricity vector, by a turn of the plane, and by a drift (Clohessy and Wiltshire
1960, Terminal guidance system for satellite rendezvous). The errors of a satellite that
thrusts are so large that the difference is not linear in them: it is linearised where the errors
explain it best.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.constants import DAY_NS, DAY_S, GM_KM3_S2, LN_2PI, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.known_objects.matching import (
    COMPANIONS,
    MIN_LISTED,
    THRUSTING,
    WORST,
    KnownSatellites,
    chi2_quantile,
    error_sizes,
    thrust_errors,
)
from epipole.tasks.algorithms.known_objects.prediction import (
    ElementErrors,
    drag_error_km,
    is_deep_space,
    sigmas_of,
)
from epipole.tasks.algorithms.known_objects.tracklet_search import Pairs, SeenTracklets, find_pairs

REACH_SIGMAS = 4.0
# Unrelated objects: their density on the sky, all tracked ones in low orbit as seen from there; and
# the spread of their velocities across the line of sight, per axis.
OTHERS_PER_SR = 100.0
OTHERS_KM_S = 3.0
ITERATIONS = 4
ROUNDING = 1e-13  # of a covariance: keeps it positive definite
MIN_AHEAD_SHARE = 0.1  # of the distance: errors must not move a satellite behind the sensor
CHUNK = 20_000  # pairs that are weighed at once


class PairWeights(NamedTuple):
    """How well each of k pairs fits.

    `distance_km` and `mahalanobis` are of the prediction from the observed direction, as in
    `matching.Candidate`, and so are the log densities; `fits` is false where no usual error
    explains the difference.
    """

    distance_km: Array
    mahalanobis: Array
    log_match: Array
    log_companion: Array
    log_other: Array
    fits: Flags


class TrackletResidual(NamedTuple):
    """The difference of a tracklet from its satellite, as `matching.learn_errors` takes it."""

    offset: Array
    cov: Array
    jacobian: Array
    age_days: float


class TrackletNames(NamedTuple):
    """Which satellite each of m tracklets shows.

    status : (m,) str
        A `NameStatus`.
    probability : (m,) float
        That of the status.
    pair : (m,) int
        The likeliest pair; of an unknown tracklet the nearest one; -1: none is near.
    listed
        The satellites that an ambiguous tracklet may show, by tracklet, the likeliest first.
    """

    status: npt.NDArray[np.str_]
    probability: Array
    pair: Indices
    listed: dict[int, tuple[int, ...]]


def match_tracklets(tracklets: SeenTracklets, catalogue: KnownSatellites) -> Pairs:
    """Return the pairs of tracklets and satellites that may be one; see `find_pairs`."""
    middle_ns = _middle_ns(tracklets)
    rows = np.arange(len(catalogue.satellites))
    ages = (middle_ns - catalogue.epoch_ns) / DAY_NS
    sigma = ErrorsOfPairs(catalogue, rows, middle_ns).sigmas(rows, ages)
    widest = REACH_SIGMAS * _widest(sigma, ages)
    aside_km = np.maximum(widest[:, 1], widest[:, 3])
    return find_pairs(tracklets, catalogue.satellites, widest[:, 0], aside_km)


def weigh_pairs(tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites) -> PairWeights:
    """Return how well each pair fits, by the catalogue's errors of elements."""
    errors = ErrorsOfPairs(catalogue, pairs.satellite, _middle_ns(tracklets))
    parts = [
        _weigh(tracklets, pairs.take(slice(k, k + CHUNK)), catalogue, errors)
        for k in range(0, max(len(pairs.tracklet), 1), CHUNK)
    ]
    return PairWeights(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def residuals_of(
    tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites
) -> list[TrackletResidual]:
    """Return the differences of tracklets from their satellites, in units of their errors."""
    errors = ErrorsOfPairs(catalogue, pairs.satellite, _middle_ns(tracklets))
    ages = _ages(tracklets, pairs, catalogue)
    linear = _linearised(tracklets, pairs, errors.sigmas(pairs.satellite, ages), ages)
    columns = linear.offset, linear.cov, linear.jacobian, ages.tolist()
    return [TrackletResidual(*of) for of in zip(*columns, strict=True)]


class ErrorsOfPairs:
    """The errors of the elements of many satellites at many times.

    As `KnownSatellites.sigmas`, but drag grows with the square of the age from that at one time.
    """

    def __init__(self, catalogue: KnownSatellites, rows: Indices, time_ns: int) -> None:
        n = len(catalogue.satellites)
        self._drag_km_day2 = np.zeros(n)
        self._errors = np.zeros((n, len(ElementErrors._fields)))
        for row in np.unique(rows).tolist():
            satellite = catalogue.satellites[row]
            age = max(abs(time_ns - int(catalogue.epoch_ns[row])) / DAY_NS, 1.0)
            self._drag_km_day2[row] = drag_error_km(satellite, age) / age**2
            self._errors[row] = catalogue.high if is_deep_space(satellite) else catalogue.low

    def sigmas(self, rows: Indices, ages: Array) -> Array:
        """Return the 1-sigma errors of satellites at some ages [days], (k, 6)."""
        errors = ElementErrors(*self._errors[rows].T)
        return sigmas_of(errors, ages, self._drag_km_day2[rows] * ages**2)


def _middle_ns(tracklets: SeenTracklets) -> int:
    return int(np.median(tracklets.time_ns)) if len(tracklets.time_ns) else 0


def _ages(tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites) -> Array:
    time_ns = tracklets.time_ns[pairs.tracklet] - catalogue.epoch_ns[pairs.satellite]
    return np.asarray(time_ns / DAY_NS)


def _widest(sigma: Array, ages: Array) -> Array:
    """Return the largest errors that are considered, (k, 6)."""
    return np.hypot(WORST * sigma, thrust_errors(ages, THRUSTING[-1][1]))


def _weigh(
    tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites, errors: ErrorsOfPairs
) -> PairWeights:
    ages = _ages(tracklets, pairs, catalogue)
    sigma = errors.sigmas(pairs.satellite, ages)
    linear = _linearised(tracklets, pairs, sigma, ages)
    terms = error_sizes(sigma, ages)
    far = [(np.hypot(sigma, size), share) for share, size in COMPANIONS]
    densities, chi2 = zip(*(linear.log_density(of) for of, _ in terms), strict=True)
    companions = [linear.log_density(of)[0] for of, _ in far]
    rate_rad_s = OTHERS_KM_S / linear.distance_km
    other = np.log(OTHERS_PER_SR / (2 * np.pi * rate_rad_s**2))
    return PairWeights(
        distance_km=linear.apart_km,
        mahalanobis=np.sqrt(chi2[0]),
        log_match=_mixture(densities, [share for _, share in terms]),
        log_companion=_mixture(companions, [share for _, share in far]),
        log_other=other,
        fits=np.min(chi2, axis=0) < chi2_quantile(4),
    )


def _mixture(log_densities: Sequence[Array], shares: Sequence[float]) -> Array:
    return np.asarray(logsumexp(log_densities, axis=0, b=np.array(shares)[:, None]))


class _Linear(NamedTuple):
    """Differences of k tracklets from their satellites, linear in the errors of the elements.

    `offset` (k, 4): direction and rates, observed minus predicted, each in units of `unit` (k, 4)
    [rad, rad/s], its 1-sigma error; `cov` (k, 4, 4) and `jacobian` (k, 4, 6) as in
    `matching.Residual`. `distance_km` is that from the sensor,
    `apart_km` that of the prediction from the line of sight.
    """

    offset: Array
    cov: Array
    jacobian: Array
    unit: Array
    distance_km: Array
    apart_km: Array

    def log_density(self, sigma: Array) -> tuple[Array, Array]:
        """Return the log densities and squared Mahalanobis distances for (k, 6) errors."""
        S = self.cov + _spread(self.jacobian, sigma)
        # Of a satellite very near the sensor the elements' errors are 1e7 times the sensor's.
        S[:, range(4), range(4)] += ROUNDING * np.einsum("kii->k", S)[:, None]
        L = np.linalg.cholesky(S)
        chi2 = np.sum(np.linalg.solve(L, self.offset[:, :, None])[:, :, 0] ** 2, axis=1)
        log_det = 2 * np.log(np.einsum("kii->ki", L) * self.unit).sum(axis=1)
        return -(chi2 + log_det + 4 * LN_2PI) / 2, chi2


def _spread(jacobian: Array, sigma: Array) -> Array:
    return (jacobian * sigma[:, None] ** 2) @ np.swapaxes(jacobian, 1, 2)


def _linearised(tracklets: SeenTracklets, pairs: Pairs, sigma: Array, ages: Array) -> _Linear:
    """Return the differences, linearised at the errors that explain them best (Gauss-Newton)."""
    of = tracklets.take(pairs.tracklet)
    widest = _widest(sigma, ages)
    axes, changes = of.axes(), _changes(pairs.states)
    predicted, jacobian, distance_km = _predicted(of, axes, pairs.states)
    apart_km = np.linalg.norm(predicted[:, :2], axis=1) * distance_km
    cov = of.cov.copy()
    cov[:, [0, 1], [0, 1]] += (of.position_sigma_km / distance_km)[:, None] ** 2
    unit = np.sqrt(np.einsum("kii->ki", cov))
    cov /= unit[:, :, None] * unit[:, None, :]
    x = np.zeros((len(ages), 6))
    for step in range(ITERATIONS + 1):
        H = jacobian @ changes / unit[:, :, None]
        offset = -predicted
        offset[:, 2:] += of.rates
        offset = offset / unit + np.einsum("kij,kj->ki", H, x)
        if step == ITERATIONS:
            break
        gain = widest[:, :, None] ** 2 * np.swapaxes(H, 1, 2)
        x = (gain @ np.linalg.solve(cov + _spread(H, widest), offset[:, :, None]))[:, :, 0]
        predicted, jacobian, _ = _predicted(of, axes, _moved(pairs.states, changes, x))
    return _Linear(offset, cov, H, unit, distance_km, apart_km)


def _predicted(of: SeenTracklets, axes: Array, states: Array) -> tuple[Array, Array, Array]:
    """Return what sensors see of (k, 6) states: direction and rates on the plane of the sky.

    Returns
    -------
    (k, 4) float
        Offset from the observed direction towards growing ra and dec [rad], and its rate [rad/s],
        on the plane that touches the sky at the observed direction.
    (k, 4, 6) float
        Its derivatives by the state.
    (k,) float
        Distance [km].
    """
    r, v = states[:, :3], states[:, 3:]
    line, w = r - of.r_km, v - of.v_km_s
    distance = np.linalg.norm(line, axis=1, keepdims=True)
    delay_s = distance / SPEED_OF_LIGHT_KM_S
    receding = np.sum(line * w, axis=1, keepdims=True) / distance
    pull = -GM_KM3_S2 * r / np.linalg.norm(r, axis=1, keepdims=True) ** 3
    line = line - delay_s * v  # where the light came from
    w = w - receding / SPEED_OF_LIGHT_KM_S * v - delay_s * pull
    ahead, ahead_rate = (np.einsum("kj,kj->k", axes[:, 0], x)[:, None] for x in (line, w))
    ahead = np.maximum(ahead, MIN_AHEAD_SHARE * distance)
    offset = np.einsum("kij,kj->ki", axes[:, 1:], line) / ahead
    towards = axes[:, 1:] - offset[:, :, None] * axes[:, :1]
    rate = np.einsum("kij,kj->ki", towards, w) / ahead
    jacobian = np.zeros((len(states), 4, 6))
    jacobian[:, :2, :3] = jacobian[:, 2:, 3:] = towards / ahead[:, :, None]
    jacobian[:, 2:, :3] = -(
        towards * (ahead_rate / ahead**2)[:, :, None] + (rate / ahead)[:, :, None] * axes[:, :1]
    )
    return np.concatenate([offset, rate], axis=1), jacobian, distance[:, 0]


def _changes(states: Array) -> Array:
    """Return the derivatives of (k, 6) states by the errors of elements, (k, 6, 6).

    Of a circular orbit at one instant; the columns in the order of `ERROR_COMPONENTS`. The two of
    the eccentricity vector, and of the plane, are a quarter of an orbit apart.
    """
    r, v = states[:, :3], states[:, 3:]
    momentum = np.cross(r, v)
    size = np.linalg.norm(r, axis=1, keepdims=True)
    up, side = r / size, momentum / np.linalg.norm(momentum, axis=1, keepdims=True)
    ahead = np.cross(side, up)
    n = np.linalg.norm(momentum, axis=1, keepdims=True) / size**2
    zero, per_s = np.zeros_like(r), 1.0 / DAY_S
    columns = [
        (ahead, -n * up),
        (up, -n * ahead),
        (2 * ahead, -n * up),
        (side, zero),
        (zero, n * side),
        (-2 / 3 * per_s / n * up, per_s / 3 * ahead),
    ]
    return np.stack([np.concatenate(column, axis=1) for column in columns], axis=2)


def _moved(states: Array, changes: Array, x: Array) -> Array:
    """Return (k, 6) states with errors (k, 6); large ones along the track follow the orbit."""
    moved = states + np.einsum("kij,kj->ki", changes, x)
    angle = (x[:, 0] + 2 * x[:, 2]) / np.linalg.norm(states[:, :3], axis=1)
    return np.asarray(moved - angle[:, None] ** 2 / 2 * states)


# The decision


def judge_tracklets(
    count: int, pairs: Pairs, weights: PairWeights, min_probability: float
) -> TrackletNames:
    """Return which satellite each of `count` tracklets shows, as `matching.judge` of an object.

    `min_probability` is the minimum probability of a known tracklet.
    """
    status = np.full(count, "unknown", "<U16")
    probability, pair = np.ones(count), np.full(count, -1)
    if not len(pairs.tracklet):
        return TrackletNames(status, probability, pair, {})
    first = np.flatnonzero(np.diff(pairs.tracklet, prepend=-1))
    of, tracklets = np.cumsum(np.diff(pairs.tracklet, prepend=-1) > 0) - 1, pairs.tracklet[first]
    match = np.where(weights.fits, weights.log_match, -np.inf)
    total = np.logaddexp(
        np.logaddexp.reduceat(match, first), np.logaddexp.reduceat(weights.log_companion, first)
    )
    total = np.logaddexp(total, weights.log_other[_least(-weights.log_match, of)])
    share = np.exp(match - total[of])
    best, any_of = _least(-share, of), np.minimum(np.add.reduceat(share, first), 1.0)
    is_known = share[best] >= min_probability
    is_ambiguous = ~is_known & (any_of >= 0.5)
    status[tracklets[is_known]], status[tracklets[is_ambiguous]] = "known", "ambiguous"
    probability[tracklets] = np.where(
        is_known, share[best], np.where(is_ambiguous, any_of, 1.0 - any_of)
    )
    named = is_known | is_ambiguous
    pair[tracklets] = np.where(named, best, _least(weights.mahalanobis, of))
    listed = {}
    for k in np.flatnonzero(is_ambiguous).tolist():
        rows = np.flatnonzero(of == k)
        rows = rows[np.argsort(-share[rows], kind="stable")]
        rows = rows[share[rows] >= MIN_LISTED]
        listed[int(tracklets[k])] = tuple(pairs.satellite[rows].tolist())
    return TrackletNames(status, probability, pair, listed)


def _least(values: Array, group: Indices) -> Indices:
    """Return the row of the least value of each group 0, 1, ...; the first of equal ones."""
    order = np.lexsort((values, group))
    return order[np.flatnonzero(np.diff(group[order], prepend=-1))]
