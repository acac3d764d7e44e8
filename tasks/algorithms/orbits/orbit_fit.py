"""Orbit fit: position and velocity of an object over an arc, from all its lines of sight.

The unknowns are the state at one instant and, for each sensor, the errors that all its views
share: of the directions and of the position, both with a prior covariance. So a shared error does
not average out over the arc; only independent errors do.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import GM_KM3_S2, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations, no_equations

LIGHT = SPEED_OF_LIGHT_KM_S
STEP_S = 10.0  # longest step of the propagation: right to 1 m over 10 minutes of a low orbit
ITERATIONS = 20
CONVERGED = 1e-6  # decrease of chi-square
MIN_BIAS_RAD = 5e-9  # 1 mas: keeps the prior invertible if nothing is shared
MIN_POSITION_KM = 1e-6


class Arcs(NamedTuple):
    """Views of objects, arc by arc: those of arc k are ``offsets[k]:offsets[k + 1]``.

    time_s : (n,) float
        Time of the exposure since the instant of the arc's state [s], increasing.
    sensor : (n,) int
        Sensor of the view; any numbers, from 0.
    r_km, u : (n, 3) float
        Reported position of the sensor, GCRF [km]; direction to the object without aberration.
    cov_noise, cov_bias : (n, 2, 2) float
        Covariance of the independent error of each view, and of the error that all views of a
        sensor share, on `tangent_basis(u)` [rad^2].
    sigma_km : (n,) float
        1-sigma error of the sensor's position, per axis, shared by all its views [km].
    """

    offsets: Indices
    time_s: Array
    sensor: Indices
    r_km: Array
    u: Array
    cov_noise: Array
    cov_bias: Array
    sigma_km: Array


class ArcViews(NamedTuple):
    """Views of a single arc, for kernels.

    time_s, sensor, r_km, u
        As in `Arcs`, the sensors numbered from 0.
    basis, weight : (n, 2, 3), (n, 2, 2) float
        Tangent bases of the directions, and inverse covariances of the noise [rad^-2].
    """

    time_s: Array
    sensor: Indices
    r_km: Array
    u: Array
    basis: Array
    weight: Array


def propagate(state: Array, dt_s: float) -> Array:
    """Return a (6,) state [km, km/s], GCRF, propagated by dt_s: point mass and J2.

    The Earth's axis is taken as the z axis of the ICRS, from which it is 0.1 degrees off.
    """
    return trajectory(state, np.array([dt_s]))[0][0]


def trajectory(state: Array, dt_s: Array) -> tuple[Array, Array]:
    """Return a (6,) state propagated by several times, with its transition matrices.

    Parameters
    ----------
    state : (6,) float
        Position [km] and velocity [km/s], GCRF; forces as in `propagate`.
    dt_s : (n,) float
        Times [s] since the state; fastest in order.

    Returns
    -------
    state : (n, 6) float
    transition : (n, 6, 6) float
        Derivatives of these states by the given one, for two bodies.
    """
    out, work = np.empty((len(dt_s), 42)), np.empty((5, 42))
    begin = np.concatenate([np.asarray(state, float), np.eye(6).ravel()])
    y, now = begin.copy(), 0.0
    for k, t in enumerate(np.asarray(dt_s, float).tolist()):
        if (t - now) * t < 0.0 or now * t < 0.0:  # back towards the start, or across it
            y, now = begin.copy(), 0.0
        advance(y, t - now, STEP_S, work)
        out[k], now = y, t
    return out[:, :6], out[:, 6:].reshape(-1, 6, 6)


@kernel
def _accumulate(y, view, shared, sums, s):
    """Add one view of sensor s to the normal equations; return its chi-square.

    `y` (42,) is the object's state with transition matrix, GCRF. `view` is (r, u, basis, weight) as
    in `ArcViews`. `shared` (6,) are the sensor's errors of direction [rad] and position [km] at
    present. `sums` is `ArcEquations`. NaN if the object is behind the sensor.
    """
    r, u, basis, W = view
    delay = 0.0
    d = np.empty(3)
    for _ in range(2):  # light time; two iterations are right to a millimetre
        rho2 = 0.0
        for a in range(3):
            r2 = y[0] * y[0] + y[1] * y[1] + y[2] * y[2]
            pull = GM_KM3_S2 / (r2 * np.sqrt(r2))
            d[a] = y[a] - delay * y[3 + a] - 0.5 * delay * delay * pull * y[a]
            d[a] += shared[3 + a] - r[a]
            rho2 += d[a] * d[a]
        rho = np.sqrt(rho2)
        delay = rho / LIGHT
    if d[0] * u[0] + d[1] * u[1] + d[2] * u[2] <= 0.0:
        return np.nan
    J, e = np.zeros((2, 12)), np.zeros(2)
    for i in range(2):
        for a in range(3):
            e[i] += basis[i, a] * (d[a] / rho + shared[a])
            J[i, 6 + a] = basis[i, a]
            J[i, 9 + a] = basis[i, a] / rho
            for k in range(6):
                moved = y[6 + 6 * a + k] - delay * y[6 + 6 * (3 + a) + k]
                J[i, k] += basis[i, a] / rho * moved
    state, coupling, blocks, of_state, of_sensors = sums
    chi2 = 0.0
    for i in range(2):
        for j in range(2):
            chi2 += e[i] * W[i, j] * e[j]
            for k in range(6):
                of_state[k] -= J[i, k] * W[i, j] * e[j]
                of_sensors[s, k] -= J[i, 6 + k] * W[i, j] * e[j]
                for m in range(6):
                    state[k, m] += J[i, k] * W[i, j] * J[j, m]
                    coupling[s, k, m] += J[i, 6 + k] * W[i, j] * J[j, m]
                    blocks[s, k, m] += J[i, 6 + k] * W[i, j] * J[j, 6 + m]
    return chi2


@kernel
def _add_views(state, errors, views, sums):
    """Add all views to the normal equations; return their chi-square, NaN if one fails.

    `state` (6,) [km, km/s], GCRF; `errors` (s, 6) shared errors of each sensor [rad, km]; `views`
    is `ArcViews`, `sums` is `ArcEquations`.
    """
    time_s, sensor, r, u, basis, weight = views
    work, chi2 = np.empty((5, 42)), 0.0
    middle = np.searchsorted(time_s, 0.0)
    for later in range(2):
        y = np.zeros(42)
        y[:6] = state
        for a in range(6):
            y[6 + 7 * a] = 1.0
        now = 0.0
        for q in range(len(time_s) - middle if later else middle):
            i = middle + q if later else middle - 1 - q
            advance(y, time_s[i] - now, STEP_S, work)
            now = time_s[i]
            view = (r[i], u[i], basis[i], weight[i])
            chi2 += _accumulate(y, view, errors[sensor[i]], sums, sensor[i])
    return chi2


def _fit(state: Array, prior: Array, views: ArcViews) -> tuple[Array, Array, float, ArcEquations]:
    """Return state, covariance, chi-square and equations of one arc; NaN if the fit fails.

    The equations are without the prior. The errors of each sensor are eliminated before the state
    is solved: the cost grows with the number of sensors, not with its cube.
    """
    errors = np.zeros((len(prior), 6))
    failed = np.full(6, np.nan), np.full((6, 6), np.nan), np.nan, no_equations(len(prior))
    for _ in range(ITERATIONS):
        pull = (prior @ errors[:, :, None])[:, :, 0]
        sums = no_equations(len(prior))
        chi2 = float(np.sum(errors * pull)) + _add_views(state, errors, views, sums)
        blocks = sums.blocks + prior
        if not (np.isfinite(chi2) and (np.diag(sums.state) > 0.0).all()):
            return failed
        try:
            absorbed = _solve(blocks, np.concatenate(
                [sums.coupling, (sums.of_sensors - pull)[:, :, None]], axis=2))  # fmt: skip
            back = np.einsum("ski,skj->ij", sums.coupling, absorbed)
            cov = _inverse(sums.state - back[:, :6])
        except np.linalg.LinAlgError:
            return failed
        step = cov @ (sums.of_state - back[:, 6])
        turned = absorbed[:, :, 6] - absorbed[:, :, :6] @ step
        gain = float(step @ sums.of_state + np.sum(turned * (sums.of_sensors - pull)))
        if not abs(gain) < 1e14:
            return failed
        state, errors = state + step, errors + turned
        if gain < CONVERGED:
            # The last step is below a thousandth of a sigma.
            return state, cov, chi2 - gain, _about_no_errors(sums, prior, errors)
    return failed


def _solve(matrices: Array, right: Array) -> Array:
    """Solve (s, 6, 6) symmetric systems, scaled: the unknowns are km and radians."""
    scale = 1.0 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    scaled = matrices * scale[:, :, None] * scale[:, None, :]
    return np.asarray(scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right))


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a (6, 6) matrix, scaled: the unknowns are km and km/s."""
    diagonal = np.diag(matrix)
    if not (diagonal > 0.0).all():
        raise np.linalg.LinAlgError
    scale = 1.0 / np.sqrt(diagonal)
    return np.asarray(np.linalg.inv(matrix * scale[:, None] * scale) * scale[:, None] * scale)


def _about_no_errors(sums: ArcEquations, prior: Array, errors: Array) -> ArcEquations:
    """Return the equations at the solution, with right sides for errors counted from zero.

    At the solution the gradient of the lines of sight balances that of the prior.
    """
    of_sensors = np.einsum("sij,sj->si", prior, errors) + np.einsum(
        "sij,sj->si", sums.blocks, errors
    )
    of_state = np.einsum("ski,sk->i", sums.coupling, errors)
    return sums._replace(of_state=of_state, of_sensors=of_sensors)


class FittedOrbits(NamedTuple):
    """States of g arcs.

    state : (g, 6) float
        Position [km] and velocity [km/s], GCRF, at the instant from which the times count;
        NaN where the fit fails (too few views, an object behind a sensor, no convergence).
    cov : (g, 6, 6) float
        Covariance.
    chi2 : (g,) float
        Weighted sum of squares, with the shared errors'; 2 n - 6 degrees of freedom.
    equations : g of (array of sensors, ArcEquations)
        Equations of each arc's state and its sensors' errors, without the prior.
    """

    state: Array
    cov: Array
    chi2: Array
    equations: list[tuple[Indices, ArcEquations]]


def fit_orbits(arcs: Arcs, start: Array) -> FittedOrbits:
    """Return the least-squares states of arcs, with covariances.

    Parameters
    ----------
    arcs
        The views. No two of a sensor may share a detection: their noise must be independent.
    start : (g, 6) float
        Initial states [km, km/s], GCRF; errors small against the distances to the sensors.

    Notes
    -----
    Shared errors are taken as constant in ICRS axes over the arc, as they are for a sensor that
    keeps its roll. Forces: see `propagate`. Over 10 minutes the neglected ones (Moon, Sun, other
    harmonics) are below 2 m.

    References
    ----------
    Gauss-Newton; Tapley, Schutz, Born (2004), Statistical Orbit Determination, section 4.
    """
    g = len(arcs.offsets) - 1
    state, cov = np.array(start, float).reshape(g, 6), np.full((g, 6, 6), np.nan)
    chi2, equations = np.full(g, np.nan), []
    basis, weight = tangent_basis(arcs.u), np.asarray(np.linalg.inv(arcs.cov_noise), float)
    for k in range(g):
        rows = slice(arcs.offsets[k], arcs.offsets[k + 1])
        names, sensor = np.unique(arcs.sensor[rows], return_inverse=True)
        if rows.stop - rows.start < 3:
            state[k] = np.nan
            equations.append((names[:0], no_equations(0)))
            continue
        views = ArcViews(
            arcs.time_s[rows], sensor.astype(np.int64), arcs.r_km[rows], arcs.u[rows], basis[rows],
            weight[rows],
        )  # fmt: skip
        prior = prior_information(arcs, rows, sensor, len(names))
        state[k], cov[k], chi2[k], of_arc = _fit(state[k], prior, views)
        equations.append((names, of_arc))
    return FittedOrbits(state, cov, chi2, equations)


def prior_information(arcs: Arcs, rows: slice, sensor: Indices, n_sensors: int) -> Array:
    """Return (s, 6, 6) inverse covariances of each sensor's errors: direction, then position.

    [rad^-2, km^-2]. `sensor` has the sensor of each of the rows; zeros for a sensor without rows.
    """
    out = np.zeros((n_sensors, 6, 6))
    basis = tangent_basis(arcs.u[rows])
    across = np.swapaxes(basis, -1, -2) @ arcs.cov_bias[rows] @ basis
    # An error along the line of sight has no effect; it keeps the matrix invertible.
    along = np.trace(arcs.cov_bias[rows], axis1=-2, axis2=-1) / 2
    full = across + along[:, None, None] * arcs.u[rows][:, :, None] * arcs.u[rows][:, None, :]
    for s in np.unique(sensor).tolist():
        of_sensor = sensor == s
        direction = full[of_sensor].mean(axis=0) + MIN_BIAS_RAD**2 * np.eye(3)
        out[s, :3, :3] = np.linalg.inv(direction)
        position_km = max(float(arcs.sigma_km[rows][of_sensor].mean()), MIN_POSITION_KM)
        out[s, 3:, 3:] = np.eye(3) / position_km**2
    return out
