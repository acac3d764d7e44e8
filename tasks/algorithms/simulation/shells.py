"""Low satellites: constellations as Walker patterns, and a random population in real shells."""

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.simulation.element_sets import SGP4_EPOCH_JD, utc_julian_date

GM_WGS72_KM3_S2 = 398600.8  # of SGP4: Hoots and Roehrich (1980), Spacetrack Report 3

# Where low satellites are, rounded from the public catalogue of 2026: share, altitudes [km],
# inclination and half its range [deg], largest eccentricity.
POPULATION = np.array(
    [
        (0.22, 535.0, 555.0, 53.1, 0.1, 0.0003),  # Starlink
        (0.12, 475.0, 500.0, 43.0, 0.1, 0.0003),
        (0.04, 565.0, 575.0, 70.0, 0.1, 0.0003),
        (0.04, 555.0, 565.0, 97.6, 0.1, 0.0003),
        (0.06, 1180.0, 1220.0, 87.9, 0.1, 0.0003),  # OneWeb
        (0.16, 450.0, 650.0, 97.6, 0.5, 0.002),  # small satellites, sun-synchronous
        (0.14, 700.0, 880.0, 98.6, 0.6, 0.01),
        (0.07, 900.0, 1000.0, 82.9, 0.2, 0.005),
        (0.04, 740.0, 800.0, 74.0, 0.2, 0.005),
        (0.03, 380.0, 450.0, 51.6, 0.1, 0.001),
        (0.08, 500.0, 1400.0, 75.0, 27.0, 0.02),  # debris
    ]
)


def walker_elements(
    a_km: float, i_rad: float, pattern: tuple[int, int, int], arc_rad: float
) -> Array:
    """Return the (t, 6) elements of a Walker pattern of circular orbits, see `state_at`.

    Parameters
    ----------
    pattern : (t, p, f)
        Satellites, planes and phasing. A satellite is ahead of its neighbour in the plane to the
        west by f times 360 / t degrees.
    arc_rad : float
        Arc over which the ascending nodes are spread: 2 pi for delta, pi for star patterns.

    References
    ----------
    Walker (1984), Satellite constellations, J. Brit. Interplanet. Soc. 37, 559.
    """
    t, p, f = pattern
    plane, slot = np.divmod(np.arange(t), t // p)
    argument = 2 * np.pi * (slot * p + plane * f) / t
    columns = (a_km, 0.0, i_rad, plane * (arc_rad / p), 0.0, np.remainder(argument, 2 * np.pi))
    return np.stack(np.broadcast_arrays(*columns), axis=1).astype(float)


def scattered(elements: Array, sigma_km: float, rng: np.random.Generator) -> Array:
    """Return circular orbits moved at random: up, along and at the node, 1-sigma each."""
    up, along, across = rng.standard_normal((3, len(elements))) * sigma_km
    a_km = elements[:, 0]
    moved = elements.copy()
    moved[:, 0] += up
    moved[:, 5] += along / a_km
    moved[:, 3] += across / a_km
    return moved


def random_population(n: int, rng: np.random.Generator) -> Array:
    """Return the (n, 6) elements of random low satellites, as `POPULATION` has them."""
    share = POPULATION[:, 0] / POPULATION[:, 0].sum()
    _, low, high, i_deg, spread_deg, e = POPULATION[rng.choice(len(share), n, p=share)].T
    u = rng.random((n, 6))
    a_km = EARTH_RADIUS_KM + low + (high - low) * u[:, 0]
    i = np.radians(i_deg + spread_deg * (2 * u[:, 1] - 1))
    return np.stack([a_km, e * u[:, 2], i, *(2 * np.pi * u[:, 3:].T)], axis=1)


def mean_elements(elements: Array, epoch_ns: int) -> Array:
    """Return elements (n, 6) at an epoch as SGP4's (n, 10), see `MEAN_ELEMENTS`, without drag."""
    a, e, i, raan, argp, mean = elements.T
    midnight, part = utc_julian_date(np.array([epoch_ns]))
    days = float((midnight - SGP4_EPOCH_JD + part)[0])
    per_minute = np.sqrt(GM_WGS72_KM3_S2 / a**3) * 60
    columns = (days, 0.0, 0.0, 0.0, e, argp, i, mean, per_minute, raan)
    return np.stack(np.broadcast_arrays(*columns), axis=1)


def nearest_of(r_km: Array, centre: int, n: int) -> Integers:
    """Return the rows, in order, of the n positions (m, 3) nearest to one of them."""
    distance = np.linalg.norm(r_km - r_km[centre], axis=1)
    return np.sort(np.argsort(distance, kind="stable")[:n])
