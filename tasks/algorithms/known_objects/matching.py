"""Matching: the probability that an object of the night is a given satellite of a catalogue.

An object's positions are compared with a satellite's predicted positions at the same times. The
covariance of the difference is that of the positions plus that of the elements' errors, which all
rows share. Each satellite is a hypothesis. So is an object that is missing from the catalogue:
an unrelated one, or a companion of a listed one. Companions matter: satellites that share a
geostationary slot, and parts of one launch, are near each other.

`learn_errors` estimates the size of the elements' errors from the certain matches of a night.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaincinv, logsumexp

from epipole.schemas.arrays import Array, Flags, Indices, Integers
from epipole.tasks.algorithms.constants import LN_2PI
from epipole.tasks.algorithms.known_objects.prediction import (
    ElementErrors,
    Satellites,
    Screen,
    along_up_across,
    is_deep_space,
    predict,
    sensitivities,
    sigmas,
)

MAX_ROWS = 8  # maximum number of positions of an object that are compared
GATE_SHARE = 0.9999  # share of true matches that pass the chi-square test
REACH_SIGMA, THRUST_REACH_SIGMA = 6.0, 3.0  # gate of the search
# Unlisted companions: the share of satellites with one, and the 1-sigma separation, in the order of
# `ERROR_COMPONENTS`: in one geostationary slot, and in one orbit plane.
COMPANIONS = ((0.05, (50.0, 25.0, 25.0, 50.0, 50.0, 5.0)), (0.05, (300.0, 5.0, 5.0, 5.0, 5.0, 5.0)))
COMPANION_KM = 50.0  # separation of a companion that is still searched, per axis
# Density of unrelated objects [1/km^3]: that of all tracked objects in low orbit.
OTHERS_PER_KM3 = 1e-8
# Errors of element sets, in units of `ElementErrors`, and the share of such sets.
QUALITIES = ((1.0, 0.8), (2.0, 0.15), (4.0, 0.05))
WORST = QUALITIES[-1][0]
# Satellites that thrust: their share, and the 1-sigma growth of the error along the track [km/day],
# which is their drift too, and the other errors beyond the usual, in the order of
# `ERROR_COMPONENTS`. Measured on 132 low satellites, most of them with electric propulsion, by
# elements 1.6 days old: one in ten is more than 15 km off, one in thirty more than 50 km, and nine
# in ten of all are less than 0.8 km off in height and across.
THRUSTING = ((0.10, 12.0), (0.03, 40.0))
THRUSTING_KM = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.0])
SURE = 0.999  # probability of a match that counts where errors and times are learnt
MIN_LISTED = 1e-3  # minimum probability of a satellite that is listed for an object
DRAG_REACH_KM_DAY2 = 0.2  # drag error of a satellite that decays soon
DAY_NS = 86_400_000_000_000
# Prior of `learn_errors`: each error is known to a factor of three (1-sigma of its logarithm).
PRIOR_SIGMA = float(np.log(3.0))
SIMPLEX_STEP = 0.7  # first step of the search, in ln of a factor: a factor of two
MIN_MATCHES = 5  # minimum number of matches to learn from


class Observed(NamedTuple):
    """Positions of one object at m times.

    time_ns : (m,) int
        UTC since 1970, in order.
    r_km : (m, 3) float
        GCRF.
    cov : (m, 3, 3) float
        Their covariances [km^2]. The errors of different rows may be correlated, up to equal.
    """

    time_ns: Integers
    r_km: Array
    cov: Array

    @property
    def anchor(self) -> int:
        """The row with the smallest covariance."""
        return int(np.argmin(np.trace(self.cov, axis1=1, axis2=2)))


class KnownSatellites(NamedTuple):
    """The satellites of a catalogue, and the errors of their elements.

    satellites
        n satellites of SGP4.
    epoch_ns : (n,) int
        Epochs of the elements.
    low, high
        Errors of the elements: of low orbits, and of orbits with periods above 225 minutes.
    """

    satellites: Satellites
    epoch_ns: Integers
    low: ElementErrors
    high: ElementErrors

    def sigmas(self, row: int, time_ns: int) -> Array:
        """Return the errors of a satellite's elements at a time; see `prediction.sigmas`."""
        satellite = self.satellites[row]
        errors = self.high if is_deep_space(satellite) else self.low
        return sigmas(satellite, (time_ns - int(self.epoch_ns[row])) / DAY_NS, errors)


class Candidate(NamedTuple):
    """A satellite that an object may be.

    `offset` (3,) [km] is the object's position minus the predicted one at the anchor: along, up,
    across. In these axes `cov` (3, 3) is the covariance of the object's position, and `jacobian`
    (3, 6) the derivatives of the predicted position by the errors of the elements. `sigma` (6,)
    are the 1-sigma errors of the elements. The three `log_` are log densities of the positions: of
    the satellite, of a companion, of an unrelated object.
    """

    row: int  # of the catalogue
    offset: Array
    cov: Array
    jacobian: Array
    sigma: Array
    age_days: float
    log_match: float
    log_companion: float
    log_other: float
    fits: bool

    @property
    def distance_km(self) -> float:
        """Distance of the object from the predicted position [km]."""
        return float(np.linalg.norm(self.offset))

    @property
    def mahalanobis(self) -> float:
        """Mahalanobis distance of the object from the predicted position."""
        S = self.cov + _element_covariance(self.jacobian, self.sigma)
        return float(np.sqrt(self.offset @ np.linalg.solve(S, self.offset)))


def candidates(observed: Observed, catalogue: KnownSatellites, screen: Screen) -> list[Candidate]:
    """Return the satellites near an object, in the catalogue's order."""
    k = observed.anchor
    time_ns, r_km = int(observed.time_ns[k]), observed.r_km[k]
    ages = np.abs(time_ns - catalogue.epoch_ns) / DAY_NS
    near = screen.near(r_km, time_ns, _reach(catalogue, ages, observed.cov[k]))
    if not len(near):
        return []
    states = predict([catalogue.satellites[i] for i in near], observed.time_ns)
    found = [
        _candidate(observed, catalogue, row, of_row)
        for row, of_row in zip(near.tolist(), states, strict=True)
        if np.isfinite(of_row).all()
    ]
    return [each for each in found if each is not None]


def _reach(catalogue: KnownSatellites, age_days: Array, cov: Array) -> Array:
    """Return the distances within which the satellites are searched, (n,) [km]."""
    widest = [
        max(getattr(catalogue.low, name), getattr(catalogue.high, name))
        for name in ("along_km", "along_km_day")
    ]
    along = np.hypot(widest[0], widest[1] * age_days) + DRAG_REACH_KM_DAY2 * age_days**2
    thrust = THRUST_REACH_SIGMA * thrust_errors(age_days, THRUSTING[-1][1])[:, 0]
    spread = np.sqrt(np.trace(cov))
    usual = REACH_SIGMA * np.hypot(WORST * along, spread) + 2 * COMPANION_KM
    return np.asarray(np.maximum(usual, thrust + REACH_SIGMA * spread))


def _candidate(
    observed: Observed, catalogue: KnownSatellites, row: int, states: Array
) -> Candidate | None:
    k = observed.anchor
    time_ns, state = int(observed.time_ns[k]), states[k]
    axes = along_up_across(state)
    apart = observed.r_km - states[:, :3]
    at_anchor_km, P = axes @ apart[k], axes @ observed.cov[k] @ axes.T
    sigma = catalogue.sigmas(row, time_ns)
    age = (time_ns - int(catalogue.epoch_ns[row])) / DAY_NS
    is_deep = is_deep_space(catalogue.satellites[row])
    sizes = error_sizes(sigma, age) if not is_deep else usual_sizes(sigma)
    widest = np.max([size for size, _ in sizes], axis=0)
    reach = widest[[0, 1, 3]] + 2 * widest[1] + np.sqrt(np.diag(P))
    if (np.abs(at_anchor_km) > REACH_SIGMA * reach + 2 * COMPANION_KM).any():
        return None
    H = sensitivities(catalogue.satellites[row], observed.time_ns, k)
    jacobian = axes @ H[k]
    H = H.reshape(-1, 6)
    # The rows may share their errors: their variances times m, so that m rows weigh as one.
    noise = _block_diagonal(observed.cov * len(observed.cov))
    z = apart.ravel()
    match, fits = _log_mixture(z, noise, H, sizes)
    at_anchor, fits_there = _log_mixture(at_anchor_km, P, jacobian, sizes)
    companion = logsumexp(
        [
            _log_normal(z, noise + _element_covariance(H, np.hypot(sigma, far)))[0]
            for _, far in COMPANIONS
        ],
        b=[share for share, _ in COMPANIONS],
    )
    # An unrelated object may be anywhere; its motion is at most as likely as the satellite's.
    other = match - at_anchor + np.log(OTHERS_PER_KM3)
    return Candidate(
        row,
        at_anchor_km,
        P,
        jacobian,
        sigma,
        age,
        match,
        float(companion),
        other,
        fits and fits_there,
    )


def _element_covariance(jacobian: Array, sigma: Array) -> Array:
    """Return the (k, k) covariance of positions due to the errors of elements, [km^2]."""
    return np.asarray((jacobian * sigma**2) @ jacobian.T)


def _block_diagonal(blocks: Array) -> Array:
    m = len(blocks)
    out = np.zeros((m, 3, m, 3))
    out[np.arange(m), :, np.arange(m), :] = blocks
    return out.reshape(3 * m, 3 * m)


def usual_sizes(sigma: Array) -> list[tuple[Array, float]]:
    """Return the 1-sigma errors of elements that are as good as most, or worse, and their shares.

    `sigma` (..., 6) is of most; the others are of `QUALITIES`.
    """
    return [(factor * sigma, share) for factor, share in QUALITIES]


def error_sizes(sigma: Array, age_days: float | Array) -> list[tuple[Array, float]]:
    """Return the same with satellites that thrust, of elements of some ages."""
    usual = 1.0 - sum(share for share, _ in THRUSTING)
    sizes = [(size, share * usual) for size, share in usual_sizes(sigma)]
    thrust = [(thrust_errors(age_days, km_day), share) for share, km_day in THRUSTING]
    return sizes + [(np.hypot(sigma, size), share) for size, share in thrust]


def thrust_errors(age_days: float | Array, km_day: float) -> Array:
    """Return the 1-sigma errors of satellites that thrust, beyond the usual ones, (..., 6)."""
    growth = np.zeros((*np.shape(age_days), 6))
    growth[..., 0], growth[..., 5] = km_day * np.abs(age_days), km_day
    return np.hypot(THRUSTING_KM, growth)


def _log_mixture(
    z: Array, noise: Array, jacobian: Array, sizes: Sequence[tuple[Array, float]]
) -> tuple[float, bool]:
    """Return the log density of a difference, and whether it passes the chi-square test.

    A mixture over the sizes of the elements' errors, with their shares.
    """
    terms = [_log_normal(z, noise + _element_covariance(jacobian, size)) for size, _ in sizes]
    density = logsumexp([term for term, _ in terms], b=[share for _, share in sizes])
    return float(density), min(d2 for _, d2 in terms) < chi2_quantile(len(z))


def _log_normal(z: Array, S: Array) -> tuple[float, float]:
    """Return the log density of a normal distribution, and the squared Mahalanobis distance."""
    L = np.linalg.cholesky(S)
    d2 = float(np.sum(np.linalg.solve(L, z) ** 2))
    log_det = 2 * float(np.log(np.diag(L)).sum())
    return -(d2 + log_det + len(z) * LN_2PI) / 2, d2


def chi2_quantile(size: int) -> float:
    """Return the chi-square that a share `GATE_SHARE` of true matches of this size is below."""
    return float(2 * gammaincinv(size / 2, GATE_SHARE))


class NameVerdict(NamedTuple):
    """Which satellite an object is.

    `status` is known, ambiguous or unknown. `probability` is that of the status: that the object is
    the satellite, any of the satellites, or another object. `best` is the likeliest satellite; for
    an unknown object the nearest one. `rows` are the catalogue's rows of the possible satellites,
    the likeliest first.
    """

    status: str
    probability: float
    best: Candidate | None
    rows: tuple[int, ...] = ()


def judge(found: Sequence[Candidate], min_probability: float) -> NameVerdict:
    """Return which of its candidates an object is.

    `min_probability` is the minimum probability of a known object.
    """
    if not found:
        return NameVerdict("unknown", 1.0, None)
    match = np.array([each.log_match if each.fits else -np.inf for each in found])
    likeliest = max(found, key=lambda each: each.log_match)
    rest = [*(each.log_companion for each in found), likeliest.log_other]
    total = logsumexp([*match, *rest])
    share = np.exp(match - total)
    best = int(np.argmax(share))
    order = np.argsort(-share, kind="stable")
    rows = tuple(found[k].row for k in order if share[k] >= MIN_LISTED)
    if share[best] >= min_probability:
        return NameVerdict("known", float(share[best]), found[best], rows)
    if share.sum() >= 0.5:
        return NameVerdict("ambiguous", float(share.sum()), found[best], rows)
    nearest = min(found, key=lambda each: each.mahalanobis)
    return NameVerdict("unknown", float(1.0 - share.sum()), nearest)


def spread_rows(time_ns: Integers, preferred: Flags) -> Indices:
    """Return at most `MAX_ROWS` rows, evenly spread over the time and in its order.

    Only preferred rows, if there are any.
    """
    rows = np.flatnonzero(preferred) if preferred.any() else np.arange(len(time_ns))
    if len(rows) <= MAX_ROWS:
        return rows
    wanted = np.linspace(time_ns[rows[0]], time_ns[rows[-1]], MAX_ROWS)
    return np.unique(rows[np.searchsorted(time_ns[rows], wanted).clip(0, len(rows) - 1)])


# Errors of elements, learnt from matches


class Residual(Protocol):
    """An observed minus a predicted value, and where its error is from.

    `offset` (k,), its covariance `cov` (k, k) without the errors of the elements, and its
    derivatives `jacobian` (k, 6) by these errors, in any one set of units.
    """

    @property
    def offset(self) -> Array: ...
    @property
    def cov(self) -> Array: ...
    @property
    def jacobian(self) -> Array: ...
    @property
    def age_days(self) -> float: ...


def learn_errors(
    matches: Sequence[Residual], satellites: Sequence[object], start: ElementErrors
) -> ElementErrors:
    """Return the most probable errors of elements, from the differences of certain matches.

    Parameters
    ----------
    matches
        Certain matches.
    satellites
        Their satellites of SGP4, in the same order.
    start
        The prior.

    Returns
    -------
    ElementErrors
        The maximum of the posterior density over four factors: of the error along the track at the
        epoch, of its growth, of the radial and of the across error. `start` with fewer than
        `MIN_MATCHES` matches.
    """
    if len(matches) < MIN_MATCHES:
        return start

    offset = np.array([match.offset for match in matches])
    cov = np.array([match.cov for match in matches])
    jacobian = np.array([match.jacobian for match in matches])

    def cost(log_factors: Array) -> float:
        errors = _scaled(start, np.exp(log_factors))
        sigma = np.array(
            [sigmas(s, m.age_days, errors) for s, m in zip(satellites, matches, strict=True)]
        )
        S = cov + (jacobian * sigma[:, None, :] ** 2) @ np.swapaxes(jacobian, 1, 2)
        d2 = np.einsum("ni,ni->n", offset, np.linalg.solve(S, offset[:, :, None])[:, :, 0])
        log_det = np.linalg.slogdet(S)[1]
        return float((d2 + log_det).sum() + (log_factors**2).sum() / PRIOR_SIGMA**2)

    corners = np.vstack([np.zeros(4), SIMPLEX_STEP * np.eye(4)])
    options = {"initial_simplex": corners, "xatol": 0.01, "fatol": 0.01}
    found = minimize(cost, np.zeros(4), method="Nelder-Mead", options=options)
    return _scaled(start, np.exp(found.x))


def with_learnt_errors(
    catalogue: KnownSatellites, rows: Sequence[int], matches: Sequence[Residual]
) -> KnownSatellites:
    """Return the catalogue with the errors of its elements as certain matches show them.

    `rows` are the matches' satellites in the catalogue.
    """
    errors = []
    for is_deep, start in ((False, catalogue.low), (True, catalogue.high)):
        of_kind = [
            (match, catalogue.satellites[row])
            for row, match in zip(rows, matches, strict=True)
            if is_deep_space(catalogue.satellites[row]) == is_deep
        ]
        errors.append(learn_errors([m for m, _ in of_kind], [s for _, s in of_kind], start))
    low, high = errors
    return catalogue._replace(low=low, high=high)


def _scaled(errors: ElementErrors, factors: Array) -> ElementErrors:
    at_epoch, growth, radial, across = factors.tolist()
    return ElementErrors(
        errors.along_km * at_epoch,
        errors.along_km_day * growth,
        errors.radial_km * radial,
        errors.radial_km_day * radial,
        errors.across_km * across,
        errors.across_km_day * across,
    )
