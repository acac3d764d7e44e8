"""State interpolation: a sensor's states at the times of its frames.

Between two states the position is the quintic polynomial with their positions, velocities and
accelerations. The acceleration is gravity at the state's position, which an error of ten metres
does not change. So the error of the path is centimetres over minutes. Independent errors of the
states are averaged and never amplified, because nearby positions are not differenced. Missing
velocities come from a fit to 20 s of positions, after the effect of gravity is removed.

Below 80 km altitude a vehicle is not in orbit, and its acceleration is taken as zero. With one
state per second a point at rest on Earth is still right to a metre.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Nanoseconds
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.earth_gravity import gravity, propagate_states
from epipole.tasks.algorithms.geometry.directions import interpolate_quaternions

# Largest gap between two states that is interpolated. With reported velocities the quintic of a low
# orbit is then right to 5 cm. Fitted velocities have errors of some m/s.
MAX_BRIDGE_S = 240.0
MAX_BRIDGE_FITTED_S = 120.0
STEPS = 4  # beyond the last state: the error is centimetres over minutes on a low orbit
# A missing velocity is fitted to the positions within this time of the state, and at least to the
# nearest one on each side. `FIT_POINTS` is the maximum number of positions: more do not help.
FIT_HALF_WIDTH_S = 10.0
FIT_POINTS = 21
# The variance of an extrapolation with a reported velocity has doubled after this time.
VELOCITY_MEMORY_S = 30.0
# Prior attitudes are interpolated between states that are at most this far apart.
MAX_ATTITUDE_GAP_S = 10.0


class SensorStates(NamedTuple):
    """States of one sensor, by strictly increasing time."""

    time_ns: Nanoseconds  # (n,)
    r_gcrf_km: Array  # (n, 3)
    v_gcrf_km_s: Array  # (n, 3), NaN where missing
    position_sigma_km: Array  # (n,) 1-sigma per axis
    q_sensor_from_icrs: Array  # (n, 4), NaN where missing
    attitude_sigma: Array  # (n,) 1-sigma per axis, any unit


class InterpolatedStates(NamedTuple):
    """Position, velocity and attitude of a sensor at m times; NaN far from all states."""

    r_gcrf_km: Array  # (m, 3)
    v_gcrf_km_s: Array  # (m, 3)
    position_sigma_km: Array  # (m,)
    q_sensor_from_icrs: Array  # (m, 4)
    attitude_sigma: Array  # (m,)


def interpolate_states(
    states: SensorStates, at_ns: Nanoseconds, state_gap_s: float
) -> InterpolatedStates:
    """Return position, velocity and attitude of a sensor at given times.

    Parameters
    ----------
    states
        Any number, also 0.
    at_ns : (m,) int
        UTC since 1970, in any order.
    state_gap_s
        Largest time to the nearest state [s]; NaN beyond.

    Returns
    -------
    InterpolatedStates
        Beyond the first and last state, and in a gap that is too wide to interpolate, the
        nearest state is propagated under gravity and its sigma grows. Attitudes are never
        extrapolated: a sensor may turn at any time.
    """
    n, m = len(states.time_ns), len(at_ns)
    if n == 0 or m == 0:
        nan = np.full((m, 4), np.nan)
        return InterpolatedStates(nan[:, :3], nan[:, :3], nan[:, 0], nan, nan[:, 0])
    v_km_s, growth = _with_velocities(states)
    right = np.clip(np.searchsorted(states.time_ns, at_ns), 1, max(n - 1, 1)) % n
    left = np.maximum(right - 1, 0)
    # Differences of integers: float seconds since 1970 have steps of a quarter microsecond.
    since_left_s = (at_ns - states.time_ns[left]) / SECOND_NS
    since_right_s = (at_ns - states.time_ns[right]) / SECOND_NS
    use_left = np.abs(since_left_s) <= np.abs(since_right_s)
    nearest = np.where(use_left, left, right)
    since_s = np.where(use_left, since_left_s, since_right_s)
    fitted = np.isnan(states.v_gcrf_km_s[:, 0])
    bridge_s = np.where(fitted[left] | fitted[right], MAX_BRIDGE_FITTED_S, MAX_BRIDGE_S)
    between = (since_left_s >= 0) & (since_right_s <= 0) & (left != right)
    between &= since_left_s - since_right_s <= bridge_s

    extrapolated_s = np.where(between, 0.0, since_s)
    r, v = propagate_states(states.r_gcrf_km[nearest], v_km_s[nearest], extrapolated_s, STEPS)
    linear, square = growth[nearest].T
    variance = 1 + linear * since_s + square * since_s**2
    sigma = states.position_sigma_km[nearest] * np.sqrt(variance)
    i = np.flatnonzero(between)
    a, b, step_s = left[i], right[i], (since_left_s - since_right_s)[i]
    share = since_left_s[i] / step_s
    r[i], v[i] = _bridge(states.r_gcrf_km, v_km_s, a, b, step_s, share)
    sigma[i] = (1 - share) * states.position_sigma_km[a] + share * states.position_sigma_km[b]
    far = np.abs(since_s) > state_gap_s
    r[far], v[far], sigma[far] = np.nan, np.nan, np.nan
    return InterpolatedStates(r, v, sigma, *_attitudes(states, at_ns))


def _bridge(
    r_km: Array, v_km_s: Array, a: Nanoseconds, b: Nanoseconds, step_s: Array, share: Array
) -> tuple[Array, Array]:
    """Return positions and velocities at a share of the time from states a to states b.

    Positions by a quintic Hermite polynomial. Velocities by the cubic of velocities and gravity:
    the derivative of the quintic would amplify the errors of the positions.
    """
    h, s = step_s[:, None], share[:, None]
    ra, rb, va, vb = r_km[a], r_km[b], v_km_s[a], v_km_s[b]
    ga, gb = gravity(ra), gravity(rb)
    s3 = s * s * s
    s4, s5 = s3 * s, s3 * s * s
    rise = 10 * s3 - 15 * s4 + 6 * s5
    r = ra + (rb - ra) * rise
    r += h * ((s - 6 * s3 + 8 * s4 - 3 * s5) * va + (-4 * s3 + 7 * s4 - 3 * s5) * vb)
    r += 0.5 * h**2 * ((s**2 - 3 * s3 + 3 * s4 - s5) * ga + (s3 - 2 * s4 + s5) * gb)
    rise = 3 * s**2 - 2 * s3
    v = va + (vb - va) * rise + h * ((s - 2 * s**2 + s3) * ga + (s3 - s**2) * gb)
    return r, v


def _with_velocities(states: SensorStates) -> tuple[Array, Array]:
    """Return all velocities, reported or fitted, and the growth (a, b) of their variance, (n, 2).

    After t seconds the variance of the position is that of the state times 1 + a t + b t^2. Both
    are NaN for a single state without velocity.
    """
    v = states.v_gcrf_km_s.copy()
    growth = np.tile([0.0, VELOCITY_MEMORY_S**-2], (len(v), 1))
    missing = np.flatnonzero(np.isnan(v[:, 0]))
    if len(missing):
        v[missing], growth[missing] = _fit_velocities(states, missing)
    return v, growth


def _fit_velocities(states: SensorStates, which: Nanoseconds) -> tuple[Array, Array]:
    """Return fitted velocities of some states, and the growth of their variance."""
    points, used = _fit_points(states.time_ns, which)
    since_s = (states.time_ns[points] - states.time_ns[which][:, None]) / SECOND_NS
    r_km = states.r_gcrf_km[points]
    # Gravity along the path, as a quadratic in time, integrated twice.
    width_s = np.maximum(np.abs(np.where(used, since_s, 0.0)).max(axis=1), 1e-9)
    tau = since_s / width_s[:, None]
    weight = used.astype(float)
    fall = _double_integral(tau, gravity(r_km), weight) * (width_s**2)[:, None, None]
    # The rest is a straight line. The error of its slope correlates with the state's position.
    mean_s = (weight * since_s).sum(axis=1) / weight.sum(axis=1)
    lever_s = np.where(used, since_s - mean_s[:, None], 0.0)
    spread = (lever_s**2).sum(axis=1)
    spread[spread == 0] = np.nan
    v = np.einsum("np,npi->ni", lever_s, r_km - fall) / spread[:, None]
    return v, np.stack([-2 * mean_s / spread, 1 / spread], axis=-1)


def _fit_points(time_ns: Nanoseconds, which: Nanoseconds) -> tuple[Nanoseconds, Flags]:
    """Return (k, FIT_POINTS) indices of the states around each of k, and which are used."""
    n = len(time_ns)
    reach = int(FIT_HALF_WIDTH_S * SECOND_NS)
    first = np.searchsorted(time_ns, time_ns[which] - reach)
    last = np.searchsorted(time_ns, time_ns[which] + reach, side="right") - 1
    first = np.maximum(np.minimum(first, which - 1), 0)
    last = np.minimum(np.maximum(last, which + 1), n - 1)
    # At either end one side has no neighbour: take a second one from the other side.
    first = np.where(last == which, np.maximum(np.minimum(first, which - 2), 0), first)
    last = np.where(first == which, np.minimum(np.maximum(last, which + 2), n - 1), last)
    share = np.linspace(0.0, 1.0, FIT_POINTS)
    points = np.rint(first[:, None] + share * (last - first)[:, None]).astype(np.int64)
    used = np.ones_like(points, bool)
    used[:, 1:] = points[:, 1:] != points[:, :-1]
    far = np.abs(time_ns[points] - time_ns[which][:, None]) > MAX_BRIDGE_FITTED_S * SECOND_NS
    return points, used & ~far


def _double_integral(tau: Array, values: Array, weight: Array) -> Array:
    """Return the double integral over tau, from 0, of a quadratic fitted to (n, p, 3) values."""
    powers = np.stack([np.ones_like(tau), tau, tau**2], axis=-1)
    weighted = powers * weight[..., None]
    normal = np.einsum("npi,npj->nij", weighted, powers)
    # With fewer than three points: the smallest coefficients that fit them.
    normal += 1e-9 * np.eye(3)
    moments = np.einsum("npi,npk->nik", weighted, values)
    coefficients = np.linalg.solve(normal, moments)
    integrals = np.stack([tau**2 / 2, tau**3 / 6, tau**4 / 12], axis=-1)
    return np.einsum("npi,nik->npk", integrals, coefficients)


def _attitudes(states: SensorStates, at_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return prior attitudes and their sigmas where states on both sides have one."""
    q, sigma = np.full((len(at_ns), 4), np.nan), np.full(len(at_ns), np.nan)
    having = np.flatnonzero(np.isfinite(states.q_sensor_from_icrs).all(axis=1))
    if len(having) == 0:
        return q, sigma
    time_ns = states.time_ns[having]
    right = np.minimum(np.searchsorted(time_ns, at_ns), len(time_ns) - 1)
    left = np.where(time_ns[right] == at_ns, right, np.maximum(right - 1, 0))
    covered = (time_ns[left] <= at_ns) & (at_ns <= time_ns[right])
    covered &= time_ns[right] - time_ns[left] <= MAX_ATTITUDE_GAP_S * SECOND_NS
    i = np.flatnonzero(covered)
    if len(i) == 0:
        return q, sigma
    start_ns = time_ns[0]
    q[i] = interpolate_quaternions(
        (time_ns - start_ns) / SECOND_NS,
        states.q_sensor_from_icrs[having],
        (at_ns[i] - start_ns) / SECOND_NS,
    )
    of_state = states.attitude_sigma[having]
    sigma[i] = np.maximum(of_state[left[i]], of_state[right[i]])
    return q, sigma
