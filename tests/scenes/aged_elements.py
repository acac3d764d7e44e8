"""Element sets that age as published ones do, made of true ones.

A published set is a fit to the past. So each true set is dated back by its age: mean elements of
the earlier epoch whose orbit goes through the true places of the night. Then errors are added, in
kilometres: along, radial and across at the epoch, a drift along the track, and 15 % of the drag.
Their sizes are those of Kelso (2007), AAS 07-127, for navigation satellites, and of Vallado and
Cefola (2012), IAC-12-C1.6.12, for low ones, in round numbers. Catalogues are uneven: each satellite
has its own quality, log-normal with a factor of 1.6.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from epipole.schemas.star_lists import ElementSet
from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of

DAY_NS = 86_400_000_000_000
GM_KM3_S2 = 398600.8  # of WGS 72
DRAG_ERROR = 0.15
UNEVEN = np.log(1.6)
BSTAR, ECC, ARGP, INCL, ANOMALY, MOTION, NODE = 1, 4, 5, 6, 7, 8, 9


class Ageing(NamedTuple):
    """1-sigma errors at the epoch [km], and the drift along the track [km/day]."""

    along_km: float
    radial_km: float
    across_km: float
    drift_km_day: float


LOW = Ageing(0.6, 0.2, 0.3, 1.2)
HIGH = Ageing(2.5, 0.8, 1.0, 0.6)


def aged(
    sets: Sequence[ElementSet], night_ns: int, age_days: np.ndarray, rng: np.random.Generator
) -> list[ElementSet]:
    """Return the sets as a catalogue has them that was made so many days before the night."""
    return [
        _with_errors(_dated_back(each, night_ns, age), rng)
        for each, age in zip(sets, age_days.tolist(), strict=True)
    ]


def _dated_back(each: ElementSet, night_ns: int, age_days: float) -> ElementSet:
    """Return the set with an epoch before the night, and the same orbit in the night."""
    truth = np.array(each.elements)
    (satellite,) = satellites_of(truth[None])
    epoch_ns = night_ns - round(age_days * DAY_NS)
    minutes = (epoch_ns - each.epoch_ns) / 60e9
    start = truth.copy()
    start[0] += (epoch_ns - each.epoch_ns) / DAY_NS
    for k, rate in ((ANOMALY, "mdot"), (ARGP, "argpdot"), (NODE, "nodedot")):
        start[k] += getattr(satellite, rate) * minutes
    times = night_ns + (np.linspace(-0.3, 0.3, 7) * DAY_NS).astype(np.int64)
    wanted = predict([satellite], times)[0, :, :3]
    # Well defined for a circular orbit: the eccentricity as a vector, and the angle from the node.
    fitted = least_squares(
        lambda x: (_places(_changed(start, x), times) - wanted).ravel(),
        np.zeros(6), x_scale=[1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-8], diff_step=1e-6, method="lm",
    )  # fmt: skip
    return each._replace(epoch_ns=epoch_ns, elements=tuple(_changed(start, fitted.x).tolist()))


def _places(elements: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.nan_to_num(predict(satellites_of(elements[None]), times)[0, :, :3], nan=1e6)


def _changed(elements: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Return the elements changed by the eccentricity vector, the mean longitude, inclination,
    node [rad] and mean motion [rad/min]."""
    ex, ey, longitude, inclination, node, motion = by
    out = elements.copy()
    e = elements[ECC] * np.array([np.cos(elements[ARGP]), np.sin(elements[ARGP])]) + [ex, ey]
    out[ECC], out[ARGP] = np.hypot(*e), np.arctan2(e[1], e[0])
    # Ahead by the same angle from the node, wherever perigee now is.
    out[ANOMALY] = elements[ANOMALY] + elements[ARGP] - out[ARGP] + longitude
    out[INCL] += inclination
    out[NODE] += node
    out[ANOMALY] -= node * np.cos(elements[INCL])
    out[MOTION] += motion
    return out


def _with_errors(each: ElementSet, rng: np.random.Generator) -> ElementSet:
    elements = np.array(each.elements)
    n_rad_s = elements[MOTION] / 60
    a_km = (GM_KM3_S2 / n_rad_s**2) ** (1 / 3)
    size = HIGH if 2 * np.pi / elements[MOTION] > 225 else LOW
    quality = np.exp(rng.normal(0.0, UNEVEN))
    along, radial, across, drift = (quality * km / a_km for km in size)
    tilt = rng.normal(0.0, across, 2)
    by = [
        *rng.normal(0.0, radial, 2), rng.normal(0.0, along), tilt[0],
        tilt[1] / max(abs(np.sin(elements[INCL])), 0.05), rng.normal(0.0, drift / 1440),
    ]  # fmt: skip
    changed = _changed(elements, np.array(by))
    changed[BSTAR] *= 1 + rng.normal(0.0, DRAG_ERROR)
    return each._replace(elements=tuple(changed.tolist()))
