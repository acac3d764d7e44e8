"""Orbit determination: one orbit of an object, fitted to all directions to it of a night.

The unknowns are the state at an epoch, two areas over mass with priors, and for each sensor the
errors that all its directions share: of the attitude and of the position, with their stated sigmas
as priors. A wide prior of the velocity keeps an orbit closed that the directions leave open, as
those of one satellite over a minute do. The fit begins with the directions near the initial state
and takes in the others by and by, so that it converges over many revolutions.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.constants import (
    EARTH_RADIUS_KM,
    GM_KM3_S2,
    SPEED_OF_LIGHT_KM_S,
)
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbits.forces import N_UNKNOWNS, Surroundings
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations, no_equations
from epipole.tasks.algorithms.orbits.trajectories import (
    integrate,
    interpolate_derivatives,
    interpolate_position,
    propagate_unknowns,
)

N_SHARED = 6  # unknowns of a sensor: direction [rad], then position [km]
ITERATIONS = 30
CONVERGED = 1e-4  # decrease of chi-square
HALVINGS = 8  # of a step that makes chi-square larger
FIRST_WINDOW_S = 600.0  # directions this near the initial state come first
WINDOW_GROWTH = 3.0
# A direction whose chi-square (2 degrees of freedom) is above this is of something else: as
# improbable as 1e-6. They are left out if they are at most this share.
OUTLIER_CHI2 = 27.6
MAX_OUTLIERS = 0.05
REFITS = 6
BACK_S = 2.0  # light time of the farthest objects
MIN_DIRECTIONS = 4
# 1-sigma of the radial and of the horizontal velocity about that of a circular orbit, over its
# speed: what all objects around the Earth have, eccentric ones too. At perigee, an eccentricity of
# 0.7 is 1.0 sigma from it. It moved the 24 orbits of a constellation, whose eccentricities have
# sigmas of 0.01 and less, by 1e-4 of their sigmas at most.
VELOCITY_SIGMA = 0.3
LEAST_KM_S = 1e-9  # least horizontal velocity: directions of one instant show none
# What the forces neglect, above all the Earth's field of degrees 3 to 6 beside J3 and J4. On eight
# low orbits these are 1.2e-5 of gravity (EGM96), and move the fit of 10, 45, 90 and 180 minutes by
# 1, 5, 12 and 32 m per axis. Fits to SGP4, whose theory neglects more, are off by up to four times
# that. Half an acceleration of this share of gravity, over half the arc and at most these seconds
# of it (it changes its sign), is 2, 21, 43 and 86 m at 800 km. With 6e-6, orbits of three hours of
# a simulated constellation that follows SGP4 have a squared error of 1.4 covariances; with 1e-5,
# 1.2, and those of 45 minutes 0.86.
NEGLECTED_SHARE = 1e-5  # at the ground; above it, degree 3 falls with the cube of the distance
NEGLECTED_S = 600.0
NEGLECTED_RATE = 1.5  # error of the velocity, over that of the position and the mean motion


class ObjectDirections(NamedTuple):
    """Directions from sensors to one object, in order of time; axes those of the night.

    time_s : (n,) float
        Mid-exposure times since the origin of `Surroundings`.
    sensor : (n,) int
        From 0, without gaps.
    r_km, u : (n, 3) float
        Position of the sensor; unit vector to the object, light time not removed.
    basis : (n, 2, 3) float
        Two unit vectors at right angles to u.
    weight : (n, 2, 2) float
        Inverse covariance of the direction on the basis [rad^-2], of independent errors.
    prior : (s, 6, 6) float
        Inverse covariance of the errors that all directions of a sensor share [rad, km].
    """

    time_s: Array
    sensor: Indices
    r_km: Array
    u: Array
    basis: Array
    weight: Array
    prior: Array


class AreaPrior(NamedTuple):
    """What is known of the areas over mass in sunlight and in the air, (2,) each [m^2/kg].

    A sigma of 0: the mean is right.
    """

    mean: Array
    sigma: Array


class DeterminedOrbit(NamedTuple):
    """An orbit, in the axes of the night.

    unknowns : (8,) float
        State [km, km/s] at the epoch, and areas over mass [m^2/kg]. NaN if the fit fails.
    cov : (8, 8) float
        Of the fit, without what the forces neglect (`neglected`).
    chi2 : float
        Weighted sum of squares, priors included; 2 n - 6 degrees of freedom of n directions.
    used : (n,) bool
        Directions that are fitted; false: those of something else.
    shared : (s, 6) float
        Errors of the sensors: direction [rad], position [km].
    of_directions : (n,) float
        Squared residual of each direction over its independent errors, two degrees of freedom; NaN
        where the object is behind the sensor.
    equations
        Of the fit, without the priors of the sensors' errors.
    """

    unknowns: Array
    cov: Array
    chi2: float
    used: Flags
    shared: Array
    of_directions: Array
    equations: ArcEquations


class Normal(NamedTuple):
    """Normal equations: of the orbit, and of each sensor's errors, without priors."""

    orbit: Array  # (8, 8)
    coupling: Array  # (s, 6, 8)
    blocks: Array  # (s, 6, 6)
    of_orbit: Array  # (8,)
    of_sensors: Array  # (s, 6)


@kernel
def _residual(direction, path, shared, work, e, J):
    """Write a direction's residual [rad] to `e` (2,) and its derivatives to `J` (2, 14).

    `direction` is (time, r, u, basis); `shared` (6,) its sensor's errors at present; `work`
    (3, 10) is space to work. Returns whether the object is before the sensor.
    """
    time_s, r, u, basis = direction
    jacobian, d, v = work[:, :N_UNKNOWNS], work[:, N_UNKNOWNS], work[:, N_UNKNOWNS + 1]
    delay, rho, used = 0.0, 0.0, 0.0
    for _ in range(3):  # light time; right to 1e-12 of the distance
        used = delay
        interpolate_position(time_s - delay, path, d)
        rho = 0.0
        for a in range(3):
            d[a] += shared[3 + a] - r[a]
            if delay == 0.0:
                v[a] = d[a]
            rho += d[a] * d[a]
        rho = np.sqrt(rho)
        delay = rho / SPEED_OF_LIGHT_KM_S
    interpolate_derivatives(time_s - used, path, jacobian)
    receding = 0.0
    for a in range(3):
        v[a] = (v[a] - d[a]) / used  # the mean velocity during the light time
        receding += v[a] * d[a] / rho
    for p in range(2):
        e[p] = 0.0
        J[p, :N_UNKNOWNS] = 0.0
        ahead, aside = 0.0, 0.0
        for a in range(3):
            e[p] += basis[p, a] * (d[a] / rho + shared[a])
            ahead += basis[p, a] * d[a] / rho
            aside += basis[p, a] * v[a]
        # A step along the line of sight changes neither the direction nor, but for the light time,
        # the residual: without these terms it would seem to make all residuals smaller.
        aside = (aside - ahead * receding) / (SPEED_OF_LIGHT_KM_S + receding)
        for a in range(3):
            towards = (basis[p, a] - (ahead + aside) * d[a] / rho) / rho
            J[p, N_UNKNOWNS + a] = basis[p, a]
            J[p, N_UNKNOWNS + 3 + a] = towards
            for k in range(N_UNKNOWNS):
                J[p, k] += towards * jacobian[a, k]
    return d[0] * u[0] + d[1] * u[1] + d[2] * u[2] > 0.0


@kernel
def _add(e, J, WJ, s, sums):
    """Add a direction of sensor s to the normal equations; `WJ` (2, 14) is weight times `J`."""
    orbit, coupling, blocks, of_orbit, of_sensors = sums
    for k in range(N_UNKNOWNS):
        of_orbit[k] -= WJ[0, k] * e[0] + WJ[1, k] * e[1]
        for m in range(N_UNKNOWNS):
            orbit[k, m] += WJ[0, k] * J[0, m] + WJ[1, k] * J[1, m]
    for k in range(N_SHARED):
        w0, w1 = WJ[0, N_UNKNOWNS + k], WJ[1, N_UNKNOWNS + k]
        of_sensors[s, k] -= w0 * e[0] + w1 * e[1]
        for m in range(N_UNKNOWNS):
            coupling[s, k, m] += w0 * J[0, m] + w1 * J[1, m]
        for m in range(N_SHARED):
            blocks[s, k, m] += w0 * J[0, N_UNKNOWNS + m] + w1 * J[1, N_UNKNOWNS + m]


@kernel
def _sum_up(path, directions, used, shared, sums, chi2):
    """Add the used directions to `sums`, and write each one's chi-square to `chi2` (n,).

    `path` is `Trajectory`, `shared` (s, 6) are the sensors' errors at present. Where the object is
    behind the sensor chi-square is NaN.
    """
    time_s, sensor, r, u, basis, weight, _ = directions
    work, e = np.empty((3, N_UNKNOWNS + 2)), np.empty(2)
    J = np.zeros((2, N_UNKNOWNS + N_SHARED))
    WJ = np.empty((2, N_UNKNOWNS + N_SHARED))
    for i in range(len(time_s)):
        s, W = sensor[i], weight[i]
        direction = (time_s[i], r[i], u[i], basis[i])
        if not _residual(direction, path, shared[s], work, e, J):
            chi2[i] = np.nan
            continue
        chi2[i] = W[0, 0] * e[0] * e[0] + (W[0, 1] + W[1, 0]) * e[0] * e[1] + W[1, 1] * e[1] * e[1]
        if used[i]:
            for k in range(N_UNKNOWNS + N_SHARED):
                WJ[0, k] = W[0, 0] * J[0, k] + W[0, 1] * J[1, k]
                WJ[1, k] = W[1, 0] * J[0, k] + W[1, 1] * J[1, k]
            _add(e, J, WJ, s, sums)


class _Point(NamedTuple):
    """Unknowns with their sums and total chi-square."""

    unknowns: Array
    shared: Array
    sums: Normal
    chi2: float
    of_directions: Array


def _at(
    unknowns: Array, shared: Array, epoch_s: float, directions: ObjectDirections, used: Flags,
    areas: AreaPrior, around: Surroundings,
) -> _Point:  # fmt: skip
    """Return the sums of all directions at given unknowns; an infinite chi-square if invalid."""
    n_sensors = len(directions.prior)
    sums = Normal(
        np.zeros((N_UNKNOWNS, N_UNKNOWNS)),
        np.zeros((n_sensors, N_SHARED, N_UNKNOWNS)),
        np.zeros((n_sensors, N_SHARED, N_SHARED)),
        np.zeros(N_UNKNOWNS),
        np.zeros((n_sensors, N_SHARED)),
    )
    of_directions = np.empty(len(directions.time_s))
    first, last = directions.time_s[0] - BACK_S, directions.time_s[-1]
    path = integrate(unknowns, epoch_s, first, last, around)
    _sum_up(path, directions, used, shared, sums, of_directions)
    off = (unknowns[6:] - areas.mean) / np.where(areas.sigma > 0.0, areas.sigma, 1.0)
    pulls, _ = velocity_prior(unknowns[:6])
    of_priors = float(off @ off) + float(pulls @ pulls)
    of_priors += float(np.einsum("si,sij,sj->", shared, directions.prior, shared))
    chi2 = float(of_directions[used].sum()) + of_priors
    return _Point(unknowns, shared, sums, chi2 if np.isfinite(chi2) else np.inf, of_directions)


def _step(
    point: _Point, directions: ObjectDirections, areas: AreaPrior
) -> tuple[Array, Array, Array, float]:
    """Return the steps of the unknowns and of the shared errors, the covariance, and the decrease
    of chi-square that they promise."""
    sums, free = point.sums, np.concatenate([np.ones(6, bool), areas.sigma > 0.0])
    information, right = _with_priors(point, areas)
    pulled = sums.of_sensors - np.einsum("sij,sj->si", directions.prior, point.shared)
    blocks = sums.blocks + directions.prior
    unit = 1.0 / np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
    both = np.concatenate([sums.coupling, pulled[:, :, None]], axis=2) * unit[:, :, None]
    scaled = blocks * unit[:, :, None] * unit[:, None, :]
    absorbed = unit[:, :, None] * np.linalg.solve(scaled, both)
    back = np.einsum("ski,skj->ij", sums.coupling, absorbed)
    matrix = (sums.orbit + information - back[:, :N_UNKNOWNS])[np.ix_(free, free)]
    scale = 1.0 / np.sqrt(np.diag(matrix))
    if not np.isfinite(scale).all():
        raise np.linalg.LinAlgError
    cov = np.zeros((N_UNKNOWNS, N_UNKNOWNS))
    inverse = np.linalg.inv(matrix * scale[:, None] * scale) * scale[:, None] * scale
    cov[np.ix_(free, free)] = (inverse + inverse.T) / 2
    step = cov @ (right - back[:, N_UNKNOWNS])
    turned = absorbed[:, :, N_UNKNOWNS] - absorbed[:, :, :N_UNKNOWNS] @ step
    return step, turned, cov, float(step @ right + np.sum(turned * pulled))


def _with_priors(point: _Point, areas: AreaPrior) -> tuple[Array, Array]:
    """Return the information of the orbit's priors, (8, 8), and the right side with them."""
    of_areas = 1.0 / np.where(areas.sigma > 0.0, areas.sigma, 1.0) ** 2
    information = np.diag(np.append(np.zeros(6), of_areas))
    right = point.sums.of_orbit.copy()
    right[6:] -= of_areas * (point.unknowns[6:] - areas.mean)
    pulls, slopes = velocity_prior(point.unknowns[:6])
    information[:6, :6] = slopes.T @ slopes
    right[:6] -= slopes.T @ pulls
    return information, right


def velocity_prior(state: Array) -> tuple[Array, Array]:
    """Return how far a velocity is from a circular orbit's, (2,), with the derivatives, (2, 6).

    Radially and horizontally, over `VELOCITY_SIGMA` of the circular orbit's speed.
    """
    r_km, v_km_s = state[:3], state[3:]
    distance = float(np.linalg.norm(r_km))
    up = r_km / distance
    radial = float(up @ v_km_s)
    across = v_km_s - radial * up
    # Without a horizontal velocity the prior has no direction to pull to.
    level = max(float(np.linalg.norm(across)), LEAST_KM_S)
    sigma = VELOCITY_SIGMA * np.sqrt(GM_KM3_S2 / distance)
    velocity = np.array([radial, level]) / sigma
    slopes = np.empty((2, 6))
    # The sigma falls with the root of the distance.
    slopes[:, :3] = velocity[:, None] * up / (2 * distance)
    slopes[0, :3] += across / (distance * sigma)
    slopes[1, :3] -= radial / level * across / (distance * sigma)
    slopes[0, 3:], slopes[1, 3:] = up / sigma, across / (level * sigma)
    return velocity - np.array([0.0, 1.0 / VELOCITY_SIGMA]), slopes


def _converge(
    unknowns: Array, shared: Array, epoch_s: float, directions: ObjectDirections, used: Flags,
    areas: AreaPrior, around: Surroundings,
) -> tuple[_Point, Array] | None:  # fmt: skip
    """Return the least-squares point and its covariance; None if it is not found."""
    given = epoch_s, directions, used, areas, around
    point = _at(unknowns, shared, *given)
    for _ in range(ITERATIONS):
        if not np.isfinite(point.chi2):
            return None
        try:
            step, turned, cov, gain = _step(point, directions, areas)
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(step).all() and gain > -1e-3):
            return None
        if gain < CONVERGED:
            return point, cov
        for halving in range(HALVINGS):
            part = 0.5**halving
            nearer = _at(point.unknowns + part * step, point.shared + part * turned, *given)
            if nearer.chi2 < point.chi2 + CONVERGED:
                break
        else:
            return None
        point = nearer
    return None


def determine_orbit(
    directions: ObjectDirections, start: Array, start_s: float, epoch_s: float, areas: AreaPrior,
    around: Surroundings,
) -> DeterminedOrbit:  # fmt: skip
    """Return the orbit of an object at an epoch, fitted to all directions to it.

    Parameters
    ----------
    directions
        At least `MIN_DIRECTIONS`, from two positions or over a time in which the orbit bends.
    start : (6,) float
        Initial state [km, km/s], in the axes of the night: right enough to predict the directions
        within some minutes of it to some degrees.
    start_s, epoch_s : float
        Times of the initial state and of the result, since the origin of `around`.
    areas
        Prior of the areas over mass.

    Notes
    -----
    Errors that a sensor's directions share are constant in inertial axes. Directions far off, at
    most `MAX_OUTLIERS` of all, are left out.

    References
    ----------
    Gauss-Newton with halved steps; Tapley, Schutz, Born (2004), Statistical Orbit Determination,
    section 4.
    """
    n = len(directions.time_s)
    failed = DeterminedOrbit(
        np.full(N_UNKNOWNS, np.nan), np.full((N_UNKNOWNS, N_UNKNOWNS), np.nan), np.nan,
        np.zeros(n, bool), np.zeros((len(directions.prior), N_SHARED)), np.full(n, np.nan),
        no_equations(len(directions.prior)),
    )  # fmt: skip
    if n < MIN_DIRECTIONS:
        return failed
    unknowns, shared = np.concatenate([start, areas.mean]), failed.shared

    def of_all(unknowns: Array, shared: Array) -> DeterminedOrbit | None:
        try:
            unknowns, _ = propagate_unknowns(unknowns, start_s, epoch_s, around)
            return _without_outliers(unknowns, shared, epoch_s, directions, areas, around)
        except ValueError:
            return None

    near = _from_near(unknowns, shared, start_s, directions, areas, around)
    orbit = None if near is None else of_all(*near)
    # The directions near an initial state between two tracklets are a part of one of them: the
    # orbit that fits these may be far from that of both, which the initial state was made of.
    if orbit is None and (near is None or near[0] is not unknowns):
        orbit = of_all(unknowns, shared)
    return orbit or failed


def _from_near(
    unknowns: Array, shared: Array, start_s: float, directions: ObjectDirections,
    areas: AreaPrior, around: Surroundings,
) -> tuple[Array, Array] | None:  # fmt: skip
    """Return the unknowns, fitted to ever more directions around the initial state, but not all.

    None if a fit fails.
    """
    try:
        for rows in _windows(directions.time_s, start_s):
            near = part_of(directions, rows)
            used = np.ones(len(near.time_s), bool)
            found = _converge(unknowns, shared, start_s, near, used, areas, around)
            if found is None:
                return None
            unknowns, shared = found[0].unknowns, found[0].shared
    except ValueError:
        return None
    return unknowns, shared


def neglected(r_km: Array, arc_s: float) -> Array:
    """Return the covariance (6, 6) [km, km/s] of a fitted state by what the forces neglect.

    r_km : (3,) float
        Position in the middle of the arc.
    arc_s : float
        Length of the arc.
    """
    distance = float(np.linalg.norm(r_km))
    gravity = GM_KM3_S2 / distance**2
    share = NEGLECTED_SHARE * (EARTH_RADIUS_KM / distance) ** 3
    half_s = arc_s / 2
    sigma_km = 0.5 * share * gravity * half_s * min(half_s, NEGLECTED_S)
    motion = np.sqrt(gravity / distance)
    return np.diag(np.repeat([sigma_km, NEGLECTED_RATE * motion * sigma_km], 3) ** 2)


def _windows(time_s: Array, start_s: float) -> list[Flags]:
    """Return growing sets of directions around the initial state; without that of all."""
    away = np.abs(time_s - start_s)
    window_s = max(FIRST_WINDOW_S, float(np.sort(away)[MIN_DIRECTIONS - 1]))
    rows: list[Flags] = []
    while (away > window_s).any():
        inside = away <= window_s
        if not rows or inside.sum() > rows[-1].sum():
            rows.append(inside)
        window_s *= WINDOW_GROWTH
    return rows


def part_of(directions: ObjectDirections, rows: Flags) -> ObjectDirections:
    """Return some of the directions. The sensors keep their numbers."""
    time_s, sensor, r_km, u, basis, weight, prior = directions
    return ObjectDirections(
        time_s[rows], sensor[rows], r_km[rows], u[rows], basis[rows], weight[rows], prior
    )


def _without_outliers(
    unknowns: Array, shared: Array, epoch_s: float, directions: ObjectDirections, areas: AreaPrior,
    around: Surroundings,
) -> DeterminedOrbit | None:  # fmt: skip
    """Return the fit to the directions that are not far off; to all of them, if too many are or if
    others do not fit without these; None if it fails."""
    n = len(directions.time_s)
    used, most = np.ones(n, bool), int(MAX_OUTLIERS * n)
    whole: DeterminedOrbit | None = None
    for _ in range(REFITS):
        found = _converge(unknowns, shared, epoch_s, directions, used, areas, around)
        if found is None:
            break
        point, cov = found
        orbit = DeterminedOrbit(
            point.unknowns, cov, point.chi2, used, point.shared, point.of_directions,
            _equations(point, areas),
        )  # fmt: skip
        whole = orbit if whole is None else whole
        # Far outliers draw the fit away from the others, so the worst come first.
        far = np.flatnonzero(~(point.of_directions < OUTLIER_CHI2))
        far = far[np.argsort(-point.of_directions[far], kind="stable")][:most]
        fits = np.ones(n, bool)
        fits[far] = False
        if (fits == used).all():
            if (point.of_directions[used] < OUTLIER_CHI2).all():
                return orbit
            break
        unknowns, shared, used = point.unknowns, point.shared, fits
    return whole


def _equations(point: _Point, areas: AreaPrior) -> ArcEquations:
    """Return the equations at a point, with the priors of the orbit; errors count from zero."""
    sums, free = point.sums, np.flatnonzero(np.append(np.ones(6), areas.sigma) > 0.0)
    information, right = _with_priors(point, areas)
    orbit = sums.orbit + information
    right = right + np.einsum("ski,sk->i", sums.coupling, point.shared)
    of_sensors = sums.of_sensors + np.einsum("sij,sj->si", sums.blocks, point.shared)
    return ArcEquations(
        orbit[np.ix_(free, free)], sums.coupling[:, :, free], sums.blocks, right[free], of_sensors
    )


def log_evidence(orbit: DeterminedOrbit, areas: AreaPrior) -> float:
    """Return the logarithm of how well an orbit and its areas explain the directions.

    Only differences between fits to the same directions with the same sensors mean something:
    Laplace's approximation, in which an area that the arc does not show costs nothing.
    """
    free = np.flatnonzero(areas.sigma > 0.0)
    sigma = np.sqrt(np.diag(orbit.cov)[6:][free])
    return float(-orbit.chi2 / 2 + np.sum(np.log(sigma / areas.sigma[free])))
