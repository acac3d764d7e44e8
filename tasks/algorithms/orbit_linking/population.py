"""Population: how many objects there are, and on which orbits, before anything is seen.

The density of objects in position and velocity is the prior of the evidence (`arc_fit`). Heights
have one distribution. Velocities are a mixture of two components: most orbits are nearly circular,
the others have any eccentricity. The directions of motion are uniform.
"""

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.algorithms.kernels import kernel

# Objects of 10 cm and more: ESA's Annual Space Environment Report 2025 has some 40,000 tracked ones
# and 54,000 by model. More objects mean more chance meetings: this is the careful end.
N_OBJECTS = 50_000.0
MIN_HEIGHT_KM = 100.0  # lower, an object does not stay in orbit
# Heights: most objects are within a band above `MIN_HEIGHT_KM` [km]; the others have an exponential
# distribution with this scale [km].
BAND_KM = 1500.0
BAND_SHARE = 0.85
SCALE_KM = 8000.0
# Radial and horizontal velocity minus those of a circular orbit, over its speed: 1-sigma of the
# two components, and their shares. The radial one is about the eccentricity.
SIGMA = (0.02, 0.3)
SHARE = (0.85, 0.15)
COMPONENTS = 2

# Integration over range, evenly in its logarithm, and over the range rates that are bound.
MIN_RANGE_KM = 10.0
MAX_RANGE_KM = 60_000.0
N_RANGES = 72  # steps of 13 %; 144 and 288 found the same objects in a shell, within 0.2 %
N_RATES = 96  # steps of 0.22 km/s at 500 km height, where `SIGMA` of most orbits is 0.15 km/s
NEGLIGIBLE = 40.0  # chi-square beyond which the density is zero


@kernel
def log_height_density(r_km):
    """Return the log of the density of objects [1/km^3] at a distance from the geocentre."""
    h = r_km - EARTH_RADIUS_KM - MIN_HEIGHT_KM
    if h < 0.0:
        return -np.inf
    per_km = (1.0 - BAND_SHARE) * np.exp(-h / SCALE_KM) / SCALE_KM
    if h < BAND_KM:
        per_km += BAND_SHARE / BAND_KM
    return np.log(N_OBJECTS * per_km / (4.0 * np.pi * r_km * r_km))


@kernel
def prior_of(x, component, pulls):
    """Return the log density of objects of a component, and write the pulls (2,) of a state x (6,).

    The pulls are the radial and horizontal velocity, minus a circular orbit's, over their sigma:
    their squares are the prior's chi-square. The density [1/(km^3 (km/s)^3)] is that where both
    pulls are zero: the caller subtracts half their squares. x [km, km/s], GCRF.
    """
    r = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    v2 = x[3] * x[3] + x[4] * x[4] + x[5] * x[5]
    radial = (x[0] * x[3] + x[1] * x[4] + x[2] * x[5]) / r
    level = np.sqrt(max(v2 - radial * radial, 1e-12))
    circular = np.sqrt(GM_KM3_S2 / r)
    sigma = SIGMA[component] * circular
    pulls[0], pulls[1] = radial / sigma, (level - circular) / sigma
    # Two normal distributions, and a ring of directions of the horizontal velocity.
    of_velocity = np.log(SHARE[component] / (4.0 * np.pi**2 * sigma * sigma * level))
    return log_height_density(r) + of_velocity


def log_density(states: Array) -> Array:
    """Return the log of the density of objects [1/(km^3 (km/s)^3)] about states (n, 6), GCRF."""
    out = np.empty(len(states))
    _write_log_density(np.array(states, float, order="C"), out)
    return out


@kernel
def _write_log_density(states, out):
    """Write `log_density` of states (n, 6) to `out` (n,)."""
    pulls = np.empty(2)
    for k in range(len(out)):
        out[k] = -np.inf
        for component in range(COMPONENTS):
            of_component = prior_of(states[k], component, pulls)
            of_component -= 0.5 * (pulls[0] * pulls[0] + pulls[1] * pulls[1])
            out[k] = np.logaddexp(out[k], of_component)


@kernel
def _of_velocities(x, v_across, u):
    """Return the density of objects at one position, over that of all velocities there.

    Integrated over the speeds [km/s] along the line of sight u that are bound. x, v_across, u (3,):
    position [km], velocity at right angles to u [km/s], direction.
    """
    r2, across2, radial0, slope = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        r2 += x[a] * x[a]
        across2 += v_across[a] * v_across[a]
        radial0 += x[a] * v_across[a]
        slope += x[a] * u[a]
    r = np.sqrt(r2)
    spare = 2.0 * GM_KM3_S2 / r - across2
    if not spare > 0.0:
        return 0.0
    circular, bound = np.sqrt(GM_KM3_S2 / r), np.sqrt(spare)
    width, total = 2.0 * bound / N_RATES, 0.0
    for j in range(N_RATES):
        speed = -bound + (j + 0.5) * width
        radial = (radial0 + slope * speed) / r
        level = np.sqrt(max(across2 + speed * speed - radial * radial, 1e-12))
        off = (radial * radial + (level - circular) ** 2) / (circular * circular)
        for c in range(COMPONENTS):
            chi2 = off / SIGMA[c] ** 2
            if chi2 < NEGLIGIBLE:
                total += SHARE[c] / SIGMA[c] ** 2 / level * np.exp(-0.5 * chi2)
    return total * width / (4.0 * np.pi**2 * circular * circular)


@kernel
def _log_rates(r_km, v_km_s, u, w, out):
    """Write the log density of the attributables that the population shows, to `out` (n,).

    The other arguments (n, 3), and the unit of the density, as in `log_attributable_density`.
    """
    x, v_across = np.empty(3), np.empty(3)
    step = np.log(MAX_RANGE_KM / MIN_RANGE_KM) / N_RANGES
    for k in range(len(out)):
        total, along = 0.0, 0.0
        for a in range(3):
            along += v_km_s[k, a] * u[k, a]
        for m in range(N_RANGES):
            rho, r2 = MIN_RANGE_KM * np.exp((m + 0.5) * step), 0.0
            for a in range(3):
                x[a] = r_km[k, a] + rho * u[k, a]
                v_across[a] = v_km_s[k, a] - along * u[k, a] + rho * w[k, a]
                r2 += x[a] * x[a]
            if r2 > (EARTH_RADIUS_KM + MIN_HEIGHT_KM) ** 2:
                density = np.exp(log_height_density(np.sqrt(r2))) * _of_velocities(
                    x, v_across, u[k]
                )
                total += density * rho**5 * step  # rho^4, and d rho = rho d ln rho
        out[k] = np.log(max(total, 1e-300))


def log_attributable_density(r_km: Array, v_km_s: Array, u: Array, w: Array) -> Array:
    """Return the log density of attributables [1/(rad^2 (rad/s)^2)] that the population shows.

    The integral of the density of objects over the admissible region: ranges and range rates of
    orbits that are bound and above the ground.

    Parameters
    ----------
    r_km, v_km_s : (n, 3) float
        Sensor positions [km] and velocities [km/s], GCRF.
    u, w : (n, 3) float
        Directions, and their rates [rad/s].
    """
    out = np.empty(len(u))
    arrays = (np.ascontiguousarray(a, float) for a in (r_km, v_km_s, u, w))
    _log_rates(*arrays, out)
    return out
