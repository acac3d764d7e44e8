"""Faults of sensors, constant over a night, from the residuals of triangulated positions.

If a frame's time stamp is late by d, its lines of sight lag by d times their rate. A wrong
ephemeris shifts the lines, a wrong attitude turns them all alike. The positions of the objects and,
for each sensor, a clock offset, a bias of its position and a bias of its attitude are solved
together.

Clock errors of sensors that look the same way cannot be separated, and a wrong ephemeris or
attitude may look like a wrong clock. So sets of faults of all sensors are compared by their
evidence, with a penalty for each fault: most sensors are sound. A fault is declared if it is in all
of the best sets. If these agree on the sensor but not on the kind of its fault, the sensor
disagrees. If they differ in the sensor too, all suspects disagree, as long as the sound sensors
outnumber them. Otherwise no sensor is named (`Doubt`).

An offset that all clocks share counts as one fault. It moves all sensors along their orbits.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.earth_gravity import gravity
from epipole.tasks.algorithms.geometry.directions import skew, tangent_basis

PRIOR_S = 10.0  # 1-sigma prior of a wrong clock's offset
SOUND_S = 1e-3  # 1-sigma prior of a right clock's offset
FAULT_KM = 10.0  # 1-sigma prior of a wrong ephemeris, per axis
FAULT_RAD = 600 * ARCSEC  # 1-sigma prior of a wrong attitude, per axis
MIN_LOG_ODDS = 12.5  # minimum log odds of a fault: five sigma
CLOCK_PRIOR_LOG_ODDS = 5.0  # prior log odds of a wrong clock against another fault
DISTINCT_LOG_ODDS = 5.0  # minimum log odds of a set of faults against another set
MAX_SETS = 2200  # maximum number of sets that are all compared; with more, a stepwise search
LEAST_AGREEING = 3  # sensors that have to agree where others do not
OUTLIER_CHI2 = 20.0  # largest chi-square (2 degrees of freedom) of a line of the object
ITERATIONS = 4  # of the fit, each about the last offsets and without outliers
# Minimum number of objects from which anything is concluded about a sensor: of those that agree on
# an offset of its clock, and of those in its field. With 1 or 6 the same offsets are found in the
# tests: there the false-alarm probability decides.
MIN_OBJECTS = 3
PER_SENSOR = 7  # offset, bias of position (3), bias of attitude (3)
SOUND, CLOCK, EPHEMERIS, ATTITUDE, DISAGREES = "", "clock", "ephemeris", "attitude", "disagrees"
ALL, SHARED = -1, "shared clock"  # the fault of all clocks together
# Errors of ephemerides that are tried for all sensors alike, per axis [km].
SPREADS_KM = np.geomspace(0.01, 30.0, 25)
COLUMNS = {CLOCK: slice(0, 1), EPHEMERIS: slice(1, 4), ATTITUDE: slice(4, 7)}

Faults = frozenset[tuple[int, str]]  # a sensor and its fault


class Lines(NamedTuple):
    """Lines of sight to objects at common instants.

    group : (n,) int
        Position (object at an epoch) of the line, 0 .. g - 1.
    sensor : (n,) int
        Sensor, 0 .. s - 1; -1 for a line of a sensor that is assumed sound, whose biases are a
        part of `cov`.
    u : (n, 3) float
        Measured directions, aberration removed.
    cov : (n, 2, 2) float
        Covariance on `tangent_basis(u)` [rad^2]: the independent errors, plus n times each error
        that only n of the sensor's lines share.
    x_km, v_km_s : (n, 3) float
        Solved position and velocity of the object at the line's time, GCRF.
    r_km, v_sensor_km_s : (n, 3) float
        Position and velocity of the sensor, GCRF.
    """

    group: Indices
    sensor: Indices
    u: Array
    cov: Array
    x_km: Array
    v_km_s: Array
    r_km: Array
    v_sensor_km_s: Array


class Doubt(NamedTuple):
    """Faults that cannot be assigned to a sensor.

    undecided : bool
        Some sensors are at fault, and several sets of them explain the lines as well.
    spread_km, spread_log_odds : float
        1-sigma error of the ephemerides per axis, if all sensors have the same, and its log odds
        against the stated errors; 0 if any fault is declared.
    shared_s, shared_sigma_s : float
        The offset that all clocks share against the states, and its 1-sigma error. NaN if no such
        offset is declared.
    """

    undecided: bool = False
    spread_km: float = 0.0
    spread_log_odds: float = 0.0
    shared_s: float = np.nan
    shared_sigma_s: float = np.nan


class JudgedSensors(NamedTuple):
    """Clock offsets of sensors (reported minus true time), and their faults.

    offset_s, sigma_s : (s,) float
        Offset and its 1-sigma error; NaN for a sensor without lines. The other clocks are assumed
        right unless declared wrong. If the faults cannot be separated, all clocks are free. A sigma
        near `PRIOR_S` means that the geometry does not determine the offset.
    cause : (s,) of str
        The declared fault: `CLOCK`, `EPHEMERIS` or `ATTITUDE`; `DISAGREES` if its kind is unknown;
        `SOUND` without a fault.
    size, size_sigma : (s,) float
        Size of a wrong ephemeris [km] or attitude [rad], and its 1-sigma error; else 0.
    bias, bias_sigma : (s, 3), (s,) float
        A wrong ephemeris [km] or attitude [rad] (a rotation vector, GCRF), reported minus true, and
        its 1-sigma error per axis across the sensor's lines of sight; else 0.
    doubt
        What is wrong without a name.
    """

    offset_s: Array
    sigma_s: Array
    cause: list[str]
    size: Array
    size_sigma: Array
    bias: Array
    bias_sigma: Array
    doubt: Doubt = Doubt()

    @property
    def wrong(self) -> Flags:
        """(s,) bool: the clock is declared wrong."""
        return np.array([cause == CLOCK for cause in self.cause], bool)


def judge_sensors(
    lines: Lines,
    position_sigma_km: Array,
    attitude_sigma_rad: Array,
    guess_s: Array | None = None,
    n_others: int = 0,
) -> JudgedSensors:
    """Return each sensor's clock offset and fault.

    Parameters
    ----------
    lines
        Lines of sight, in any order. Groups of one line are skipped.
    position_sigma_km, attitude_sigma_rad : (s,) float
        1-sigma per axis of the biases that a sensor keeps over the night: of its position
        [km], and of its attitude [rad] (0 for attitudes from stars with right optics, which are
        never at fault).
    guess_s : (s,) float
        Initial clock offsets; needed if one is seconds. Default 0.
    n_others : int
        Number of further sensors, assumed sound: their lines have the sensor -1.

    Notes
    -----
    Least squares about the solved positions, which are eliminated group by group (Schur
    complement). The faults are chosen by the evidence of the linear model. An offset that all
    sensors share shows only in the sensors' motion.
    """
    n_sensors = len(position_sigma_km)
    guess = np.zeros(n_sensors) if guess_s is None else np.array(guess_s, float)
    has_lines = np.bincount(lines.sensor[lines.sensor >= 0], minlength=n_sensors) > 0
    prior_sigma = prior_sigmas(position_sigma_km, attitude_sigma_rad)
    kept = np.ones(len(lines.sensor), bool)
    for _ in range(ITERATIONS):
        about = shift_lines(lines, guess)
        normal, right = _equations(about, kept, prior_sigma)
        model = Model(normal, right, guess / PRIOR_S, prior_sigma)
        explained = _explain(
            model,
            np.flatnonzero(has_lines),
            attitude_sigma_rad > 0,
            n_others,
        )
        wrong = np.array([(s, CLOCK) in explained.faults for s in range(n_sensors)], bool)
        wrong |= (ALL, SHARED) in explained.faults
        unknowns = model.estimate(explained.faults)[0]
        step_s = unknowns[::PER_SENSOR][wrong] * PRIOR_S
        # The lines of faults that are not sure are no outliers: they would hide these.
        explaining = model.estimate(explained.best)[0]
        good = _chi2(about, kept, prior_sigma, explaining) < OUTLIER_CHI2
        guess[wrong] += step_s
        if (good == kept).all() and (np.abs(step_s) < 1e-4).all():
            break
        kept = good
    judged = _judged(model, explained, has_lines, _across(lines, n_sensors))
    return judged._replace(doubt=_doubt(model, explained, has_lines))


def prior_sigmas(position_sigma_km: Array, attitude_sigma_rad: Array) -> Array:
    """Return the prior 1-sigma of all unknowns [s, km, rad], sensor by sensor: (7 s,)."""
    return np.concatenate(
        [
            np.full((len(position_sigma_km), 1), PRIOR_S),
            np.repeat(np.maximum(position_sigma_km, 1e-6)[:, None], 3, axis=1),
            np.repeat(np.maximum(attitude_sigma_rad, 1e-9)[:, None], 3, axis=1),
        ],
        axis=1,
    ).ravel()


class Model:
    """The normal equations of all sensors' unknowns, in units of their prior sigma.

    The equations are linear about the offsets `guess`, the prior is about offset 0.
    """

    def __init__(self, normal: Array, right: Array, guess: Array, prior_sigma: Array) -> None:
        self.normal, self.right, self.prior_sigma = (
            normal,
            right,
            prior_sigma.reshape(-1, PER_SENSOR),
        )
        self.guess = np.zeros_like(self.prior_sigma)
        self.guess[:, 0] = guess

    def estimate(self, faults: Faults) -> tuple[Array, Array]:
        """Return the unknowns minus the guess, and their covariance, with these faults allowed."""
        A, b, _ = self._with_prior(faults)
        cov = np.linalg.inv(A)
        return np.asarray(cov @ b), np.asarray(cov)

    def evidence(self, faults: Faults) -> float:
        """Return the log evidence of these faults: ln p(lines | faults) and a constant."""
        A, b, constant = self._with_prior(faults)
        return float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1]) / 2 + constant

    def spread(self) -> tuple[float, float]:
        """Return the likeliest 1-sigma error of all ephemerides, per axis [km], and its log odds.

        They are against the errors that the sensors state.
        """
        evidence = []
        for spread_km in SPREADS_KM:
            weight = self._weights(frozenset())
            columns = COLUMNS[EPHEMERIS]
            weight[:, columns] = np.minimum((self.prior_sigma[:, columns] / spread_km) ** 2, 1.0)
            A, b = self.normal + np.diag(weight.ravel()), self.right - (weight * self.guess).ravel()
            fit = float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1])
            evidence.append(fit + float(np.log(weight).sum() - np.sum(weight * self.guess**2)))
        best = int(np.argmax(evidence))
        return float(SPREADS_KM[best]), evidence[best] / 2 - self.evidence(frozenset())

    def bias(self, sensor: int, cause: str, faults: Faults) -> tuple[Array, Array]:
        """Return a wrong ephemeris [km] or attitude [rad], (3,), and its covariance (3, 3)."""
        x, cov = self.estimate(faults)
        columns = np.arange(PER_SENSOR)[COLUMNS[cause]] + PER_SENSOR * sensor
        unit = self.prior_sigma.ravel()[columns]
        return x[columns] * unit, cov[np.ix_(columns, columns)] * np.outer(unit, unit)

    def _with_prior(self, faults: Faults) -> tuple[Array, Array, float]:
        weight = self._weights(faults)
        pull = weight * self.guess
        constant = np.log(weight).sum()
        prior = np.diag(weight.ravel())
        if (ALL, SHARED) in faults:
            # One error more, that all clocks share: by the formula of Sherman and Morrison.
            clocks, total = weight[:, 0], 1.0 + weight[:, 0].sum()
            pull[:, 0] -= clocks * pull[:, 0].sum() / total
            prior[::PER_SENSOR, ::PER_SENSOR] -= np.outer(clocks, clocks) / total
            constant -= np.log(total)
        constant -= np.sum(pull * self.guess)
        return self.normal + prior, self.right - pull.ravel(), float(constant) / 2

    def _weights(self, faults: Faults) -> Array:
        """Return the inverse prior variances of the unknowns, without a shared offset."""
        weight = np.ones_like(self.prior_sigma)
        weight[:, 0] = (PRIOR_S / SOUND_S) ** 2
        for s, cause in faults - {(ALL, SHARED)}:
            usual = {CLOCK: PRIOR_S, EPHEMERIS: FAULT_KM, ATTITUDE: FAULT_RAD}[cause]
            weight[s, COLUMNS[cause]] = (self.prior_sigma[s, COLUMNS[cause]] / usual) ** 2
        return weight


class _Explanation(NamedTuple):
    """Declared faults, sensors with a fault of unknown kind, and whether the best set is distinct.

    It is distinct if no other set of faults has nearly the same score. It is `undecided` who is at
    fault if sensors of the `best` set are not in all of these, and few others are left.
    """

    faults: Faults
    disagreeing: list[int]
    distinct: bool
    undecided: bool
    best: Faults


def _explain(
    model: Model, sensors: Indices, has_prior_attitude: Flags, n_others: int
) -> _Explanation:
    """Return the faults that are in the best set and in all sets of nearly the same score.

    The score is the log evidence minus a penalty for each fault. An attitude can be wrong only
    where `has_prior_attitude`. Clocks can share an offset only if there are no others.
    """
    score: dict[Faults, float] = {}
    kinds = [
        [(s, kind) for kind in COLUMNS if kind != ATTITUDE or has_prior_attitude[s]]
        for s in sensors.tolist()
    ]
    if not n_others:
        kinds.append([(ALL, SHARED)])

    def judge(faults: Faults) -> float:
        if faults not in score:
            rarer = sum(kind not in (CLOCK, SHARED) for _, kind in faults)
            score[faults] = (
                model.evidence(faults) - MIN_LOG_ODDS * len(faults) - CLOCK_PRIOR_LOG_ODDS * rarer
            )
        return score[faults]

    best: Faults = frozenset()
    judge(best)
    if math.prod(1 + len(of_sensor) for of_sensor in kinds) <= MAX_SETS:
        for chosen in itertools.product(*([None, *of_sensor] for of_sensor in kinds)):
            judge(frozenset(fault for fault in chosen if fault is not None))
        best = max(score, key=judge)
    else:
        best = _best_stepwise(judge, score, kinds)
    good = [faults for faults, value in score.items() if value > score[best] - DISTINCT_LOG_ODDS]
    return _conclude(best, good, len(sensors) + n_others)


def _conclude(best: Faults, good: list[Faults], n_sensors: int) -> _Explanation:
    """Return what the best set of faults and those of nearly the same score have in common."""
    sure = best.intersection(*good)
    sets = [{s for s, _ in faults} for faults in good]
    at_fault = {s for s, _ in best}.intersection(*sets)
    disputed = set().union(*sets) - at_fault
    unsure = {s for s, _ in best} != at_fault
    wrong = at_fault | disputed if unsure else at_fault
    few_left = n_sensors - len(wrong) < max(len(wrong) + 1, LEAST_AGREEING)
    undecided = unsure and (few_left or ALL in disputed)
    disagreeing = sorted((at_fault if undecided else wrong) - {s for s, _ in sure} - {ALL})
    return _Explanation(sure, disagreeing, len(good) == 1, undecided, best)


def _best_stepwise(
    judge: Callable[[Faults], float], score: dict[Faults, float], kinds: list[list[tuple[int, str]]]
) -> Faults:
    """Return the best set of faults of those that a stepwise search finds; `judge` enters them in
    `score`.

    Other sensors may explain the lines as well: half of some that see no others may be wrong,
    either half. No step leads from one half to the other. So for each sensor of the best set, the
    best set without a fault of that sensor is searched too.
    """
    best: Faults = frozenset()
    while True:
        best = _climb(judge, best, partial(_neighbouring_sets, kinds=kinds))
        for sensor in sorted({s for s, _ in best}):
            others = [of_sensor for of_sensor in kinds if of_sensor[0][0] != sensor]
            rest = frozenset(fault for fault in best if fault[0] != sensor)
            _climb(judge, rest, partial(_one_more_or_less, kinds=others))
        better = max(score, key=judge)
        if judge(better) <= judge(best):
            return best
        best = better


def _climb(
    judge: Callable[[Faults], float], start: Faults, next_to: Callable[[Faults], list[Faults]]
) -> Faults:
    """Return the set that a search from `start` ends at: each step goes to the best set next."""
    best = start
    while True:
        better = max([best, *next_to(best)], key=judge)
        if better == best:
            return best
        best = better


def _one_more_or_less(faults: Faults, kinds: list[list[tuple[int, str]]]) -> list[Faults]:
    """Return the sets with one fault added or removed; at most one fault per sensor."""
    sensors = {s for s, _ in faults}
    possible = [fault for of_sensor in kinds for fault in of_sensor]
    more = [faults | {fault} for fault in possible if fault[0] not in sensors]
    return [*more, *(faults - {fault} for fault in sorted(faults))]


def _neighbouring_sets(faults: Faults, kinds: list[list[tuple[int, str]]]) -> list[Faults]:
    """Return the sets with one fault added, removed or exchanged; at most one fault per sensor."""
    possible = [fault for of_sensor in kinds for fault in of_sensor]
    less = [faults - {fault} for fault in sorted(faults)]
    exchanged = [
        fewer | {fault}
        for fewer in less
        for fault in possible
        if fault not in faults and fault[0] not in {s for s, _ in fewer}
    ]
    return [*_one_more_or_less(faults, kinds), *exchanged]


def _across(lines: Lines, n_sensors: int) -> Array:
    """Return the mean projection on the planes across each sensor's lines of sight: (s, 3, 3)."""
    mine = lines.sensor >= 0
    u, sensor = lines.u[mine], lines.sensor[mine]
    total = np.zeros((n_sensors, 3, 3))
    np.add.at(total, sensor, np.eye(3) - np.einsum("ni,nj->nij", u, u))
    count = np.bincount(sensor, minlength=n_sensors)
    return total / np.maximum(count, 1)[:, None, None]


def _judged(
    model: Model, explained: _Explanation, has_lines: Flags, across: Array
) -> JudgedSensors:
    """Return each sensor's offset, with its clock and the declared faults free, and its fault.

    `across` is that of `_across`: a bias along the lines of sight does not show, nor matter.
    """
    n = len(has_lines)
    faults = explained.faults
    shared = faults & {(ALL, SHARED)}
    offset, sigma = np.full(n, np.nan), np.full(n, np.nan)
    size, size_sigma = np.zeros(n), np.zeros(n)
    bias, bias_sigma = np.zeros((n, 3)), np.zeros(n)
    cause = [SOUND] * n
    all_clocks = frozenset((s, CLOCK) for s in range(n))
    for s in np.flatnonzero(has_lines).tolist():
        may_be = faults | {(s, CLOCK)} if explained.distinct else faults | all_clocks
        step, cov = model.estimate(may_be)
        at = PER_SENSOR * s
        offset[s] = (model.guess[s, 0] + step[at]) * PRIOR_S
        sigma[s] = np.sqrt(cov[at, at]) * PRIOR_S
    for s, kind in faults - shared:
        cause[s] = kind
        if kind != CLOCK:
            bias[s], cov = model.bias(s, kind, faults)
            size[s] = np.linalg.norm(bias[s])
            along = bias[s] / max(size[s], 1e-300)
            size_sigma[s] = np.sqrt(along @ cov @ along)
            bias_sigma[s] = np.sqrt(np.trace(across[s] @ cov) / 2)
    for s in explained.disagreeing:
        cause[s] = DISAGREES
    return JudgedSensors(offset, sigma, cause, size, size_sigma, bias, bias_sigma)


def _doubt(model: Model, explained: _Explanation, has_lines: Flags) -> Doubt:
    """Return what is wrong without a name."""
    spread_km, log_odds = model.spread()
    unnamed = not (explained.faults or explained.disagreeing)
    found = Doubt(explained.undecided, spread_km, log_odds if unnamed else 0.0)
    if (ALL, SHARED) not in explained.faults:
        return found
    if explained.disagreeing or any(kind not in (CLOCK, SHARED) for _, kind in explained.faults):
        # Two errors of ephemerides may look like one and a shared offset.
        return found._replace(undecided=True)
    step, cov = model.estimate(explained.faults)
    clocks = PER_SENSOR * np.flatnonzero(has_lines)
    shared = model.guess[has_lines, 0] + step[clocks]
    middle = int(np.argmin(np.diag(cov)[clocks]))
    sigma = float(np.sqrt(cov[clocks[middle], clocks[middle]]))
    return found._replace(shared_s=float(shared[middle]) * PRIOR_S, shared_sigma_s=sigma * PRIOR_S)


def shift_lines(lines: Lines, offset_s: Array) -> Lines:
    """Return the lines corrected for clock offsets, (s,).

    A line was measured `offset_s` before its time stamp. Only the relative position counts, so the
    sensor alone is moved (`r_km`).
    """
    d = np.append(offset_s, 0.0)[lines.sensor][:, None]
    moved = (lines.v_km_s - lines.v_sensor_km_s) * d
    fall = (gravity(lines.r_km) - gravity(lines.x_km)) * d * d / 2
    return lines._replace(r_km=lines.r_km + moved + fall)


def _equations(lines: Lines, kept: Flags, prior_sigma: Array) -> tuple[Array, Array]:
    """Return the normal equations of the sensors' unknowns, in units of their prior sigma."""
    normal, right = np.zeros((len(prior_sigma), len(prior_sigma))), np.zeros(len(prior_sigma))
    for _, columns, jacobian, e in _groups(lines, kept, prior_sigma):
        # A sensor has one line in a group, as a rule: its columns come once.
        if len(np.unique(columns)) == len(columns):
            normal[np.ix_(columns, columns)] += jacobian.T @ jacobian
            right[columns] += jacobian.T @ e
        else:
            np.add.at(normal, np.ix_(columns, columns), jacobian.T @ jacobian)
            np.add.at(right, columns, jacobian.T @ e)
    return normal, right


def _chi2(lines: Lines, kept: Flags, prior_sigma: Array, unknowns: Array) -> Array:
    """Return the chi-square of each line for solved unknowns; inf for rejected lines."""
    out = np.where(kept, 0.0, np.inf)
    for rows, columns, jacobian, e in _groups(lines, kept, prior_sigma):
        out[rows] = np.sum((e - jacobian @ unknowns[columns]).reshape(-1, 2) ** 2, axis=1)
    return out


def _groups(
    lines: Lines, kept: Flags, prior_sigma: Array
) -> Iterator[tuple[Indices, Indices, Array, Array]]:
    """Yield each position's lines: rows, columns of unknowns, derivatives and residuals.

    Derivatives by the position are projected out: what a shift of the position explains has no
    information about the sensors.
    """
    to_position, to_sensor, residuals = whitened(lines, prior_sigma)
    order = np.argsort(lines.group, kind="stable")
    order = order[kept[order]]
    bounds = np.flatnonzero(np.diff(lines.group[order], prepend=-1, append=-1))
    for lo, hi in itertools.pairwise(bounds):
        rows = order[lo:hi]
        if hi - lo < 2:
            continue
        judged = np.flatnonzero(lines.sensor[rows] >= 0)
        if not len(judged):
            continue
        H, A, e = to_position[rows].reshape(-1, 3), to_sensor[rows], residuals[rows].ravel()
        free, _ = np.linalg.qr(H)
        sensor = lines.sensor[rows[judged]]
        columns = (PER_SENSOR * sensor[:, None] + np.arange(PER_SENSOR)).ravel()
        jacobian = np.zeros((len(e), len(columns)))
        for k, row in enumerate(judged.tolist()):
            jacobian[2 * row : 2 * row + 2, PER_SENSOR * k : PER_SENSOR * (k + 1)] = A[row]
        yield rows, columns, jacobian - free @ (free.T @ jacobian), e - free @ (free.T @ e)


def whitened(lines: Lines, prior_sigma: Array) -> tuple[Array, Array, Array]:
    """Return the derivatives of lines by position and by the sensor's unknowns, and residuals.

    (n, 2, 3), (n, 2, 7) and (n, 2), in units of the noise and of the unknowns' prior sigma.
    """
    basis = tangent_basis(lines.u)
    away = lines.x_km - lines.r_km
    reach = np.linalg.norm(away, axis=1)
    predicted = away / reach[:, None]
    root = np.linalg.inv(np.linalg.cholesky(lines.cov))
    by_position = root @ basis / reach[:, None, None]
    rate = np.einsum("nij,nj->ni", by_position, lines.v_km_s - lines.v_sensor_km_s)
    by_turn = root @ basis @ -skew(lines.u)
    by_sensor = np.concatenate([-rate[:, :, None], by_position, by_turn], axis=2)
    per_line = np.vstack([prior_sigma.reshape(-1, PER_SENSOR), np.ones(PER_SENSOR)])[lines.sensor]
    residuals = np.einsum("nij,nj->ni", root @ basis, lines.u - predicted)
    return by_position, by_sensor * per_line[:, None, :], residuals
