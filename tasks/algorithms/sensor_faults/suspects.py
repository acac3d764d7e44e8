"""Faults among many sensors: which sensors are judged together, and which join no object.

Judging all sensors together costs the cube of their number. But one wrong sensor hardly moves the
positions that many others determine. So each sensor is first judged alone, with all others assumed
sound. Only the most suspicious sensors are then judged together (`judge_many_sensors`).

A fault may be so large that none of a sensor's tracklets join an object, although objects of the
other sensors are in its field. `agreement` finds these sensors.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.odds import seeing
from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.geometry.triangulation import triangulate
from epipole.tasks.algorithms.sensor_faults.fault_judgement import (
    ATTITUDE,
    CLOCK,
    COLUMNS,
    MIN_OBJECTS,
    PER_SENSOR,
    PRIOR_S,
    SOUND,
    Doubt,
    JudgedSensors,
    Lines,
    Model,
    judge_sensors,
    prior_sigmas,
    shift_lines,
    whitened,
)

MAX_TOGETHER = 24  # maximum number of sensors that are judged together
MAX_ROUNDS = 4  # each round judges the next suspects, without the sensors already at fault
MIN_JOINED_SHARE = 0.3  # minimum share of the objects in its field that a sound sensor joins
MIN_UNASSIGNED = 0.5  # minimum of unassigned tracklets per object in the field of a faulty sensor


def judge_many_sensors(
    lines: Lines, position_sigma_km: Array, attitude_sigma_rad: Array, guess_s: Array
) -> JudgedSensors:
    """Return each sensor's clock offset and fault, for any number of sensors.

    Parameters are those of `judge_sensors`, which does all the work for few sensors.
    """
    n_sensors = len(position_sigma_km)
    if n_sensors <= MAX_TOGETHER:
        return judge_sensors(lines, position_sigma_km, attitude_sigma_rad, guess_s)
    doubt = _doubt_of_most(lines, position_sigma_km, attitude_sigma_rad, guess_s)
    prior_sigma = prior_sigmas(position_sigma_km, attitude_sigma_rad)
    found = _nothing_known(n_sensors)._replace(doubt=doubt)
    if np.isfinite(doubt.shared_s):
        return found
    faulty = np.zeros(n_sensors, bool)
    for _ in range(MAX_ROUNDS):
        left = _of_other_sensors(lines, faulty)
        equations = _equations_alone(
            _with_biases_as_noise(left, prior_sigma), left.sensor, guess_s, prior_sigma
        )
        if not faulty.any():
            _store_offsets(found, equations, guess_s, prior_sigma)
        suspicion = _suspicion(equations, guess_s, prior_sigma, attitude_sigma_rad)
        suspects = np.argsort(-suspicion, kind="stable")
        # Without those at fault: they have no lines left, and would be judged sound.
        together = np.sort(suspects[~faulty[suspects]][:MAX_TOGETHER])
        if not len(together):
            break
        judged = judge_sensors(
            _with_sound_others(left, together, prior_sigma),
            position_sigma_km[together],
            attitude_sigma_rad[together],
            guess_s[together],
            len(np.setdiff1d(left.sensor, together)),
        )
        newly = _store_judged(found, judged, together)
        # The sensors with most lines may be clear, and others not.
        undecided = doubt.undecided or judged.doubt.undecided
        found = found._replace(doubt=doubt._replace(undecided=undecided))
        if not newly:
            break
        faulty[newly] = True
    return found


def _doubt_of_most(
    lines: Lines, position_sigma_km: Array, attitude_sigma_rad: Array, guess_s: Array
) -> Doubt:
    """Return the faults without a sensor that the `MAX_TOGETHER` sensors with most lines show."""
    count = np.bincount(lines.sensor, minlength=len(position_sigma_km))
    most = np.sort(np.argsort(-count, kind="stable")[:MAX_TOGETHER])
    others = np.ones(len(count), bool)
    others[most] = False
    among = _of_other_sensors(lines, others)
    among = among._replace(sensor=np.searchsorted(most, among.sensor))
    return judge_sensors(
        among, position_sigma_km[most], attitude_sigma_rad[most], guess_s[most]
    ).doubt


class _Equations(NamedTuple):
    """Normal equations (s, 7, 7) and right sides (s, 7) of each sensor alone.

    The unknowns are those of `PER_SENSOR`, each over its prior sigma.
    """

    normal: Array
    right: Array


def _nothing_known(n: int) -> JudgedSensors:
    """Return n sound sensors without offsets."""
    return JudgedSensors(
        np.full(n, np.nan), np.full(n, np.nan), [SOUND] * n, np.zeros(n), np.zeros(n)
    )


def _of_other_sensors(lines: Lines, faulty: Flags) -> Lines:
    """Return the lines of the sensors that are not `faulty` (s,)."""
    kept = ~faulty[lines.sensor]
    return lines._replace(**{name: getattr(lines, name)[kept] for name in Lines._fields})


def _with_biases_as_noise(lines: Lines, prior_sigma: Array) -> Lines:
    """Return the lines with the biases of their sensors as a part of their errors."""
    of_sensor = prior_sigma.reshape(-1, PER_SENSOR)[lines.sensor]
    # Columns 1 and 4: sigma of the position [km] and of the attitude [rad], the same on each axis.
    reach = np.linalg.norm(lines.x_km - lines.r_km, axis=1)
    variance = (of_sensor[:, 1] / reach) ** 2 + of_sensor[:, 4] ** 2
    cov = lines.cov + variance[:, None, None] * np.eye(2)
    return lines._replace(cov=cov, sensor=np.full(len(lines.sensor), -1))


def _with_sound_others(lines: Lines, together: Indices, prior_sigma: Array) -> Lines:
    """Return the lines, with all sensors but these assumed sound: `sensor` counts in `together`."""
    number = np.full(lines.sensor.max(initial=-1) + 1, -1)
    inside = together < len(number)  # sensors beyond have no lines
    number[together[inside]] = np.arange(len(together))[inside]
    sensor = number[lines.sensor]
    cov = np.where(
        (sensor >= 0)[:, None, None], lines.cov, _with_biases_as_noise(lines, prior_sigma).cov
    )
    return lines._replace(sensor=sensor, cov=cov)


def _equations_alone(
    noisy: Lines, sensor: Indices, guess_s: Array, prior_sigma: Array
) -> _Equations:
    """Return the normal equations of each sensor, with all others assumed sound.

    The position of each object is eliminated, by sums over its lines.
    """
    lines = shift_lines(noisy._replace(sensor=sensor), guess_s)
    to_position, to_sensor, residuals = whitened(lines, prior_sigma)
    _, group = np.unique(lines.group, return_inverse=True)
    n_groups = group.max(initial=-1) + 1
    normal, pull = np.zeros((n_groups, 3, 3)), np.zeros((n_groups, 3))
    np.add.at(normal, group, np.einsum("nik,nil->nkl", to_position, to_position))
    np.add.at(pull, group, np.einsum("nik,ni->nk", to_position, residuals))
    several = np.bincount(group, minlength=n_groups) > 1
    inverse = np.zeros_like(normal)
    inverse[several] = np.linalg.pinv(normal[several], hermitian=True)
    rows = several[group]
    by_position = np.einsum("nik,nkl->nil", to_position, inverse[group])
    left = residuals - np.einsum("nil,nl->ni", by_position, pull[group])
    reduced = np.eye(2) - np.einsum("nil,njl->nij", by_position, to_position)
    n_sensors = len(guess_s)
    out = _Equations(
        np.zeros((n_sensors, PER_SENSOR, PER_SENSOR)), np.zeros((n_sensors, PER_SENSOR))
    )
    weighted = np.einsum("nij,njk->nik", reduced, to_sensor)
    np.add.at(out.normal, sensor[rows], np.einsum("nik,nil->nkl", to_sensor, weighted)[rows])
    np.add.at(out.right, sensor[rows], np.einsum("nik,ni->nk", to_sensor, left)[rows])
    return out


def _models(equations: _Equations, guess_s: Array, prior_sigma: Array) -> list[Model]:
    """Return the model of each sensor alone."""
    per_sensor = prior_sigma.reshape(-1, PER_SENSOR)
    return [
        Model(equations.normal[s], equations.right[s], guess_s[s : s + 1] / PRIOR_S, per_sensor[s])
        for s in range(len(guess_s))
    ]


def _suspicion(
    equations: _Equations, guess_s: Array, prior_sigma: Array, attitude_sigma_rad: Array
) -> Array:
    """Return the log odds of each sensor's likeliest fault against a sound sensor."""
    out = np.full(len(guess_s), -np.inf)
    for s, model in enumerate(_models(equations, guess_s, prior_sigma)):
        kinds = [kind for kind in COLUMNS if kind != ATTITUDE or attitude_sigma_rad[s] > 0]
        sound = model.evidence(frozenset())
        out[s] = max(model.evidence(frozenset({(0, kind)})) for kind in kinds) - sound
    return out


def _store_offsets(
    found: JudgedSensors, equations: _Equations, guess_s: Array, prior_sigma: Array
) -> None:
    """Store the clock offset of each sensor that has lines."""
    clock = frozenset({(0, CLOCK)})
    for s, model in enumerate(_models(equations, guess_s, prior_sigma)):
        if equations.normal[s, 0, 0] > 0.0:
            step, cov = model.estimate(clock)
            found.offset_s[s] = guess_s[s] + step[0] * PRIOR_S
            found.sigma_s[s] = np.sqrt(cov[0, 0]) * PRIOR_S


def _store_judged(found: JudgedSensors, judged: JudgedSensors, together: Indices) -> list[int]:
    """Store the results of sensors that were judged together; return those at fault."""
    for name in ("offset_s", "sigma_s", "size", "size_sigma"):
        getattr(found, name)[together] = getattr(judged, name)
    newly = []
    for s, cause in zip(together.tolist(), judged.cause, strict=True):
        found.cause[s] = cause
        if cause != SOUND:
            newly.append(s)
    return newly


# Agreement


class Agreement(NamedTuple):
    """How many objects were in each sensor's field, and how many it joined.

    n_in_field : (s,) int
        Objects of at least two other sensors that were in the sensor's field.
    n_joined : (s,) int
        Objects among these with a tracklet of the sensor.
    n_unassigned : (s,) int
        Tracklets of the sensor without an object, or with an object of doubted sensors only: their
        tracklets may agree with each other, but with no other sensor's.
    """

    n_in_field: Indices
    n_joined: Indices
    n_unassigned: Indices

    @property
    def judged(self) -> Flags:
        """(s,) bool: enough objects of the others were in the sensor's field."""
        return np.asarray(self.n_in_field >= MIN_OBJECTS)

    @property
    def doubted(self) -> Flags:
        """(s,) bool: the sensor joins too few objects of the others."""
        few = self.n_joined < MIN_JOINED_SHARE * self.n_in_field
        return np.asarray(few & self.judged)

    def disagreeing(self) -> Indices:
        """Return the sensors that have detections but disagree: they should be excluded."""
        return np.flatnonzero(
            self.doubted & (self.n_unassigned >= MIN_UNASSIGNED * self.n_in_field)
        )


def agreement(samples: Samples, groups: Groups) -> Agreement:
    """Return how many objects of the other sensors each sensor joins."""
    n_sensors, n_groups = len(samples.half_field), len(groups.score)
    n_in_field, n_joined = np.zeros(n_sensors, np.int64), np.zeros(n_sensors, np.int64)
    member, group, instant = _members_at_best(samples, groups)
    n_members = np.zeros((n_groups, n_sensors), np.int64)
    np.add.at(n_members, (group, samples.sensor[member]), 1)
    points = _triangulated(samples, member, group, instant, n_groups)
    half_field = np.array(samples.half_field, float)
    in_field = np.zeros(n_sensors, bool)
    for g in np.flatnonzero(np.isfinite(points[:, 0])).tolist():
        position, attitude = (
            np.ascontiguousarray(values[:, instant[g]])
            for values in (samples.sensor_km, samples.R_sensor_from_icrs)
        )
        seeing(position, attitude, half_field, points[g], in_field)
        others = n_members[g].sum() - n_members[g] >= 2
        n_in_field += others & (in_field | (n_members[g] > 0))
        n_joined += others & (n_members[g] > 0)
    found = Agreement(n_in_field, n_joined, np.zeros(n_sensors, np.int64))
    has_members = n_members.astype(bool)[:, ~found.doubted].any(axis=1)
    unassigned = np.append(~has_members, True)  # the last one is FREE
    n_unassigned = np.bincount(samples.sensor[unassigned[groups.group]], minlength=n_sensors)
    return found._replace(n_unassigned=n_unassigned)


def _members_at_best(samples: Samples, groups: Groups) -> tuple[Indices, Indices, Indices]:
    """Return the members of each group at its best instant, their groups, and these instants.

    The best instant is the first one with most members.
    """
    n_groups = len(groups.score)
    member = np.flatnonzero(groups.group != FREE)
    member = member[np.argsort(groups.group[member], kind="stable")]
    count = np.zeros((n_groups, samples.seen.shape[1]), np.int64)
    np.add.at(count, groups.group[member], samples.seen[member])
    instant = np.argmax(count, axis=1)
    member = member[samples.seen[member, instant[groups.group[member]]]]
    return member, groups.group[member], instant


def _triangulated(
    samples: Samples, member: Indices, group: Indices, instant: Indices, n_groups: int
) -> Array:
    """Return the triangulated points of groups [km], GCRF, (g, 3); NaN where that fails."""
    m = instant[group]
    x, *_ = triangulate(
        np.searchsorted(group, np.arange(n_groups + 1)),
        samples.sensor_km[samples.sensor[member], m],
        samples.u[member, m],
        samples.cov[member, m],
        samples.sigma_km[member, m],
        np.zeros((n_groups, 3)),
        np.inf,
    )
    return x
