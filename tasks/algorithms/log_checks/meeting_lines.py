"""Meeting lines: which reading of the sensors' states makes their lines of sight meet.

At each epoch, an object lies in one plane with two sensors that see it. The lines of sight of two
unrelated tracklets seldom meet by accident, and hardly ever at several epochs. So the miss of each
tracklet from the nearest one of another sensor shows whether states are read as they were meant.

Where few tracklets meet as the states are written, ordinary mistakes are tried: of all sensors, of
one, and exchanged ephemerides. The share of the tracklets that have a counterpart is estimated as
well. So a reading is found even if most objects are seen by one sensor only.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from scipy.special import erfc

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.tasks.algorithms.constants import EARTH_RATE_RAD_S
from epipole.tasks.algorithms.earth_gravity import propagate_states
from epipole.tasks.algorithms.kernels import borrowing_kernel

GATE = 3.0  # [sigma] of the miss, root mean square over the epochs that two tracklets share
UNRELATED_RAD = 0.02  # unrelated views miss each other by about this, or more
TURN_RAD, N_TURNS = 0.05, 4  # random rotations that make views unrelated, 1-sigma per axis
MIN_SINE = 0.1  # of the angle between a view and the baseline: along it everything meets
NEAREST_KM, FARTHEST_KM = 1.0, 2e5  # range of an object
SHARES = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
MIN_MET = 4  # minimum number of tracklets that have a counterpart
# With a reading that is named, the share of a sensor's tracklets that meet another is at least this
# part of the same share of the other sensors.
MIN_SHARE = 0.6
MAX_STATED_SHARE = 0.8  # nothing is tried if a larger share meets another as stated
MIN_BETTER = 0.2  # minimum part of the counterparts that only the reading gives
MIN_GAIN = 8.0  # log odds against the stated reading
MIN_LEAD = 5.0  # log odds against any other
MIN_SOUND = 3.0  # log odds that a sensor's tracklets have counterparts as the states are written
OFFSETS_S = (18.0, -18.0, 37.0, -37.0, 3600.0, -3600.0)  # GPS, TAI, an hour
STEPS = 120  # of an hour: half a minute each
MAX_SENSORS = 32  # whose ephemerides are exchanged in pairs


class Sights(NamedTuple):
    """Views of n objects at some epochs, each epoch with views of two sensors or more.

    epoch_s : (n,) float
        Times from any on [s].
    sensor, tracklet : (n,) int
        Numbers from 0; a tracklet is of one sensor.
    u : (n, 3) float
        Directions, GCRF; `sigma_rad` (n,) their 1-sigma errors per axis.
    r_km, v_km_s : (n, 3) float
        Sensors, GCRF; `position_sigma_km` (n,).
    """

    epoch_s: Array
    sensor: Integers
    tracklet: Integers
    u: Array
    sigma_rad: Array
    r_km: Array
    v_km_s: Array
    position_sigma_km: Array


class NamedReading(NamedTuple):
    """A reading that makes lines meet: `sensor` is -1 where all sensors have the mistake.

    Shares are of the tracklets concerned: those that meet one of another sensor.
    """

    cause: str
    sensor: int
    other: int  # whose ephemeris it is, where two are exchanged; else -1
    share: float
    stated_share: float
    log_odds: float
    offset_s: float = 0.0


class StatedMeetings(NamedTuple):
    """How tracklets of each sensor agree with those of others, as the states are written.

    share, by_accident : (sensors,) float
        Share of its tracklets that meet one of another sensor; expected share if all are unrelated.
    log_odds : (sensors,) float
        That some tracklets have counterparts, against none.
    """

    share: Array
    by_accident: Array
    log_odds: Array

    @property
    def is_sound(self) -> Flags:
        """Whether each sensor's tracklets have counterparts among those of others."""
        return np.asarray(self.log_odds > MIN_SOUND)


class _Pairs(NamedTuple):
    """Views of two sensors at one epoch, (m,) rows a and b, by the pair of tracklets.

    `number` (m,) is that of the pair, `tracklets` (pairs, 2) are its two. `survival` is a share of
    unrelated pairs: of those that meet at one epoch, those that meet at the others too.
    """

    a: Integers
    b: Integers
    number: Integers
    tracklets: Integers
    survival: float = 1.0

    def of(self, concerned: Flags) -> "_Pairs":
        """Return the pairs with a view that is concerned (n,)."""
        wanted = concerned[self.a] | concerned[self.b]
        numbers, number = np.unique(self.number[wanted], return_inverse=True)
        return self._replace(
            a=self.a[wanted], b=self.b[wanted], number=number.reshape(-1),
            tracklets=self.tracklets[numbers],
        )  # fmt: skip


class _Nearest(NamedTuple):
    """The miss of each tracklet [sigma]: from the nearest one of another sensor, within `GATE`.

    It is infinite where no other is within the gate. `density` (tracklets,) is the expected number
    of unrelated ones per sigma of the miss.
    """

    miss: Array
    density: Array

    def of(self, tracklets: Flags) -> "_Nearest":
        return _Nearest(self.miss[tracklets], self.density[tracklets])

    @property
    def share(self) -> float:
        """The share of the tracklets that meet one."""
        return float(np.isfinite(self.miss).mean()) if len(self.miss) else 0.0

    def log_odds(self) -> float:
        """Return the log odds that a share of the tracklets has counterparts, against none.

        The share is the most likely one. Either the nearest tracklet is the counterpart, or it is
        unrelated and the counterpart is farther away.
        """
        usable = self.density > 0
        z, density = self.miss[usable], self.density[usable]
        true = np.sqrt(2 / np.pi) * np.exp(-(np.minimum(z, 1e2) ** 2) / 2) / density
        ratio = np.where(np.isfinite(z), true + erfc(z / np.sqrt(2)), 0.0)
        odds = np.log1p(SHARES[:, None] * (ratio - 1)).sum(axis=1)
        return float(max(odds.max(initial=0.0), 0.0))


class _Tried(NamedTuple):
    cause: str
    sensor: int
    other: int
    r_km: Array
    offset_s: float = 0.0


class _Lines(NamedTuple):
    """The lines of sight, and what they tell as the states are written.

    `sensor_of` (tracklets,) is each tracklet's sensor.
    """

    sights: Sights
    pairs: _Pairs
    sensor_of: Integers
    stated: _Nearest

    def of_sensor(self, sensor: int) -> _Nearest:
        """Return the misses of the sensor's tracklets."""
        return self.stated.of(self.sensor_of == sensor)


def judge_meetings(
    sights: Sights, R_gcrf_from_teme: Array
) -> tuple[StatedMeetings, list[NamedReading]]:
    """Return how tracklets meet as stated, and the readings of the states that are clearly better.

    The readings are one for all sensors, or those of single ones.

    Parameters
    ----------
    R_gcrf_from_teme : (3, 3) float
        Rotation at the time of the views.
    """
    pairs = _pairs(sights)
    nearest = _nearest_of(sights, pairs, sights.r_km)
    lines = _Lines(sights, pairs, _sensor_of(sights), nearest)
    found = _find_readings(lines, R_gcrf_from_teme) if len(pairs.a) else []
    return _stated_meetings(lines), found


def _stated_meetings(lines: _Lines) -> StatedMeetings:
    n_sensors = int(lines.sensor_of.max(initial=-1)) + 1
    of_each = [lines.of_sensor(k) for k in range(n_sensors)]
    accident = [np.mean(-np.expm1(-GATE * each.density)) for each in of_each]
    return StatedMeetings(
        np.array([each.share for each in of_each]),
        np.array(accident, float),
        np.array([each.log_odds() for each in of_each]),
    )


def _find_readings(lines: _Lines, R: Array) -> list[NamedReading]:
    """Return the mistake that all sensors have, or those of single ones; empty if none is clear."""
    sights, sensor_of, stated = lines.sights, lines.sensor_of, lines.stated
    readings = list(_readings(sights.r_km, sights.v_km_s, R))
    n_sensors = len(np.unique(sensor_of))
    if stated.share <= MAX_STATED_SHARE:
        tried = [_Tried(cause, -1, -1, r_km, offset_s) for cause, r_km, offset_s in readings]
        # With two sensors, an exchange turns the baseline, as negated axes do.
        tried += list(_exchanged(sights, [0, 1])) if n_sensors == 2 else []
        every = np.ones(len(sensor_of), bool)
        if best := _best(lines, tried, every, 0.0):
            return best
    if n_sensors == 2:
        return []
    of_each = [lines.of_sensor(k) for k in range(n_sensors)]
    unmatched = [
        k for k, each in enumerate(of_each)
        if each.share <= MAX_STATED_SHARE and each.log_odds() < MIN_GAIN
    ]  # fmt: skip
    if found := _best_exchanges(lines, unmatched):
        return found
    for sensor in unmatched:
        others = stated.of(sensor_of != sensor)
        if others.log_odds() < MIN_GAIN:
            continue  # they meet nothing either
        of_sensor = (sights.sensor == sensor)[:, None]
        tried = [
            _Tried(cause, sensor, -1, np.where(of_sensor, r_km, sights.r_km), offset_s)
            for cause, r_km, offset_s in readings
        ]
        found += _best(lines, tried, sensor_of == sensor, others.share)
    return found


def _best(
    lines: _Lines, tried: list[_Tried], concerned: Flags, expected_share: float
) -> list[NamedReading]:
    """Return the reading that is clearly the best, if any.

    `concerned` (tracklets,) are those of sensors that are read anew; of the tracklets of other
    sensors, `expected_share` meets another.
    """
    chosen = lines.pairs.of(concerned[lines.sights.tracklet])
    # If all are concerned, each meeting is counted for both of its tracklets.
    part = 0.5 if concerned.all() else 1.0
    as_stated = lines.stated.of(concerned)
    scores = []
    for each in tried:
        nearest = _nearest_of(lines.sights, chosen, each.r_km).of(concerned)
        gain = part * (nearest.log_odds() - as_stated.log_odds())
        scores.append((gain, nearest.share, each))
    scores.sort(key=lambda score: -score[0])
    gain, share, best = scores[0]
    same = (best.cause, best.sensor, best.other)
    lead = gain - max((score[0] for score in scores[1:] if score[2][:3] != same), default=-np.inf)
    is_clear = gain > MIN_GAIN + np.log(len(tried)) and lead > MIN_LEAD
    is_usual = share >= MIN_SHARE * expected_share and share * concerned.sum() >= MIN_MET
    if not (is_clear and is_usual and share - as_stated.share >= MIN_BETTER * share):
        return []
    return [
        NamedReading(
            best.cause, best.sensor, best.other, share, as_stated.share, gain, best.offset_s
        )
    ]


def _best_exchanges(lines: _Lines, sensors: Sequence[int]) -> list[NamedReading]:
    """Return the exchanges of ephemerides that are clear, each of the `sensors` in one at most.

    Two sensors on one satellite share its ephemeris: either may be exchanged with a third.
    """
    found = []
    tried = list(_exchanged(lines.sights, sensors))
    for each in tried:
        concerned = np.isin(lines.sensor_of, [each.sensor, each.other])
        found += _best(lines, [each], concerned, lines.stated.of(~concerned).share)
    named: list[NamedReading] = []
    for one in sorted(found, key=lambda one: -one.log_odds):
        taken = {k for other in named for k in (other.sensor, other.other)}
        if one.log_odds > MIN_GAIN + np.log(len(tried)) and taken.isdisjoint(
            (one.sensor, one.other)
        ):
            named.append(one)
    return named


def _sensor_of(sights: Sights) -> Integers:
    """Return the sensor of each tracklet."""
    sensor_of = np.zeros(int(sights.tracklet.max(initial=-1)) + 1, np.int64)
    sensor_of[sights.tracklet] = sights.sensor
    return sensor_of


def _pairs(sights: Sights) -> _Pairs:
    """Return all pairs of views of two sensors at one epoch, by pair of tracklets."""
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for epoch_s in np.unique(sights.epoch_s):
        rows = np.flatnonzero(sights.epoch_s == epoch_s)
        rows = rows[np.argsort(sights.tracklet[rows])]  # whatever the order of the views
        a, b = (rows[k] for k in np.triu_indices(len(rows), 1))
        wanted = sights.sensor[a] != sights.sensor[b]
        first.append(a[wanted])
        second.append(b[wanted])
    a, b = np.concatenate(first), np.concatenate(second)
    both = np.stack([sights.tracklet[a], sights.tracklet[b]], axis=1)
    tracklets, number = np.unique(both, axis=0, return_inverse=True)
    pairs = _Pairs(a, b, number.reshape(-1), tracklets.reshape(-1, 2))
    return pairs._replace(survival=_survival(sights, pairs))


def _survival(sights: Sights, pairs: _Pairs) -> float:
    """Return the `survival` of `_Pairs`: it is 1 at most.

    Views become unrelated when each sensor's are turned at random.
    """
    rng = np.random.default_rng(1)
    n_sensors = int(sights.sensor.max(initial=-1)) + 1
    met, expected = 1.0, 1.0
    for _ in range(N_TURNS):
        turn = rng.normal(0.0, TURN_RAD, (n_sensors, 3))[sights.sensor]
        u = sights.u + np.cross(turn, sights.u)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        miss, chance = _misses(sights._replace(u=u), pairs, sights.r_km)
        met += float((miss < GATE).sum())
        expected += float(chance.sum())
    return min(met / expected, 1.0)


def _nearest_of(sights: Sights, pairs: _Pairs, r_km: Array) -> _Nearest:
    """Return by how far tracklets miss the nearest ones they are paired with, from r_km."""
    miss, chance = _misses(sights, pairs, r_km)
    n = int(sights.tracklet.max(initial=-1)) + 1
    nearest, density = np.full(n, np.inf), np.zeros(n)
    for side in pairs.tracklets.T:
        np.minimum.at(nearest, side, np.where(miss < GATE, miss, np.inf))
        density += np.bincount(side, chance, n) * pairs.survival / GATE
    return _Nearest(nearest, density)


def _misses(sights: Sights, pairs: _Pairs, r_km: Array) -> tuple[Array, Array]:
    """Return the miss of each pair of tracklets, and the false-alarm probability of the gate.

    The miss is the root mean square over the epochs [sigma], infinite where lines do not meet ahead
    of both sensors. The probability is that an unrelated pair is within the gate at one epoch, 0
    where no epoch is usable.
    """
    sums = np.zeros((len(pairs.tracklets), 4))
    of_views = sights.sigma_rad, np.ascontiguousarray(r_km), sights.position_sigma_km
    _sum_misses(sights.u, *of_views, pairs.a, pairs.b, pairs.number, sums)
    n_usable, n_ahead, square, chance = sums.T
    is_ahead = (n_usable > 0) & (n_ahead == n_usable)
    count = np.maximum(n_usable, 1)
    return np.where(is_ahead, np.sqrt(square / count), np.inf), chance / count


@borrowing_kernel
def _sum_misses(u, sigma_rad, r_km, position_sigma_km, first, second, number, sums):
    """Add to the sums (pairs, 4) of each pair of tracklets what its lines of sight tell.

    Of the usable epochs: how many there are, at how many the lines meet ahead of both sensors, the
    squared misses [sigma^2], and the probabilities that unrelated lines are within the gate. The
    miss is the angle of view b from the plane of view a and both sensors.

    u (n, 3), sigma_rad (n,), r_km (n, 3) and position_sigma_km (n,) are of the views, as in
    `Sights`; first, second (m,) are the views of a pair at an epoch, `number` (m,) its pair.
    """
    for k in range(len(first)):
        a, b = first[k], second[k]
        ax, ay, az = u[a, 0], u[a, 1], u[a, 2]
        bx, by, bz = u[b, 0], u[b, 1], u[b, 2]
        dx, dy, dz = r_km[b, 0] - r_km[a, 0], r_km[b, 1] - r_km[a, 1], r_km[b, 2] - r_km[a, 2]
        length = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
        # The normal of the plane, and that of view b and the baseline.
        nx, ny, nz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        mx, my, mz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
        sine_a = np.sqrt(nx * nx + ny * ny + nz * nz) / length
        sine_b = np.sqrt(mx * mx + my * my + mz * mz) / length
        if not (length > 1.0 and sine_a > MIN_SINE and sine_b > MIN_SINE):
            continue
        scale = length * sine_a
        miss = (nx * bx + ny * by + nz * bz) / scale
        cosine = ax * bx + ay * by + az * bz
        apart = max(1.0 - cosine * cosine, 1e-12)
        # A position error across the plane counts as an angle: it is divided by the range from b.
        position = np.hypot(position_sigma_km[a], position_sigma_km[b])
        moved = position * np.sqrt(apart) / scale
        of_a = sigma_rad[a] * sine_b / sine_a
        variance = of_a * of_a + sigma_rad[b] * sigma_rad[b] + moved * moved
        # Ranges of the nearest points of both lines.
        along, back = dx * ax + dy * ay + dz * az, dx * bx + dy * by + dz * bz
        nearest = (along - cosine * back) / apart, (cosine * along - back) / apart
        of_pair = sums[number[k]]
        of_pair[0] += 1.0
        if min(nearest) > NEAREST_KM and max(nearest) < FARTHEST_KM:
            of_pair[1] += 1.0
        of_pair[2] += miss * miss / variance
        of_pair[3] += min(2.0 * GATE * np.sqrt(variance) / UNRELATED_RAD, 1.0)


def _readings(r_km: Array, v_km_s: Array, R: Array) -> Iterator[tuple[str, Array, float]]:
    """Yield ordinary mistakes: the cause, the positions without it, and an offset [s] or 0."""
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
    """Yield the readings with the ephemerides of two sensors exchanged."""
    epoch_s, at = np.unique(sights.epoch_s, return_inverse=True)
    chosen = list(sensors)[:MAX_SENSORS]
    paths = {sensor: _positions_at(sights, sensor, epoch_s) for sensor in chosen}
    for a, b in combinations(chosen, 2):
        r_km = sights.r_km.copy()
        for sensor, other in ((a, b), (b, a)):
            of_sensor = sights.sensor == sensor
            r_km[of_sensor] = paths[other][at[of_sensor]]
        yield _Tried("ephemerides_exchanged", a, b, r_km)


def _positions_at(sights: Sights, sensor: int, epoch_s: Array) -> Array:
    """Return a sensor's positions at other epochs, propagated from its nearest state."""
    known = np.flatnonzero(sights.sensor == sensor)
    nearest = known[np.abs(epoch_s[:, None] - sights.epoch_s[known]).argmin(axis=1)]
    after_s = epoch_s - sights.epoch_s[nearest]
    return propagate_states(sights.r_km[nearest], sights.v_km_s[nearest], after_s, STEPS)[0]
