"""Predictions of catalogued satellites by SGP4, their errors, and a fast search for nearby ones.

Published element sets have no covariance. Their errors are a few hundred metres to kilometres at
the epoch, and grow mostly along the track, by about a kilometre a day (Kelso 2007, Validation of
SGP4 and IS-GPS-200D against GPS precision ephemerides, AAS 07-127; Vallado and Cefola 2012,
Two-line element sets, practice and use, IAC-12-C1.6.12). `ElementErrors` starts with these sizes;
`matching.learn_errors` improves them from the matches of a night.

`Screen` finds the satellites near a position without SGP4: it keeps states of the whole catalogue
at every half hour and compares orbit planes, radii, and positions of two-body orbits. Those that
pass are then predicted by SGP4.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from sgp4.api import WGS72, Satrec, SatrecArray

from epipole.schemas.arrays import Array, Indices, Nanoseconds
from epipole.tasks.algorithms.constants import GM_KM3_S2, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.orbits.reference_frames import Orientation, gcrf_from_teme
from epipole.tasks.algorithms.times import utc_julian_date

Satellites = Sequence[Satrec]

DAY_S = 86400.0
UNIX_EPOCH_JD = 2440587.5
SGP4_EPOCH_JD = 2433281.5  # 1949 December 31, 0h
MIN_TILT = 1e-4  # minimum sine of an inclination: below it the node is undefined
DRAG_UNKNOWN = 0.15  # unknown share of the drag: density and area change from day to day
# Mean motions [rad/s] below this are of periods above 225 minutes: SGP4's deep space.
DEEP_SPACE_RAD_S = 2 * np.pi / (225 * 60)
# Components of the errors of elements: along the track [km], the two of the eccentricity vector
# times the semi-major axis [km], the two of the pole of the orbit plane [km at the semi-major
# axis], and a drift along the track [km/day].
ERROR_COMPONENTS = ("along", "radial", "radial", "across", "across", "drift")
NODE_NS = 1_800_000_000_000
AXES_NS = 300_000_000_000
# Error of two-body motion over a quarter of an hour, as a share of the radius: twice the largest
# error that was measured.
NEGLECTED_SHARE = 0.005
KEPLER_STEPS = 6


class ElementErrors(NamedTuple):
    """1-sigma errors of element sets: along the track, radial, and across the orbit plane.

    Each is the root of the sum of squares of the error at the epoch [km] and of the growth
    [km/day] times the age.
    """

    along_km: float
    along_km_day: float
    radial_km: float
    radial_km_day: float
    across_km: float
    across_km_day: float


LOW_ORBIT = ElementErrors(0.7, 1.0, 0.25, 0.03, 0.25, 0.05)
HIGH_ORBIT = ElementErrors(2.0, 0.7, 1.0, 0.1, 1.0, 0.1)


def satellites_of(elements: Array) -> list[Satrec]:
    """Return SGP4's satellites of (n, 10) mean elements: the arguments of `sgp4init` in order."""
    made = []
    for row in np.asarray(elements, float).tolist():
        satellite = Satrec()
        satellite.sgp4init(WGS72, "i", 0, *row)
        made.append(satellite)
    return made


def predict(satellites: Satellites, time_ns: Nanoseconds) -> Array:
    """Return states of satellites by SGP4.

    Parameters
    ----------
    satellites
        n of them.
    time_ns : (m,) int
        UTC since 1970.

    Returns
    -------
    (n, m, 6) float
        Position [km] and velocity [km/s], GCRF; NaN where SGP4 fails, as after a decay.

    References
    ----------
    Vallado et al. (2006), Revisiting Spacetrack Report 3, AIAA 2006-6753.
    """
    shape = len(satellites), len(time_ns)
    if not all(shape):
        return np.empty((*shape, 6))
    return predict_all(SatrecArray(list(satellites)), time_ns)


def predict_all(satellites: SatrecArray, time_ns: Nanoseconds) -> Array:
    """Return the same of an array of satellites, which takes a time to make for many."""
    code, r_km, v_km_s = satellites.sgp4(*utc_julian_date(time_ns))
    R = _gcrf_axes(time_ns)
    turned = (
        np.stack([x[:, k] @ axes.T for k, axes in enumerate(R)], axis=1) for x in (r_km, v_km_s)
    )
    states = np.concatenate(list(turned), axis=2, dtype=float)
    bad = (np.asarray(code) != 0) | ~np.isfinite(states).all(axis=2)
    return np.where(bad[:, :, None], np.nan, states)


def predict_each(satellites: Satellites, row: Indices, time_ns: Nanoseconds) -> Array:
    """Return the states of satellites `row` (n,), one time for each, (n, 6).

    As `predict`. The axes of TEME are those of the nearest five minutes: they turn by less than
    1e-9 rad in this time.
    """
    states = np.full((len(row), 6), np.nan)
    utc = zip(*(part.tolist() for part in utc_julian_date(time_ns)), strict=True)
    for k, (satellite, jd) in enumerate(zip(row.tolist(), utc, strict=True)):
        code, r_km, v_km_s = satellites[satellite].sgp4(*jd)
        if code == 0:
            states[k] = *r_km, *v_km_s
    nodes, at = np.unique((time_ns + AXES_NS // 2) // AXES_NS, return_inverse=True)
    R = _gcrf_axes(nodes * AXES_NS)[at]
    return np.asarray(np.einsum("nij,nkj->nki", R, states.reshape(-1, 2, 3)).reshape(-1, 6))


def _gcrf_axes(time_ns: Nanoseconds) -> Array:
    """Return (m, 3, 3) rotations from TEME, the axes of SGP4, to GCRF.

    They hardly depend on UT1: UTC is used instead.
    """
    zeros = np.zeros(len(time_ns))
    orientation = Orientation(utc_julian_date(time_ns), zeros, zeros, zeros)
    axes = [np.tile(axis, (len(time_ns), 1)) for axis in np.eye(3)]
    return np.stack([gcrf_from_teme(time_ns, x, x, orientation)[0] for x in axes], axis=2)


def is_deep_space(satellite: Any) -> bool:
    """Return whether a satellite's period is above 225 minutes."""
    return bool(satellite.no_kozai / 60.0 < DEEP_SPACE_RAD_S)


def sigmas(satellite: Any, age_days: float, errors: ElementErrors) -> Array:
    """Return the 1-sigma errors of a satellite's elements, (6,); see `ERROR_COMPONENTS`."""
    return sigmas_of(errors, age_days, drag_error_km(satellite, age_days))


def sigmas_of(errors: ElementErrors, age_days: float | Array, drag_km: float | Array) -> Array:
    """Return the 1-sigma errors of elements of some ages, (..., 6); see `ERROR_COMPONENTS`.

    `drag_km` is the error along the track that is due to drag (see `drag_error_km`).
    """
    along = np.hypot(np.hypot(errors.along_km, errors.along_km_day * age_days), drag_km)
    radial = np.hypot(errors.radial_km, errors.radial_km_day * age_days)
    across = np.hypot(errors.across_km, errors.across_km_day * age_days)
    drift = np.hypot(errors.along_km_day, 2 * drag_km / np.maximum(np.abs(age_days), 1.0))
    return np.stack([along, radial, radial, across, across, drift], axis=-1)


def drag_error_km(satellite: Any, age_days: float) -> float:
    """Return the 1-sigma error along the track due to drag [km].

    It grows with the square of the age: a share of the displacement along the track by which drag
    moves a low satellite in SGP4.
    """
    minutes = abs(age_days) * DAY_S / 60.0
    change = abs(_drag_change(satellite, minutes))
    return DRAG_UNKNOWN * semi_major_axis(satellite) * change * minutes / 2


def sensitivities(satellite: Any, time_ns: Nanoseconds, anchor: int) -> Array:
    """Return the derivatives of a satellite's positions by the errors of its elements.

    They are differences of positions by SGP4, valid for days. Derivatives of two-body motion would
    be wrong by a tenth after one orbit.

    Parameters
    ----------
    time_ns : (m,) int
        UTC since 1970.
    anchor
        Row of the time at which the drift is zero.

    Returns
    -------
    (m, 3, 6) float
        GCRF; km per unit of `ERROR_COMPONENTS`.
    """
    a_km = semi_major_axis(satellite)
    ex, ey = satellite.ecco * np.cos(satellite.argpo), satellite.ecco * np.sin(satellite.argpo)
    tilt = 1.0 / a_km
    node = tilt / max(abs(np.sin(satellite.inclo)), MIN_TILT)
    epoch_ns = (satellite.jdsatepoch - UNIX_EPOCH_JD + satellite.jdsatepochF) * DAY_S * 1e9
    minutes = (float(time_ns[anchor]) - epoch_ns) / 60e9
    motion = 1.0 / a_km / (DAY_S / 60.0)
    nominal = _changed(satellite, ex, ey)
    changed = [
        nominal,
        _changed(satellite, ex, ey, longitude=1.0 / a_km),
        _changed(satellite, ex + 1.0 / a_km, ey),
        _changed(satellite, ex, ey + 1.0 / a_km),
        _changed(satellite, ex, ey, inclination=tilt),
        _changed(satellite, ex, ey, node=node, longitude=-node * np.cos(satellite.inclo)),
        _changed(satellite, ex, ey, motion=motion, longitude=-motion * minutes),
    ]
    positions = predict(satellites_of(np.array(changed)), time_ns)[:, :, :3]
    return np.asarray(np.moveaxis(positions[1:] - positions[0], 0, 2))


def _changed(
    satellite: Any,
    ex: float,
    ey: float,
    longitude: float = 0.0,
    inclination: float = 0.0,
    node: float = 0.0,
    motion: float = 0.0,
) -> list[float]:
    """Return the mean elements with another eccentricity vector and other angles [rad].

    A turn of perigee leaves the mean argument of latitude as it is.
    """
    argument = np.arctan2(ey, ex)
    anomaly = satellite.mo + satellite.argpo - argument + longitude
    epoch_days = satellite.jdsatepoch - SGP4_EPOCH_JD + satellite.jdsatepochF
    return [
        epoch_days, satellite.bstar, satellite.ndot, satellite.nddot, np.hypot(ex, ey), argument,
        satellite.inclo + inclination, anomaly, satellite.no_kozai + motion,
        satellite.nodeo + node,
    ]  # fmt: skip


def semi_major_axis(satellite: Any) -> float:
    """Return the semi-major axis of the mean motion [km]."""
    return float(GM_KM3_S2 / (satellite.no_kozai / 60.0) ** 2) ** (1 / 3)


def _drag_change(satellite: Any, minutes: float) -> float:
    """Return the change of the mean motion by drag in SGP4 after some minutes [rad/min].

    Zero of a satellite that has come down by then.
    """
    if is_deep_space(satellite):
        return 0.0
    mean_motions = []
    for t in (0.0, minutes):
        satellite.sgp4_tsince(t)
        mean_motions.append(float(satellite.nm))
    change = mean_motions[1] - mean_motions[0]
    return change if np.isfinite(change) else 0.0


def along_up_across(state: Array) -> Array:
    """Return unit vectors as rows, (3, 3), of a (6,) state.

    Along the velocity, at right angles to it in the orbit plane (up), and across the plane.
    """
    ahead = state[3:] / np.linalg.norm(state[3:])
    side = np.cross(state[:3], state[3:])
    side /= np.linalg.norm(side)
    return np.array([ahead, np.cross(ahead, side), side])


# Residuals


def track_residuals(
    directions: Array, sensor_km: Array, sensor_km_s: Array, states: Array
) -> Array:
    """Return observed minus predicted positions at the object's distance, along and across track.

    Parameters
    ----------
    directions : (n, 2) float
        Astrometric right ascension and declination [rad], GCRF; light time not removed.
    sensor_km, sensor_km_s : (n, 3) float
        Position and velocity of the sensor, GCRF.
    states : (n, 6) float
        Predicted states of the object at the same times [km, km/s], GCRF.

    Returns
    -------
    (n, 2) float
        [km]: along the apparent motion, and to the left of it as the sensor sees it.
    """
    apart = states[:, :3] - sensor_km
    delay_s = np.linalg.norm(apart, axis=1, keepdims=True) / SPEED_OF_LIGHT_KM_S
    apart = apart - delay_s * states[:, 3:]  # where the light came from
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    predicted = apart / distance
    ra, dec = directions.T
    observed = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    moving = states[:, 3:] - sensor_km_s
    moving -= np.sum(moving * predicted, axis=1, keepdims=True) * predicted
    along = moving / np.linalg.norm(moving, axis=1, keepdims=True)
    across = np.cross(along, predicted)
    off = (observed - predicted) * distance
    return np.stack([np.sum(off * along, axis=1), np.sum(off * across, axis=1)], axis=1)


# Screening


class Screen:
    """A fast search for the satellites of a catalogue near a position at a time.

    Parameters
    ----------
    satellites
        n of them.
    """

    def __init__(self, satellites: Satellites) -> None:
        self._satellites = satellites
        self._nodes: dict[int, Array] = {}

    def near(self, r_km: Array, time_ns: int, reach_km: Array) -> Indices:
        """Return the satellites that may be within `reach_km` (n,) of a (3,) position, GCRF."""
        node = (time_ns + NODE_NS // 2) // NODE_NS
        if node not in self._nodes:
            self._nodes[node] = predict(self._satellites, np.array([node * NODE_NS]))[:, 0]
        states = self._nodes[node]
        gate = reach_km + NEGLECTED_SHARE * np.linalg.norm(r_km)
        found = _in_plane_and_shell(states, r_km, gate)
        propagated = two_body(states[found], (time_ns - node * NODE_NS) / 1e9)
        return found[np.linalg.norm(propagated - r_km, axis=1) < gate[found]]


def _in_plane_and_shell(states: Array, r_km: Array, gate: Array) -> Indices:
    """Return the rows of (n, 6) states whose orbits pass a (3,) position within (n,) `gate` km."""
    r, v = states[:, :3], states[:, 3:]
    momentum = np.cross(r, v)
    off_plane = np.abs(momentum @ r_km) / np.linalg.norm(momentum, axis=1)
    distance = np.linalg.norm(r, axis=1)
    a = 1.0 / (2.0 / distance - np.sum(v * v, axis=1) / GM_KM3_S2)
    e2 = 1.0 - np.sum(momentum * momentum, axis=1) / (GM_KM3_S2 * a)
    e = np.sqrt(np.maximum(e2, 0.0))
    at = np.linalg.norm(r_km)
    in_shell = (at > a * (1 - e) - gate) & (at < a * (1 + e) + gate)
    return np.flatnonzero((off_plane < gate) & in_shell)  # false for NaN


def two_body(states: Array, dt_s: float) -> Array:
    """Return (n, 3) positions [km] of (n, 6) elliptic states [km, km/s] after dt_s, two-body."""
    r, v = states[:, :3], states[:, 3:]
    distance = np.linalg.norm(r, axis=1)
    a = 1.0 / (2.0 / distance - np.sum(v * v, axis=1) / GM_KM3_S2)
    n = np.sqrt(GM_KM3_S2 / a**3)
    s = np.sum(r * v, axis=1) / np.sqrt(GM_KM3_S2 * a)  # e sin E
    c = 1.0 - distance / a  # e cos E
    x = n * dt_s  # difference of eccentric anomalies
    for _ in range(KEPLER_STEPS):
        f = x - c * np.sin(x) + s * (1 - np.cos(x)) - n * dt_s
        x = x - f / (1 - c * np.cos(x) + s * np.sin(x))
    forward = 1 - a / distance * (1 - np.cos(x))
    lag = dt_s - (x - np.sin(x)) / n
    return np.asarray(forward[:, None] * r + lag[:, None] * v)
