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
from epipole.tasks.algorithms.association.odds import MAX_RANGE_RATIO, seeing
from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.geometry.triangulation import Triangulated, triangulate
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
NEAR_SIGMA = 5.0  # nearer to an object than this a tracklet may be of it
LIGHT_TIME_RAD = 8.0 / SPEED_OF_LIGHT_KM_S  # angle that a low object moves while its light comes
# An object counts as missed if it is brighter by this than the faintest that the sensor shows: seen
# from two sides it may differ by a magnitude.
BRIGHTER_MAG = 1.0


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
        offset_s=np.full(n, np.nan),
        sigma_s=np.full(n, np.nan),
        cause=[SOUND] * n,
        size=np.zeros(n),
        size_sigma=np.zeros(n),
        bias=np.zeros((n, 3)),
        bias_sigma=np.zeros(n),
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
    for name in ("offset_s", "sigma_s", "size", "size_sigma", "bias", "bias_sigma"):
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
        Objects of at least two other sensors that were in the sensor's field, bright enough for it.
    n_joined : (s,) int
        Objects among these with a tracklet of the sensor, or with an undecided one so near that it
        may be of the object: then the sensor does not disagree.
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
    bright = _bright_enough(samples, member, group, instant, points.r_km)
    in_field, missed = np.zeros(n_sensors, bool), np.zeros((n_groups, n_sensors), bool)
    for g in np.flatnonzero(np.isfinite(points.r_km[:, 0])).tolist():
        position, attitude = (
            np.ascontiguousarray(values[:, instant[g]])
            for values in (samples.sensor_km, samples.R_sensor_from_icrs)
        )
        seeing(position, attitude, half_field, points.r_km[g], in_field)
        others = n_members[g].sum() - n_members[g] >= 2
        joined = n_members[g] > 0
        missed[g] = others & in_field & ~joined & bright[g]
        n_in_field += missed[g] | (others & joined)
        n_joined += others & joined
    found = Agreement(n_in_field, n_joined, np.zeros(n_sensors, np.int64))
    unclear = groups.undecided | groups.ambiguous
    for sensor in np.flatnonzero(found.doubted).tolist():
        for g in np.flatnonzero(missed[:, sensor]).tolist():
            at = points.r_km[g], points.cov_km2[g]
            n_joined[sensor] += _has_near(samples, unclear, sensor, instant[g], *at)
    has_members = n_members.astype(bool)[:, ~found.doubted].any(axis=1)
    unassigned = np.append(~has_members, True)  # the last one is FREE
    n_unassigned = np.bincount(samples.sensor[unassigned[groups.group]], minlength=n_sensors)
    return found._replace(n_unassigned=n_unassigned)


def _bright_enough(
    samples: Samples, member: Indices, group: Indices, instant: Indices, x_km: Array
) -> Flags:
    """Return whether a sensor that has objects in its field should detect them: (g, s).

    By the magnitudes of the members, and the faintest that the sensor shows; where these are
    unknown, by the ranges.
    """
    toward = x_km[:, None] - samples.sensor_km[:, instant].transpose(1, 0, 2)
    range_km = np.linalg.norm(toward, axis=2)
    of_member = range_km[group, samples.sensor[member]]
    nearest = np.full(len(x_km), np.inf)
    np.fmin.at(nearest, group, of_member)
    bright = range_km < MAX_RANGE_RATIO * nearest[:, None]
    if samples.magnitude is None:
        return bright
    faintest = np.full(range_km.shape[1], -np.inf)
    np.fmax.at(faintest, samples.sensor, samples.magnitude)
    reduced = samples.magnitude[member] - 5.0 * np.log10(of_member)
    known = np.isfinite(reduced)
    count = np.bincount(group[known], minlength=len(x_km))
    mean = np.bincount(group[known], reduced[known], len(x_km)) / np.maximum(count, 1)
    expected = mean[:, None] + 5.0 * np.log10(range_km)
    judged = (count > 0)[:, None] & np.isfinite(faintest)
    return np.where(judged, expected < faintest - BRIGHTER_MAG, bright)


def _has_near(
    samples: Samples, unclear: Flags, sensor: int, m: int, x_km: Array, cov_km2: Array
) -> bool:
    """Return whether a sensor has a tracklet at instant m that may be of the object there.

    `x_km` (3,) and `cov_km2` (3, 3) are the object's position [km], GCRF, and its covariance. Only
    `unclear` tracklets, (t,) bool, count: they fit some object, with too little evidence.
    """
    rows = np.flatnonzero((samples.sensor == sensor) & samples.seen[:, m] & unclear)
    toward = x_km - samples.sensor_km[sensor, m]
    range_km = np.linalg.norm(toward)
    u = samples.u[rows, m]
    basis = tangent_basis(u)
    off = basis @ (toward / range_km)
    position = cov_km2 + samples.sigma_km[rows, m][:, None, None] ** 2 * np.eye(3)
    cov = samples.cov[rows, m] + basis @ position @ basis.transpose(0, 2, 1) / range_km**2
    cov = cov + LIGHT_TIME_RAD**2 * np.eye(2)
    chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(cov, off[:, :, None])[:, :, 0])
    return bool(((chi2 < NEAR_SIGMA**2) & (u @ toward > 0.0)).any())


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
) -> Triangulated:
    """Return the triangulated points of groups; NaN where that fails."""
    m = instant[group]
    return triangulate(
        np.searchsorted(group, np.arange(n_groups + 1)),
        samples.sensor_km[samples.sensor[member], m],
        samples.u[member, m],
        samples.cov[member, m],
        samples.sigma_km[member, m],
        np.zeros((n_groups, 3)),
        np.inf,
    )
