"""Arc fit: one orbit through several attributables, and the evidence that they are one object."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import GM_KM3_S2, LN_2PI, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbit_linking.population import COMPONENTS, prior_of
from epipole.tasks.algorithms.symmetric_matrices import factor, solve_factored

STEP_S = 60.0  # longest step of the propagation: right to 5 m in half an hour of a low orbit
ITERATIONS = 12  # of Gauss and Newton; a fit that needs more fails
CONVERGED = 1e-3  # decrease of chi-square: the log evidence is then right to half of it
# Neglected accelerations, as a share of gravity: harmonics of the Earth beyond J2 are 1e-6 to 1e-5.
SHARE_OF_GRAVITY = 1e-5
MIN_COSINE = 0.5  # of the angle between measured and computed direction: beyond, a fit fails


class Tracklets(NamedTuple):
    """Attributables of n tracklets, sorted by time.

    time_s, first_s, last_s : (n,) float
        Epoch of the attributable, first and last detection [s].
    sensor : (n,) int
        Sensors, numbered from 0.
    r_km, v_km_s : (n, 3) float
        Sensor position [km] and velocity [km/s], GCRF.
    u, east, north, w : (n, 3) float
        Astrometric direction, the axes at right angles to it, and its rate [rad/s].
    cov : (n, 4, 4) float
        Covariance of (east, north, their rates) [rad, rad/s].
    position_km : (n,) float
        1-sigma of the sensor position, per axis [km].
    """

    time_s: Array
    first_s: Array
    last_s: Array
    sensor: Indices
    r_km: Array
    v_km_s: Array
    u: Array
    east: Array
    north: Array
    w: Array
    cov: Array
    position_km: Array


@kernel
def _relative(y, tracklets, k, d, s):
    """Write the direction d (3,) and the relative velocity s (3,) [km/s] as sensor k sees them.

    Of an object with the state y (6,) or longer [km, km/s], GCRF, at the time of tracklet k.
    Returns the range [km] and its rate [km/s]. Light time is included.
    """
    delay, rho, q = 0.0, 0.0, 0.0
    for _ in range(2):
        rho2 = 0.0
        for a in range(3):
            d[a] = y[a] - delay * y[3 + a] - tracklets.r_km[k, a]
            rho2 += d[a] * d[a]
        rho = np.sqrt(rho2)
        delay = rho / SPEED_OF_LIGHT_KM_S
    for a in range(3):
        d[a] /= rho
        q += d[a] * (y[3 + a] - tracklets.v_km_s[k, a])
    for a in range(3):  # the object is seen at a time that passes slower if it recedes
        s[a] = y[3 + a] * (1.0 - q / SPEED_OF_LIGHT_KM_S) - tracklets.v_km_s[k, a]
    return rho, q


@kernel
def _compare(y, tracklets, k, gap_s, work):
    """Write the residuals of a tracklet, their derivatives by the orbit, and their weights.

    To e (4,), J (4, 6) and W (4, 4) of `work`. y (42,) is the orbit at the tracklet's time, as in
    `advance`. `gap_s` is the time from the arc's epoch. Returns the log determinant of the
    covariance; NaN if the object is behind the sensor.
    """
    d, s, H = work.d, work.s, work.H
    rho, q = _relative(y, tracklets, k, d, s)
    ahead = 0.0
    for a in range(3):
        ahead += d[a] * tracklets.u[k, a]
    if ahead < MIN_COSINE:
        return np.nan
    for i in range(2):
        axis = tracklets.east[k] if i == 0 else tracklets.north[k]
        off, rate, measured = 0.0, 0.0, 0.0
        for a in range(3):
            off += axis[a] * d[a]
            rate += axis[a] * (s[a] - q * d[a]) / rho
            measured += axis[a] * tracklets.w[k, a]
        work.e[i], work.e[2 + i] = off, rate - measured
        for a in range(3):
            H[i, a] = H[2 + i, 3 + a] = axis[a] / rho
            H[i, 3 + a] = 0.0
            H[2 + i, a] = -(rate * d[a] + q / rho * axis[a]) / rho
    for i in range(4):
        for m in range(6):
            work.J[i, m] = 0.0
            for a in range(6):
                work.J[i, m] += H[i, a] * y[6 + 6 * a + m]
    r2 = y[0] ** 2 + y[1] ** 2 + y[2] ** 2
    drift = 0.5 * SHARE_OF_GRAVITY * GM_KM3_S2 / r2 * gap_s**2
    extra = (tracklets.position_km[k] ** 2 + drift * drift) / (rho * rho)
    for i in range(4):
        for j in range(4):
            work.C[i, j] = tracklets.cov[k, i, j]
    work.C[0, 0] += extra
    work.C[1, 1] += extra
    return _invert(work.C, work.b, work.W)


@kernel
def _invert(C, b, W):
    """Write the inverse of C (4, 4) to W (4, 4); return log det C. C becomes its factor.

    b (4,) is scratch.
    """
    for j in range(4):
        b[j] = 0.0
    log_det = factor(C, b)
    for i in range(4):
        for j in range(4):
            b[j] = 1.0 if i == j else 0.0
        solve_factored(C, b)
        for j in range(4):
            W[i, j] = b[j]
    return log_det


@kernel
def _pull_derivatives(x, component, pulls, D):
    """Write the prior's pulls (2,) and their derivatives D (2, 6); return its log density.

    x (6,) [km, km/s], GCRF, is the state, and `component` one of the population.
    """
    log = prior_of(x, component, pulls)
    shifted = np.empty(2)
    for m in range(6):
        step = 1.0 if m < 3 else 1e-3
        keep = x[m]
        x[m] = keep + step
        prior_of(x, component, shifted)
        x[m] = keep
        for i in range(2):
            D[i, m] = (shifted[i] - pulls[i]) / step
    return log


class FitWork(NamedTuple):
    """Scratch of the fit, so that it makes no arrays. Residuals are as in `Tracklets.cov`.

    y, steps : (42,), (5, 42) float
        State and its derivatives by the orbit, and scratch of `advance`.
    N, rhs, gradient : (6, 6), (6,), (6,) float
        Normal equations, lower half, and a copy of their right-hand side.
    e, J, W, C : (4,), (4, 6), (4, 4), (4, 4) float
        Residuals of a tracklet, derivatives by the orbit, weights and covariance.
    H : (4, 6) float
        Derivatives of the residuals by the state at the time of the tracklet.
    b, d, s : (4,), (3,), (3,) float
        Scratch of `_invert`, and what `_relative` writes.
    D, pulls : (2, 6), (2,) float
        Derivatives of the prior's pulls by the orbit, and the pulls.
    states : (3, 6) float
        Orbits that `fit_arc` compares.
    """

    y: Array
    steps: Array
    N: Array
    rhs: Array
    gradient: Array
    e: Array
    J: Array
    W: Array
    H: Array
    C: Array
    b: Array
    d: Array
    s: Array
    D: Array
    pulls: Array
    states: Array


@kernel
def fit_work():
    """Return scratch for `fit_component`."""
    return FitWork(
        np.empty(42), np.empty((5, 42)), np.empty((6, 6)), np.empty(6), np.empty(6), np.empty(4),
        np.empty((4, 6)), np.empty((4, 4)), np.empty((4, 6)), np.empty((4, 4)), np.empty(4),
        np.empty(3), np.empty(3), np.empty((2, 6)), np.empty(2), np.empty((3, 6)),
    )  # fmt: skip


@kernel
def _add_tracklets(tracklets, members, epoch_s, state, work):
    """Write the normal equations of all members to N (6, 6), lower half, and rhs (6,) of `work`.

    `members` (m,) are rows of `tracklets`, in order of time, and `state` (6,) [km, km/s], GCRF, is
    the orbit at `epoch_s`. Returns their chi-square and the sum of the log determinants of their
    covariances, NaN if the object is behind a sensor.
    """
    y, middle = work.y, 0
    for m in range(6):
        work.rhs[m] = 0.0
        for n in range(6):
            work.N[m, n] = 0.0
    while middle < len(members) and tracklets.time_s[members[middle]] < epoch_s:
        middle += 1
    chi2, log_dets = 0.0, 0.0
    for side in range(2):  # from the epoch back, and on
        for m in range(42):
            y[m] = state[m] if m < 6 else 0.0
        for a in range(6):
            y[6 + 7 * a] = 1.0
        now = epoch_s
        for n in range(len(members) - middle if side else middle):
            k = members[middle + n] if side else members[middle - 1 - n]
            advance(y, tracklets.time_s[k] - now, STEP_S, work.steps)
            now = tracklets.time_s[k]
            log_det = _compare(y, tracklets, k, now - epoch_s, work)
            if not np.isfinite(log_det):
                return np.nan, np.nan
            log_dets += log_det
            chi2 += _add_one(work)
    return chi2, log_dets


@kernel
def _add_one(work):
    """Add the residuals of a tracklet to the normal equations; return their chi-square.

    By e (4,), J (4, 6) and W (4, 4) of `work`, to its N (6, 6), lower half, and rhs (6,).
    """
    e, J, W, chi2 = work.e, work.J, work.W, 0.0
    for i in range(4):
        for j in range(4):
            chi2 += e[i] * W[i, j] * e[j]
    for m in range(6):
        for j in range(4):
            weighted = 0.0
            for i in range(4):
                weighted += J[i, m] * W[i, j]
            work.rhs[m] -= weighted * e[j]
            for n in range(m + 1):
                work.N[m, n] += weighted * J[j, n]
    return chi2


@kernel
def _add_prior(state, component, work):
    """Add a component of the population; return the log of its density and its chi-square.

    To N (6, 6), lower half, and rhs (6,) of `work`, for a `state` (6,) [km, km/s], GCRF.
    """
    log, chi2 = _pull_derivatives(state, component, work.pulls, work.D), 0.0
    for i in range(2):
        chi2 += work.pulls[i] * work.pulls[i]
        for m in range(6):
            work.rhs[m] -= work.D[i, m] * work.pulls[i]
            for n in range(m + 1):
                work.N[m, n] += work.D[i, m] * work.D[i, n]
    return log, chi2


@kernel
def fit_component(tracklets, members, epoch_s, component, state, work):
    """Fit one orbit to attributables, with one component of the population as prior.

    Parameters
    ----------
    tracklets : Tracklets
    members : (m,) int
        Rows, in order of time.
    epoch_s : float
        Epoch of the state.
    component : int
        Of the population.
    state : (6,) float, in and out
        The orbit [km, km/s], GCRF.
    work : FitWork

    Returns
    -------
    log_evidence, chi2 : float
        The evidence is the density of the attributables, times the number of objects (Laplace's
        approximation). chi2 is that of the attributables. Both NaN if the fit fails.
    """
    before, rhs = np.inf, work.rhs
    for iteration in range(ITERATIONS):
        chi2, log_dets = _add_tracklets(tracklets, members, epoch_s, state, work)
        log, of_prior = _add_prior(state, component, work)
        total, gain = chi2 + of_prior, 0.0
        for m in range(6):
            work.gradient[m] = rhs[m]
        log_det = factor(work.N, rhs)
        if not (np.isfinite(total) and np.isfinite(log) and np.isfinite(log_det)):
            return np.nan, np.nan
        for m in range(6):
            gain += rhs[m] * work.gradient[m]
        if gain < CONVERGED or (iteration > 2 and abs(before - total) < CONVERGED):
            evidence = log - 0.5 * (total - gain) + 3.0 * LN_2PI - 0.5 * log_det
            return evidence - len(members) * 2.0 * LN_2PI - 0.5 * log_dets, chi2
        before = total
        for m in range(6):
            state[m] += rhs[m]
    return np.nan, np.nan


@kernel
def sort_rows(values):
    """Sort a few integers, `values` (m,), in place."""
    for k in range(1, len(values)):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


@kernel
def fit_arc(tracklets, members, epoch_s, state, work):
    """Fit one orbit; return its log evidence over all components, and chi-square of the likeliest.

    `members` (m,) are rows of `tracklets`, in order of time. `state` (6,) [km, km/s], GCRF, at
    `epoch_s` is where the fit begins; it becomes the orbit of the likelier component. NaN if no fit
    converges.
    """
    best, chi2_best, total = -np.inf, np.nan, -np.inf
    start, trial, kept = work.states[0], work.states[1], work.states[2]
    for m in range(6):
        start[m] = state[m]
    for component in range(COMPONENTS - 1, -1, -1):  # the wide one first: it starts the narrow one
        for m in range(6):
            trial[m] = start[m]
        evidence, chi2 = fit_component(tracklets, members, epoch_s, component, trial, work)
        if not np.isfinite(evidence):
            continue
        for m in range(6):
            if component == COMPONENTS - 1:
                start[m] = trial[m]
            if evidence > best:
                kept[m] = trial[m]
        total = np.logaddexp(total, evidence)
        if evidence > best:
            best, chi2_best = evidence, chi2
    if not np.isfinite(total):
        return np.nan, np.nan
    for m in range(6):
        state[m] = kept[m]
    return total, chi2_best
