"""Clock offsets of sensors, constant over a night, from the residuals of positions.

A frame with a time stamp late by d shows the sky of d earlier: its lines of sight lag by d times
their rate. The objects' positions, a bias of each sensor's position and one of its attitude are
solved together with the offsets, so that none of them is mistaken for an offset.

Most clocks are right. For sensors that look in similar directions, several wrong clocks may have
the effect of another one. So a clock is declared wrong only if that explains the lines far better
than right clocks do, and better than wrong clocks of other sensors.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.geometry.rotations import skew
from epipole.tasks.algorithms.geometry.sky import tangent_basis

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

PRIOR_S = 10.0  # 1-sigma prior of the offset of a wrong clock
SOUND_S = 1e-3  # 1-sigma of the offset of a right clock
SURE = 12.5  # log-odds from which a clock is declared wrong: five sigma
DISTINCT = 5.0  # log-odds from which it is this clock and not another one
FEW = 8  # up to so many sensors, every set of wrong clocks is judged
OUTLIER = 20.0  # chi-square (2 degrees of freedom) of a line that is of another object
ROUNDS = 4  # fits, each with better offsets and without outliers
PER_SENSOR = 7  # offset, bias of position (3), bias of attitude (3)


class Lines(NamedTuple):
    """Lines of sight to objects at common instants.

    group : (n,) int
        Position (object at an epoch) of the line, 0 .. g - 1.
    sensor : (n,) int
        Sensor, 0 .. s - 1.
    u : (n, 3) float
        Measured directions, aberration removed.
    cov : (n, 2, 2) float
        Covariance of their independent errors on `tangent_basis(u)` [rad^2].
    x_km, v_km_s : (n, 3) float
        Solved position and velocity of the object, at the line's time.
    r_km, v_sensor_km_s : (n, 3) float
        Position and velocity of the sensor.
    """

    group: Indices
    sensor: Indices
    u: Array
    cov: Array
    x_km: Array
    v_km_s: Array
    r_km: Array
    v_sensor_km_s: Array


class Offsets(NamedTuple):
    """Clock offsets of sensors: reported minus true time.

    offset_s, sigma_s : (s,) float
        Offset and its 1-sigma error; NaN for a sensor without lines. Clocks that are not `wrong`
        are assumed right, or all unknown where the wrong ones cannot be told. A sigma near
        `PRIOR_S` means that the geometry does not determine the offset.
    wrong : (s,) bool
        The clock is surely wrong.
    """

    offset_s: Array
    sigma_s: Array
    wrong: Flags


def clock_offsets(
    lines: Lines,
    position_sigma_km: Array,
    attitude_sigma_rad: Array,
    guess_s: Array | None = None,
) -> Offsets:
    """Return each sensor's clock offset, reported minus true time.

    Parameters
    ----------
    lines
        Lines of sight, in any order. Groups of one line are skipped.
    position_sigma_km, attitude_sigma_rad : (s,) float
        1-sigma per axis of the biases that a sensor keeps over the night: of its position
        [km], and of its attitude [rad] (0 for attitudes from stars).
    guess_s : (s,) float
        First offsets, needed where they are seconds. Default 0.

    Notes
    -----
    Least squares about the solved positions, which are eliminated group by group (Schur
    complement). The wrong clocks are chosen by the evidence of the linear model. An offset that
    all sensors share shows only in the sensors' motion.
    """
    n_sensors = len(position_sigma_km)
    guess = np.zeros(n_sensors) if guess_s is None else np.array(guess_s, float)
    has_lines = np.bincount(lines.sensor, minlength=n_sensors) > 0
    spread = np.concatenate(
        [
            np.full((n_sensors, 1), PRIOR_S),
            np.repeat(np.maximum(position_sigma_km, 1e-6)[:, None], 3, axis=1),
            np.repeat(np.maximum(attitude_sigma_rad, 1e-12)[:, None], 3, axis=1),
        ],
        axis=1,
    ).ravel()
    kept = np.ones(len(lines.sensor), bool)
    for _ in range(ROUNDS):
        about = _shifted(lines, guess)
        normal, right = _equations(about, kept, spread)
        model = _Model(normal, right, guess / PRIOR_S)
        wrong, distinct = _wrong_clocks(model, np.flatnonzero(has_lines))
        unknowns = model.unknowns(wrong)
        step_s = unknowns[::PER_SENSOR][wrong] * PRIOR_S
        good = _chi2(about, kept, spread, unknowns) < OUTLIER
        guess[wrong] += step_s
        if (good == kept).all() and (np.abs(step_s) < 1e-4).all():
            break
        kept = good
    return _estimates(model, wrong, distinct, has_lines)


class _Model:
    """The normal equations of all sensors' unknowns, in units of their spread.

    The equations are linear about the offsets `guess`, the prior is about offset 0.
    """

    def __init__(self, normal: Array, right: Array, guess: Array) -> None:
        self.guess = guess
        biases = np.arange(len(right)) % PER_SENSOR > 0
        across = normal[np.ix_(biases, ~biases)]
        self._inner = np.linalg.inv(normal[np.ix_(biases, biases)] + np.eye(biases.sum()))
        self._across, self._bias_right = across, right[biases]
        # The equations of the offsets, with the biases eliminated.
        self._normal = normal[np.ix_(~biases, ~biases)] - across.T @ self._inner @ across
        self._right = right[~biases] - across.T @ self._inner @ right[biases]

    def offsets(self, free: Flags) -> tuple[Array, Array]:
        """Return the offsets beyond the guess and their covariance; `free` clocks may be wrong."""
        A, b, _ = self._with_prior(free)
        cov = np.linalg.inv(A)
        return np.asarray(cov @ b), np.asarray(cov)

    def unknowns(self, free: Flags) -> Array:
        """Return the offsets and biases of all sensors; `free` clocks may be wrong."""
        offset, _ = self.offsets(free)
        bias = self._inner @ (self._bias_right - self._across @ offset)
        return np.concatenate([offset[:, None], bias.reshape(len(offset), -1)], axis=1).ravel()

    def evidence(self, free: Flags) -> float:
        """Return the log-probability of the lines if the `free` clocks may be wrong."""
        A, b, constant = self._with_prior(free)
        return float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1]) / 2 + constant

    def _with_prior(self, free: Flags) -> tuple[Array, Array, float]:
        weight = np.where(free, 1.0, (PRIOR_S / SOUND_S) ** 2)
        constant = np.log(weight).sum() - weight @ self.guess**2
        right = self._right - weight * self.guess
        return self._normal + np.diag(weight), right, float(constant) / 2


def _wrong_clocks(model: _Model, sensors: Indices) -> tuple[Flags, bool]:
    """Return the clocks that are surely wrong, and whether only one explanation is good.

    Surely wrong are the clocks that are wrong in the best explanation and in all others that are
    about as good.
    """
    n = len(model.guess)
    score: dict[frozenset[int], float] = {}

    def judge(explanation: frozenset[int]) -> float:
        if explanation not in score:
            free = np.isin(np.arange(n), list(explanation))
            score[explanation] = model.evidence(free) - SURE * len(explanation)
        return score[explanation]

    best = frozenset[int]()
    if len(sensors) <= FEW:
        for k in range(len(sensors) + 1):
            for subset in itertools.combinations(sensors.tolist(), k):
                judge(frozenset(subset))
        best = max(score, key=judge)
    else:
        while True:
            better = max([best, *_beside(best, sensors.tolist())], key=judge)
            if better == best:
                break
            best = better
    good = [names for names, value in score.items() if value > score[best] - DISTINCT]
    wrong = frozenset.intersection(best, *good)
    return np.isin(np.arange(n), list(wrong)), len(good) == 1


def _beside(names: frozenset[int], sensors: list[int]) -> list[frozenset[int]]:
    """Return the sets with one sensor added, removed, or exchanged."""
    others = [s for s in sensors if s not in names]
    more = [names | {s} for s in others]
    less = [names - {s} for s in sorted(names)]
    return [*more, *less, *(fewer | {s} for fewer in less for s in others)]


def _estimates(model: _Model, wrong: Flags, distinct: bool, has_lines: Flags) -> Offsets:
    """Return each sensor's offset, if it and the wrong clocks may be wrong."""
    offset, sigma = np.full(len(wrong), np.nan), np.full(len(wrong), np.nan)
    for s in np.flatnonzero(has_lines):
        free = wrong | (np.arange(len(wrong)) == s) if distinct else np.ones(len(wrong), bool)
        step, cov = model.offsets(free)
        offset[s] = (model.guess[s] + step[s]) * PRIOR_S
        sigma[s] = np.sqrt(cov[s, s]) * PRIOR_S
    return Offsets(offset, sigma, wrong)


def _shifted(lines: Lines, offset_s: Array) -> Lines:
    """Return the lines moved to the reported times, for clocks with these offsets.

    A line shows the object and the sensor where they were `offset_s` earlier.
    """
    d = offset_s[lines.sensor][:, None]
    moved = (lines.v_km_s - lines.v_sensor_km_s) * d
    bent = (_gravity(lines.r_km) - _gravity(lines.x_km)) * d * d / 2
    return lines._replace(r_km=lines.r_km + moved + bent)


def _gravity(r_km: Array) -> Array:
    return -GM_KM3_S2 * r_km / np.linalg.norm(r_km, axis=1, keepdims=True) ** 3


def _equations(lines: Lines, kept: Flags, spread: Array) -> tuple[Array, Array]:
    """Return the normal equations of the sensors' unknowns, in units of their spread."""
    normal, right = np.zeros((len(spread), len(spread))), np.zeros(len(spread))
    for _, columns, wide, e in _groups(lines, kept, spread):
        np.add.at(normal, np.ix_(columns, columns), wide.T @ wide)
        np.add.at(right, columns, wide.T @ e)
    return normal, right


def _chi2(lines: Lines, kept: Flags, spread: Array, unknowns: Array) -> Array:
    """Return the chi-square of each line for solved unknowns; inf for lines left out before."""
    out = np.where(kept, 0.0, np.inf)
    for rows, columns, wide, e in _groups(lines, kept, spread):
        out[rows] = np.sum((e - wide @ unknowns[columns]).reshape(-1, 2) ** 2, axis=1)
    return out


def _groups(
    lines: Lines, kept: Flags, spread: Array
) -> Iterator[tuple[Indices, Indices, Array, Array]]:
    """Yield each position's lines: rows, columns of unknowns, derivatives and residuals.

    The part that the position can absorb is removed: it tells nothing about the sensors.
    """
    to_position, to_sensor, misses = _whitened(lines, spread)
    order = np.argsort(lines.group, kind="stable")
    order = order[kept[order]]
    bounds = np.flatnonzero(np.diff(lines.group[order], prepend=-1, append=-1))
    for lo, hi in itertools.pairwise(bounds):
        rows = order[lo:hi]
        if hi - lo < 2:
            continue
        H, A, e = to_position[rows].reshape(-1, 3), to_sensor[rows], misses[rows].ravel()
        free, _ = np.linalg.qr(H)
        columns = (PER_SENSOR * lines.sensor[rows][:, None] + np.arange(PER_SENSOR)).ravel()
        wide = np.zeros((len(e), len(columns)))
        for k in range(hi - lo):
            wide[2 * k : 2 * k + 2, PER_SENSOR * k : PER_SENSOR * (k + 1)] = A[k]
        yield rows, columns, wide - free @ (free.T @ wide), e - free @ (free.T @ e)


def _whitened(lines: Lines, spread: Array) -> tuple[Array, Array, Array]:
    """Return derivatives by position (n, 2, 3) and by the sensor's unknowns (n, 2, 7), and
    residuals (n, 2), in units of the noise and of the unknowns' spread."""
    basis = tangent_basis(lines.u)
    away = lines.x_km - lines.r_km
    reach = np.linalg.norm(away, axis=1)
    predicted = away / reach[:, None]
    root = np.linalg.inv(np.linalg.cholesky(lines.cov))
    by_place = root @ basis / reach[:, None, None]
    rate = np.einsum("nij,nj->ni", by_place, lines.v_km_s - lines.v_sensor_km_s)
    by_turn = root @ basis @ -skew(lines.u)
    by_sensor = np.concatenate([-rate[:, :, None], by_place, by_turn], axis=2)
    per_line = spread.reshape(-1, PER_SENSOR)[lines.sensor]
    misses = np.einsum("nij,nj->ni", root @ basis, lines.u - predicted)
    return by_place, by_sensor * per_line[:, None, :], misses
