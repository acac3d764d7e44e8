"""Orbital elements of states, with their errors; and longitude and drift of geostationary ones."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import (
    EARTH_RATE_RAD_S,
    GM_KM3_S2,
)
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.trajectories import (
    integrate,
    positions_at,
    propagate_unknowns,
)

# Steps of the numerical derivatives: a share of the position and of the velocity, at which
# rounding and curvature are both below 1e-6 of the derivative.
DERIVATIVE_STEP = 1e-6
TURN = 2 * np.pi
GEOSTATIONARY_KM = (GM_KM3_S2 / EARTH_RATE_RAD_S**2) ** (1 / 3)
# IADC Space Debris Mitigation Guidelines (2007), section 3.3.2: the geosynchronous region.
REGION_KM = 200.0
REGION_RAD = np.radians(15.0)
SIGMAS = 3.0  # by which a semi-major axis may be outside the region
SIDEREAL_DAY_S = TURN / EARTH_RATE_RAD_S
# Instants of a sidereal day at which turns are counted: between two of them no orbit turns by half.
INSTANTS = 200


IN_DEGREES = np.array([1.0, 1.0, *np.degrees(np.ones(4))])  # elements times this: angles in degrees


def elements_of(state: Array) -> Array:
    """Return the osculating elements of states.

    Parameters
    ----------
    state : (..., 6) float
        Position [km] and velocity [km/s]; the elements are of the same axes.

    Returns
    -------
    (..., 6) float
        Semi-major axis [km], negative for a hyperbola; eccentricity; inclination, right ascension
        of the node, argument of perigee and mean anomaly [rad], the last three in [0, 2 pi). That
        of a hyperbola counts from its perigee and is negative before it: it never comes back.

    References
    ----------
    Vallado (2013), Fundamentals of Astrodynamics and Applications, algorithm 9 (RV2COE).
    """
    r, v = state[..., :3], state[..., 3:]
    distance = np.linalg.norm(r, axis=-1)
    momentum = np.cross(r, v)
    to_perigee = np.cross(v, momentum) / GM_KM3_S2 - r / distance[..., None]
    e = np.linalg.norm(to_perigee, axis=-1)
    a = 1.0 / (2.0 / distance - np.sum(v * v, axis=-1) / GM_KM3_S2)
    across = np.hypot(momentum[..., 0], momentum[..., 1])
    i = np.arctan2(across, momentum[..., 2])
    raan = np.arctan2(momentum[..., 0], -momentum[..., 1])
    zero = np.zeros_like(raan)
    node = np.stack([np.cos(raan), np.sin(raan), zero], axis=-1)
    beyond = np.cross(momentum, node) / np.linalg.norm(momentum, axis=-1)[..., None]
    argp = np.arctan2(np.sum(to_perigee * beyond, axis=-1), np.sum(to_perigee * node, axis=-1))
    latitude = np.arctan2(np.sum(r * beyond, axis=-1), np.sum(r * node, axis=-1))
    mean = _mean_anomaly(latitude - argp, e)
    mean = np.where(e < 1, mean % TURN, mean)
    return np.stack([a, e, i, raan % TURN, argp % TURN, mean], axis=-1)


def _mean_anomaly(true: Array, e: Array) -> Array:
    """Return mean anomalies [rad]; of a hyperbola by Kepler's equation of hyperbolas."""
    with np.errstate(invalid="ignore"):
        E = 2 * np.arctan(np.sqrt((1 - e) / (1 + e)) * np.tan(true / 2))
        F = 2 * np.arctanh(np.sqrt((e - 1) / (e + 1)) * np.tan(true / 2))
        return np.where(e < 1, E - e * np.sin(E), e * np.sinh(F) - F)


def element_errors(state: Array, cov: Array) -> Array:
    """Return the standard deviations of the elements of states, (n, 6), units as `elements_of`.

    Parameters
    ----------
    state, cov : (n, 6), (n, 6, 6) float
        States with their covariances.

    Notes
    -----
    They are of the linear model. The perigee of a nearly circular orbit, and the node of one that
    is nearly in the equator, may have sigmas of a full turn or more.
    """
    lengths = [np.linalg.norm(part, axis=1) for part in (state[:, :3], state[:, 3:])]
    step = DERIVATIVE_STEP * np.repeat(np.stack(lengths, axis=1), 3, axis=1)
    moves = step[:, :, None] * np.eye(6)
    change = elements_of(state[:, None] + moves) - elements_of(state[:, None] - moves)
    change[..., 3:] = (change[..., 3:] + np.pi) % TURN - np.pi
    jacobian = change / (2 * step[:, :, None])
    # Products matrix by matrix: a row does not depend on those beside it.
    return np.asarray(np.sqrt(np.sum(jacobian * np.matmul(cov, jacobian), axis=1)))


class Geostationary(NamedTuple):
    """Longitude of a geostationary object at the epoch [rad], and its drift [rad/s], both east;
    with their standard deviations."""

    longitude_rad: float
    sigma_longitude_rad: float
    drift_rad_s: float
    sigma_drift_rad_s: float


def geostationary(
    unknowns: Array, cov: Array, epoch_s: float, around: Surroundings
) -> Geostationary | None:
    """Return longitude and drift of an orbit in the geosynchronous region; None outside it.

    Parameters
    ----------
    unknowns, cov : (8,), (8, 8) float
        An orbit at the epoch, as in `DeterminedOrbit`.

    Notes
    -----
    The drift is the change of longitude over a sidereal day around the epoch, in which the daily
    motion of an eccentric or inclined orbit cancels. Whole turns count: an object that moves west
    makes two of them.
    """
    state = unknowns[:6]
    a_km, sigma_km = elements_of(state)[0], element_errors(state[None], cov[None, :6, :6])[0, 0]
    distance = np.linalg.norm(state[:3])
    if (
        abs(distance - GEOSTATIONARY_KM) > REGION_KM
        or abs(np.arcsin(state[2] / distance)) > REGION_RAD
        or abs(a_km - GEOSTATIONARY_KM) > max(REGION_KM, SIGMAS * sigma_km)
    ):
        return None
    longitude, slope = _longitude(unknowns, epoch_s, around)
    ends, slopes = [], []
    for half in (-0.5, 0.5):
        to_s = epoch_s + half * SIDEREAL_DAY_S
        there, transition = propagate_unknowns(unknowns, epoch_s, to_s, around)
        end, of_end = _longitude(there, to_s, around)
        ends.append(end)
        slopes.append(of_end @ transition)
    change = (ends[1] - ends[0] + np.pi) % TURN - np.pi
    turns = (_change_of_longitude(unknowns, epoch_s, around) - change) / TURN
    change += TURN * float(np.round(turns))
    drift = change / SIDEREAL_DAY_S
    of_drift = (slopes[1] - slopes[0]) / SIDEREAL_DAY_S
    return Geostationary(
        longitude,
        float(np.sqrt(slope @ cov @ slope)),
        float(drift),
        float(np.sqrt(of_drift @ cov @ of_drift)),
    )


def _change_of_longitude(unknowns: Array, epoch_s: float, around: Surroundings) -> float:
    """Return by how much the longitude grows in the sidereal day around the epoch [rad]."""
    at_s = epoch_s + SIDEREAL_DAY_S * np.linspace(-0.5, 0.5, INSTANTS)
    path = integrate(unknowns, epoch_s, float(at_s[0]), float(at_s[-1]), around)
    r_km = positions_at(path, at_s)
    turned = np.unwrap(np.arctan2(r_km[:, 1], r_km[:, 0]))
    return float(turned[-1] - turned[0]) - TURN


def _longitude(unknowns: Array, time_s: float, around: Surroundings) -> tuple[float, Array]:
    """Return the longitude of an orbit [rad], in [-pi, pi), and its derivatives by the unknowns."""
    x, y = unknowns[:2]
    angle = np.arctan2(y, x) - around.era_rad - EARTH_RATE_RAD_S * time_s
    slope = np.zeros_like(unknowns)
    slope[:2] = np.array([-y, x]) / (x * x + y * y)
    return float((angle + np.pi) % TURN - np.pi), slope
