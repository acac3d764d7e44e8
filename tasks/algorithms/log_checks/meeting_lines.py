"""Meeting lines: which reading of the sensors' states makes their lines of sight meet.

Two sensors that see one object have it in one plane with themselves. Where no views meet as the
states are written, ordinary mistakes are tried: for all sensors, for one, and exchanged
ephemerides. A reading is named only if nearly all views of the sensors concerned meet with it, and
far more than the number of views explains.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.tasks.algorithms.constants import EARTH_RATE_RAD_S
from epipole.tasks.algorithms.earth_gravity import propagate_states

GATE = 3.0  # sigmas of the distance from the plane
UNRELATED_RAD = 0.02  # views that have nothing in common miss each other by about this, or more
TURN_RAD, N_TURNS = 0.05, 4  # 1-sigma per axis, of views that shall have nothing in common
MIN_SINE = 0.1  # of the angle between a view and the baseline: along it everything meets
NEAREST_KM, FARTHEST_KM = 1.0, 2e5  # range of an object
MEETS = 0.9  # share of the views that meet where the reading is right
MIN_VIEWS = 4  # of a sensor at one epoch on average: fewer decide nothing
MIN_SHARE = 0.6  # of the views concerned, that meet with the reading that is named
MAX_STATED_SHARE = 0.8  # with more as stated nothing is tried
MIN_STATED_SHARE = 0.5  # with less the sensor has no common objects, or a mistake
MIN_BETTER = 0.2  # share of the views that meet only with the reading that is named
MIN_GAIN = 10.0  # log odds against the stated reading
MIN_LEAD = 5.0  # log odds against any other
OFFSETS_S = (18.0, -18.0, 37.0, -37.0, 3600.0, -3600.0)  # GPS, TAI, an hour
STEPS = 120  # of an hour: half a minute each
MAX_SENSORS = 12  # whose ephemerides are exchanged in pairs


class Sights(NamedTuple):
    """Views of n objects at some epochs, each epoch with views of two sensors or more.

    epoch, sensor : (n,) int
        Numbers from 0.
    u : (n, 3) float
        Directions, GCRF; `sigma_rad` (n,) their 1-sigma errors per axis.
    r_km, v_km_s : (n, 3) float
        Sensors, GCRF; `position_sigma_km` (n,).
    """

    epoch: Integers
    sensor: Integers
    u: Array
    sigma_rad: Array
    r_km: Array
    v_km_s: Array
    position_sigma_km: Array


class NamedReading(NamedTuple):
    """A reading that makes lines meet: `sensor` is -1 where all sensors have the mistake."""

    cause: str
    sensor: int
    other: int  # whose ephemeris it is, where two are exchanged; else -1
    share: float
    stated_share: float
    log_odds: float
    offset_s: float = 0.0


class _Tried(NamedTuple):
    cause: str
    sensor: int
    other: int
    r_km: Array
    offset_s: float = 0.0


def find_reading(sights: Sights, R_gcrf_from_teme: Array) -> list[NamedReading]:
    """Return the mistake of all sensors, or those of single ones; none where none decides.

    Parameters
    ----------
    R_gcrf_from_teme : (3, 3) float
        Rotation at the time of the views.
    """
    n_sensors = int(sights.sensor.max(initial=-1)) + 1
    n_epochs = max(len(np.unique(sights.epoch)), 1)
    if n_sensors < 2 or len(sights.epoch) < MIN_VIEWS * n_epochs:
        return []
    odds, meets = _odds(sights, sights.r_km)
    shares = np.bincount(sights.sensor, meets) / np.maximum(np.bincount(sights.sensor), 1)
    if meets.mean() <= MAX_STATED_SHARE:
        every = np.ones(len(meets), bool)
        tried = [*_of_all(sights, R_gcrf_from_teme), *_exchanged(sights, range(n_sensors))]
        best = _best(sights, tried, odds, meets, every)
        if best:
            return best
    alone = np.flatnonzero(shares <= MAX_STATED_SHARE).tolist()
    if len(alone) >= 2:
        concerned = np.isin(sights.sensor, alone)
        best = _best(sights, list(_exchanged(sights, alone)), odds, meets, concerned)
        if best:
            return best
    found = []
    for sensor in alone if n_sensors > 2 else []:
        mine = sights.sensor == sensor
        if mine.sum() < MIN_VIEWS * n_epochs or meets[~mine].mean() <= MIN_STATED_SHARE:
            continue  # the others meet nothing either
        tried = list(_of_one(sights, sensor, R_gcrf_from_teme))
        found += _best(sights, tried, odds, meets, mine)
    return found


def shares_that_meet(sights: Sights) -> tuple[Array, Array]:
    """Return the share of each sensor's views that meet one of another, as stated.

    And the share of those that would without a common object: with many views, or large errors,
    everything meets something. So it is with each sensor's views turned at random.
    """
    n = np.maximum(np.bincount(sights.sensor), 1)

    def share_of(u: Array) -> Array:
        meets = _odds(sights._replace(u=u), sights.r_km)[1]
        return np.asarray(np.bincount(sights.sensor, meets) / n)

    rng = np.random.default_rng(1)
    turned = []
    for _ in range(N_TURNS):
        turn = rng.normal(0.0, TURN_RAD, (len(n), 3))[sights.sensor]
        u = sights.u + np.cross(turn, sights.u)
        turned.append(share_of(u / np.linalg.norm(u, axis=1, keepdims=True)))
    return share_of(sights.u), np.mean(turned, axis=0)


def _best(
    sights: Sights, tried: list[_Tried], stated_odds: Array, stated: Flags, concerned: Flags
) -> list[NamedReading]:
    """Return the reading that wins beyond doubt, if any."""
    n_epochs = len(np.unique(sights.epoch))
    scores = []
    for each in tried:
        odds, meets = _odds(sights, each.r_km, concerned)
        # Views of the same objects at several epochs do not add up.
        gain = float((odds - stated_odds)[concerned].sum()) / n_epochs
        scores.append((gain, float(meets[concerned].mean()), each))
    scores.sort(key=lambda score: -score[0])
    gain, share, best = scores[0]
    same = (best.cause, best.sensor, best.other)
    rest = [score for score in scores[1:] if score[2][:3] != same]
    lead = gain - max((score[0] for score in rest), default=-np.inf)
    shares = (share, float(stated[concerned].mean()))
    if gain < MIN_GAIN + np.log(len(tried)) or lead < MIN_LEAD or share < MIN_SHARE:
        return []
    if share - shares[1] < MIN_BETTER:
        return []
    return [NamedReading(best.cause, best.sensor, best.other, *shares, gain, best.offset_s)]


def _odds(sights: Sights, r_km: Array, concerned: Flags | None = None) -> tuple[Array, Flags]:
    """Return the log odds (n,) that each view meets one of another sensor, and whether it does.

    Only of the views concerned, if given.
    """
    n = len(sights.epoch)
    wanted = np.ones(n, bool) if concerned is None else concerned
    log_missing, meets = np.zeros(n), np.zeros(n, bool)
    for epoch in np.unique(sights.epoch):
        rows = np.flatnonzero(sights.epoch == epoch)
        mine = rows[wanted[rows]]
        hit, chance = _pairs(sights, r_km, mine, rows)
        meets[mine] = hit.any(axis=1)
        log_missing[mine] = np.log1p(-np.minimum(chance, 0.999)).sum(axis=1)
    by_accident = np.clip(1 - np.exp(log_missing), 1e-6, 1 - 1e-6)
    odds = np.where(meets, np.log(MEETS / by_accident), np.log((1 - MEETS) / (1 - by_accident)))
    return np.minimum(odds, -np.log(1e-3)), meets


def _pairs(sights: Sights, r_km: Array, a: Integers, b: Integers) -> tuple[Flags, Array]:
    """Return which of views a and b of one epoch meet (m, k), and how probable that is anyway."""
    u_a, u_b = sights.u[a], sights.u[b]
    d = r_km[b][None, :, :] - r_km[a][:, None, :]
    length = np.maximum(np.linalg.norm(d, axis=2), 1e-9)
    normal = np.cross(d, u_a[:, None, :])
    sine = np.linalg.norm(normal, axis=2) / length
    miss = np.einsum("ijk,jk->ij", normal, u_b) / np.maximum(length * sine, 1e-9)
    shift = (sights.position_sigma_km[a][:, None] + sights.position_sigma_km[b]) / length
    variance = sights.sigma_rad[a][:, None] ** 2 + sights.sigma_rad[b] ** 2
    sigma = np.sqrt(variance + shift**2)
    # Ranges of the nearest points of both lines.
    cosine = u_a @ u_b.T
    along, back = np.einsum("ijk,ik->ij", d, u_a), np.einsum("ijk,jk->ij", d, u_b)
    apart = np.maximum(1 - cosine**2, 1e-12)
    range_a, range_b = (along - cosine * back) / apart, (cosine * along - back) / apart
    ahead = (range_a > NEAREST_KM) & (range_b > NEAREST_KM)
    ahead &= (range_a < FARTHEST_KM) & (range_b < FARTHEST_KM)
    other = sights.sensor[a][:, None] != sights.sensor[b]
    usable = other & (length > 1.0) & (sine > MIN_SINE)
    hit = usable & ahead & (np.abs(miss) < GATE * sigma)
    chance = np.where(usable, np.minimum(2 * GATE * sigma / UNRELATED_RAD, 1.0), 0.0)
    return hit, chance


def _of_all(sights: Sights, R_gcrf_from_teme: Array) -> Iterator[_Tried]:
    for cause, r_km, offset_s in _changed(sights.r_km, sights.v_km_s, R_gcrf_from_teme):
        yield _Tried(cause, -1, -1, r_km, offset_s)


def _of_one(sights: Sights, sensor: int, R_gcrf_from_teme: Array) -> Iterator[_Tried]:
    mine = (sights.sensor == sensor)[:, None]
    for cause, r_km, offset_s in _changed(sights.r_km, sights.v_km_s, R_gcrf_from_teme):
        yield _Tried(cause, sensor, -1, np.where(mine, r_km, sights.r_km), offset_s)


def _changed(r_km: Array, v_km_s: Array, R: Array) -> Iterator[tuple[str, Array, float]]:
    """Yield what positions may be by mistake: the cause, the right positions, an offset [s]."""
    yield "other_inertial_frame", r_km @ R.T, 0.0
    yield "other_inertial_frame", r_km @ R, 0.0
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            if order != (0, 1, 2) or min(signs) < 0:
                yield "axes_of_states", r_km[:, order] * np.array(signs), 0.0
    for offset_s in OFFSETS_S:
        # Frames carry a time that is later than that of the states by the offset.
        at = np.full(len(r_km), -offset_s)
        yield "frames_and_states_apart", propagate_states(r_km, v_km_s, at, STEPS)[0], offset_s
        angle = EARTH_RATE_RAD_S * offset_s
        cosine, sine = np.cos(angle), np.sin(angle)
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        yield "earth_fixed_times", r_km @ turn.T, offset_s


def _exchanged(sights: Sights, sensors: Sequence[int]) -> Iterator[_Tried]:
    """Yield the exchange of two ephemerides, at epochs at which both sensors have views."""
    position: dict[tuple[int, int], Array] = {}
    for k in range(len(sights.epoch)):
        position.setdefault((int(sights.epoch[k]), int(sights.sensor[k])), sights.r_km[k])
    for a, b in combinations(sensors[:MAX_SENSORS], 2):
        r_km = sights.r_km.copy()
        for k in np.flatnonzero((sights.sensor == a) | (sights.sensor == b)).tolist():
            other = b if sights.sensor[k] == a else a
            r_km[k] = position.get((int(sights.epoch[k]), other), r_km[k])
        yield _Tried("ephemerides_exchanged", a, b, r_km)
