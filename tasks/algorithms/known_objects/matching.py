"""Matching: the probability that an object of the night is a given satellite of a catalogue.

An object's positions are compared with a satellite's prediction at the same times. Their
difference has the covariance of the positions, and that of the elements' errors, which all rows
share. Each satellite is a hypothesis. So is an object that the catalogue does not have: an
unrelated one, or a companion of a listed one. Companions matter: satellites that share a
geostationary slot, and parts of one launch, are near each other.

`learn_errors` estimates the size of the elements' errors from the certain matches of a night.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import gammaincinv, logsumexp

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

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MAX_ROWS = 8  # positions of an object that are compared
KEPT_SHARE = 0.9999  # share of true matches that pass the chi-square test
REACH_SIGMA = 6.0
# Companions that are not listed: the share of satellites that have one, and how far it is, as
# errors of elements would put it there: in one slot, and in one plane.
COMPANIONS = ((0.05, (50.0, 25.0, 25.0, 50.0, 50.0, 5.0)), (0.05, (300.0, 5.0, 5.0, 5.0, 5.0, 5.0)))
COMPANION_KM = 50.0
# Density of other objects [1/km^3]: that of all tracked objects in low orbit.
OTHERS_KM3 = 1e-8
# Errors of element sets, in units of the usual ones, and the share of such sets.
QUALITIES = ((1.0, 0.8), (2.0, 0.15), (4.0, 0.05))
WORST = QUALITIES[-1][0]
MIN_NAMED = 1e-3  # probability of a satellite that an ambiguous object may be
DRAG_REACH_KM_DAY2 = 0.2  # unknown drag of a satellite that comes down soon
DAY_NS = 86_400_000_000_000
# What is known before: each error is right within a factor of three (1-sigma of its logarithm).
PRIOR_SIGMA = float(np.log(3.0))
SIMPLEX_STEP = 0.7  # first step of the search, in ln of a factor: a factor of two
MIN_MATCHES = 5  # minimum number of matches to learn from


class Observed(NamedTuple):
    """Some positions of one object: at m times.

    time_ns : (m,) int
        UTC since 1970, in order.
    r_km : (m, 3) float
        GCRF.
    cov : (m, 3, 3) float
        Their covariances [km^2]. Their errors may be common to all of them.
    """

    time_ns: npt.NDArray[np.int64]
    r_km: Array
    cov: Array

    @property
    def anchor(self) -> int:
        """The row that is best known."""
        return int(np.argmin(np.trace(self.cov, axis1=1, axis2=2)))


class KnownSatellites(NamedTuple):
    """The satellites of a catalogue that are compared, and the errors of their elements.

    satellites
        Of SGP4; n of them.
    epoch_ns : (n,) int
        Epochs of the elements.
    low, high
        Errors of the elements of low orbits and of those with periods above 225 minutes.
    """

    satellites: Satellites
    epoch_ns: npt.NDArray[np.int64]
    low: ElementErrors
    high: ElementErrors

    def sigmas(self, row: int, time_ns: int) -> Array:
        """Return the errors of a satellite at a time; see `prediction.sigmas`."""
        satellite = self.satellites[row]
        errors = self.high if is_deep_space(satellite) else self.low
        return sigmas(satellite, (time_ns - int(self.epoch_ns[row])) / DAY_NS, errors)


class Candidate(NamedTuple):
    """A satellite that an object may be.

    `apart_km` (3,) is the object minus the prediction at the anchor: along, up, across. In these
    axes `cov` (3, 3) is the covariance of the object's position, `lever` (3, 6) the derivatives of
    the prediction by the errors of the elements, and `sigma` (6,) these errors.
    """

    row: int  # of the catalogue
    apart_km: Array
    cov: Array
    lever: Array
    sigma: Array
    age_days: float
    log_match: float
    log_companion: float
    log_other: float
    fits: bool

    @property
    def distance_km(self) -> float:
        """Distance of the object from the prediction."""
        return float(np.linalg.norm(self.apart_km))

    @property
    def mahalanobis(self) -> float:
        """The same in units of its standard deviation."""
        S = self.cov + _spread(self.lever, self.sigma)
        return float(np.sqrt(self.apart_km @ np.linalg.solve(S, self.apart_km)))


def candidates(observed: Observed, catalogue: KnownSatellites, screen: Screen) -> list[Candidate]:
    """Return the satellites that an object may be, and others near it, in the catalogue's order."""
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
    """Return how far a prediction may be from the object, about: (n,) [km]."""
    widest = [
        max(getattr(catalogue.low, name), getattr(catalogue.high, name))
        for name in ("along_km", "along_km_day")
    ]
    along = np.hypot(widest[0], widest[1] * age_days) + DRAG_REACH_KM_DAY2 * age_days**2
    spread = np.sqrt(np.trace(cov))
    return np.asarray(REACH_SIGMA * np.hypot(WORST * along, spread) + 2 * COMPANION_KM)


def _candidate(
    observed: Observed, catalogue: KnownSatellites, row: int, states: Array
) -> Candidate | None:
    k = observed.anchor
    time_ns, state = int(observed.time_ns[k]), states[k]
    axes = along_up_across(state)
    apart = observed.r_km - states[:, :3]
    here, P = axes @ apart[k], axes @ observed.cov[k] @ axes.T
    sigma = catalogue.sigmas(row, time_ns)
    reach = WORST * (sigma[[0, 1, 3]] + 2 * sigma[1]) + np.sqrt(np.diag(P))
    if (np.abs(here) > REACH_SIGMA * reach + 2 * COMPANION_KM).any():
        return None
    H = sensitivities(catalogue.satellites[row], observed.time_ns, k)
    lever = axes @ H[k]
    H = H.reshape(-1, 6)
    from_elements = _spread(H, sigma)
    # Errors that all rows share count once: m rows tell as much as one, and the motion.
    noise = _block_diagonal(observed.cov * len(observed.cov))
    z = apart.ravel()
    match, fits = _log_mixture(z, noise, from_elements)
    at_anchor, fits_there = _log_mixture(here, P, _spread(lever, sigma))
    companion = logsumexp(
        [
            _log_normal(z, noise + from_elements + _spread(H, np.array(far)))[0]
            for _, far in COMPANIONS
        ],
        b=[share for share, _ in COMPANIONS],
    )
    age = (time_ns - int(catalogue.epoch_ns[row])) / DAY_NS
    # Another object would be anywhere, and move as it may: at most as likely as this one's motion.
    other = match - at_anchor + np.log(OTHERS_KM3)
    return Candidate(
        row, here, P, lever, sigma, age, match, float(companion), other, fits and fits_there
    )


def _spread(lever: Array, sigma: Array) -> Array:
    """Return the covariance of places by the errors of the elements."""
    return np.asarray((lever * sigma**2) @ lever.T)


def _block_diagonal(blocks: Array) -> Array:
    m = len(blocks)
    out = np.zeros((m, 3, m, 3))
    out[np.arange(m), :, np.arange(m), :] = blocks
    return out.reshape(3 * m, 3 * m)


def _log_mixture(z: Array, noise: Array, from_elements: Array) -> tuple[float, bool]:
    """Return the log-density of a difference, and whether it fits.

    Catalogues are uneven: the errors of some element sets are several times the usual ones.
    """
    terms = [_log_normal(z, noise + factor**2 * from_elements) for factor, _ in QUALITIES]
    density = logsumexp([term for term, _ in terms], b=[share for _, share in QUALITIES])
    return float(density), min(d2 for _, d2 in terms) < _quantile(len(z))


def _log_normal(z: Array, S: Array) -> tuple[float, float]:
    """Return the logarithm of the normal density, and the squared Mahalanobis distance."""
    L = np.linalg.cholesky(S)
    d2 = float(np.sum(np.linalg.solve(L, z) ** 2))
    log_det = 2 * float(np.log(np.diag(L)).sum())
    return -(d2 + log_det + len(z) * np.log(2 * np.pi)) / 2, d2


def _quantile(size: int) -> float:
    return float(2 * gammaincinv(size / 2, KEPT_SHARE))  # chi-square


class NameVerdict(NamedTuple):
    """What an object is.

    `probability` is that of the status: of the satellite where it is known, of any of the
    satellites that it may be where that is ambiguous, of none of them where it is unknown.
    `best` is the likeliest satellite, or the nearest one that it is not; `rows` of the catalogue
    are those that it may be, the likeliest first.
    """

    status: str
    probability: float
    best: Candidate | None
    rows: tuple[int, ...] = ()


def judge(found: Sequence[Candidate], min_probability: float) -> NameVerdict:
    """Return what an object is, by its candidates.

    `min_probability` is the minimum probability of a name.
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
    rows = tuple(found[k].row for k in order if share[k] >= MIN_NAMED)
    if share[best] >= min_probability:
        return NameVerdict("known", float(share[best]), found[best], rows)
    if share.sum() >= 0.5:
        return NameVerdict("ambiguous", float(share.sum()), found[best], rows)
    nearest = min(found, key=lambda each: each.mahalanobis)
    return NameVerdict("unknown", float(1.0 - share.sum()), nearest)


def spread_rows(time_ns: npt.NDArray[np.int64], preferred: npt.NDArray[np.bool_]) -> Indices:
    """Return at most `MAX_ROWS` rows that are spread over the time; preferred ones where any are.

    The rows are in order of time.
    """
    rows = np.flatnonzero(preferred) if preferred.any() else np.arange(len(time_ns))
    if len(rows) <= MAX_ROWS:
        return rows
    wanted = np.linspace(time_ns[rows[0]], time_ns[rows[-1]], MAX_ROWS)
    return np.unique(rows[np.searchsorted(time_ns[rows], wanted).clip(0, len(rows) - 1)])


# Errors of elements, learnt from matches


def learn_errors(
    matches: Sequence[Candidate], satellites: Sequence[object], start: ElementErrors
) -> ElementErrors:
    """Return the errors of elements under which the differences of sure matches are likeliest.

    Parameters
    ----------
    matches
        Sure matches.
    satellites
        Those of SGP4 that they are, in the same order.
    start
        What is known of the errors before.

    Returns
    -------
    ElementErrors
        The greatest posterior density, by the factors of: the error along at the epoch, its growth,
        the radial and the across error. `start` where there are fewer than `MIN_MATCHES` matches.
    """
    if len(matches) < MIN_MATCHES:
        return start

    apart_km = np.array([match.apart_km for match in matches])
    cov = np.array([match.cov for match in matches])
    lever = np.array([match.lever for match in matches])

    def cost(log_factors: Array) -> float:
        errors = _scaled(start, np.exp(log_factors))
        sigma = np.array(
            [sigmas(s, m.age_days, errors) for s, m in zip(satellites, matches, strict=True)]
        )
        S = cov + (lever * sigma[:, None, :] ** 2) @ np.swapaxes(lever, 1, 2)
        d2 = np.einsum("ni,ni->n", apart_km, np.linalg.solve(S, apart_km[:, :, None])[:, :, 0])
        log_det = np.linalg.slogdet(S)[1]
        return float((d2 + log_det).sum() + (log_factors**2).sum() / PRIOR_SIGMA**2)

    corners = np.vstack([np.zeros(4), SIMPLEX_STEP * np.eye(4)])
    options = {"initial_simplex": corners, "xatol": 0.01, "fatol": 0.01}
    found = minimize(cost, np.zeros(4), method="Nelder-Mead", options=options)
    return _scaled(start, np.exp(found.x))


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
