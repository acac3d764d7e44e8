"""Clock offsets of sensors, constant over a night, from the residuals of positions.

A frame stamped late by d shows what stood there d before: the line of sight lags behind by d
times its rate. The objects' positions, a bias of each sensor's own position and one of its
attitude are solved with the offsets, so that none of these is taken for a clock.

Most clocks are right. Of sensors that look one way, several wrong clocks together may look like
another's; so a clock is taken for wrong only where that explains the lines far better than right
clocks do, and better than other sensors' wrong ones.
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

PRIOR_S = 10.0  # 1-sigma of the offset of a wrong clock before anything is known
SOUND_S = 1e-3  # of a right one
SURE = 12.5  # log of the odds that it takes to believe a clock wrong: five sigma
DISTINCT = 5.0  # and that it is this one rather than another
FEW = 8  # sensors: of so many every set of wrong clocks is judged
OUTLIER = 20.0  # chi-square of a line, of 2 degrees of freedom: it is of another object
ROUNDS = 4  # of fits about better offsets, without outliers
PER_SENSOR = 7  # offset, bias of position (3), bias of attitude (3)


class Lines(NamedTuple):
    """Lines of sight to objects at common instants.

    group : (n,) int
        Position that the line belongs to, 0 .. g - 1.
    sensor : (n,) int
        Sensor, 0 .. s - 1.
    u : (n, 3) float
        Measured directions, aberration removed.
    cov : (n, 2, 2) float
        Their errors that are new each time, on `tangent_basis(u)` [rad^2].
    x_km, v_km_s : (n, 3) float
        Position and velocity of the line's object as they were solved, at the line's time.
    r_km, v_sensor_km_s : (n, 3) float
        The same of its sensor.
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
        Offset and its 1-sigma error, the clocks that are not `wrong` taken as right (or all as
        unknown, where it cannot be told whose is wrong); NaN for a sensor without lines. A sigma
        near `PRIOR_S`: the geometry shows nothing.
    wrong : (s,) bool
        The clock is surely off.
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
        Lines of sight, in any order; groups of one line say nothing.
    position_sigma_km, attitude_sigma_rad : (s,) float
        1-sigma an axis of the biases that a sensor keeps over the night: of its position
        [km], and of its attitude [rad] (0 where stars give it).
    guess_s : (s,) float
        Offsets to begin with, where they are seconds; none: 0.

    Notes
    -----
    Least squares about the solved positions, those eliminated group by group (Schur complement);
    which clocks are wrong by the evidence of the linear model. What all sensors share shows only
    by their own motion.
    """
    n_sensors = len(position_sigma_km)
    guess = np.zeros(n_sensors) if guess_s is None else np.array(guess_s, float)
    seen = np.bincount(lines.sensor, minlength=n_sensors) > 0
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
        about = _carried(lines, guess)
        normal, right = _equations(about, kept, spread)
        model = _Model(normal, right, guess / PRIOR_S)
        wrong, distinct = _wrong_clocks(model, np.flatnonzero(seen))
        found = model.unknowns(wrong)
        good = _chi2(about, kept, spread, found) < OUTLIER
        guess[wrong] += found[::PER_SENSOR][wrong] * PRIOR_S
        if (good == kept).all() and (np.abs(found[::PER_SENSOR][wrong]) * PRIOR_S < 1e-4).all():
            break
        kept = good
    return _estimates(model, wrong, distinct, seen)


class _Model:
    """The normal equations of all sensors' unknowns, in units of their spread.

    A guess stands for the offsets that the equations are about; the prior is about none.
    """

    def __init__(self, normal: Array, right: Array, guess: Array) -> None:
        self.guess = guess
        biases = np.arange(len(right)) % PER_SENSOR > 0
        across = normal[np.ix_(biases, ~biases)]
        self._inner = np.linalg.inv(normal[np.ix_(biases, biases)] + np.eye(biases.sum()))
        self._across, self._bias_right = across, right[biases]
        # What is left for the offsets once the biases are solved for.
        self._normal = normal[np.ix_(~biases, ~biases)] - across.T @ self._inner @ across
        self._right = right[~biases] - across.T @ self._inner @ right[biases]

    def offsets(self, free: Flags) -> tuple[Array, Array]:
        """Return the offsets beyond the guess and their covariance where these may be off."""
        A, b, _ = self._with_prior(free)
        cov = np.linalg.inv(A)
        return np.asarray(cov @ b), np.asarray(cov)

    def unknowns(self, free: Flags) -> Array:
        """Return the unknowns of all sensors."""
        offset, _ = self.offsets(free)
        bias = self._inner @ (self._bias_right - self._across @ offset)
        return np.concatenate([offset[:, None], bias.reshape(len(offset), -1)], axis=1).ravel()

    def evidence(self, free: Flags) -> float:
        """Return the log of the probability of the lines where these clocks may be off."""
        A, b, constant = self._with_prior(free)
        return float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1]) / 2 + constant

    def _with_prior(self, free: Flags) -> tuple[Array, Array, float]:
        weight = np.where(free, 1.0, (PRIOR_S / SOUND_S) ** 2)
        constant = np.log(weight).sum() - weight @ self.guess**2
        right = self._right - weight * self.guess
        return self._normal + np.diag(weight), right, float(constant) / 2


def _wrong_clocks(model: _Model, sensors: Indices) -> tuple[Flags, bool]:
    """Return the clocks that are surely wrong, and whether it can be told which are.

    Surely wrong are those that are so in every explanation about as good as the best.
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
            for some in itertools.combinations(sensors.tolist(), k):
                judge(frozenset(some))
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
    """Return the sets with one sensor more, less, or another instead."""
    others = [s for s in sensors if s not in names]
    more = [names | {s} for s in others]
    less = [names - {s} for s in sorted(names)]
    return [*more, *less, *(fewer | {s} for fewer in less for s in others)]


def _estimates(model: _Model, wrong: Flags, distinct: bool, seen: Flags) -> Offsets:
    """Return each sensor's offset where it, and those that are wrong, may be off."""
    offset, sigma = np.full(len(wrong), np.nan), np.full(len(wrong), np.nan)
    for s in np.flatnonzero(seen):
        free = wrong | (np.arange(len(wrong)) == s) if distinct else np.ones(len(wrong), bool)
        found, cov = model.offsets(free)
        offset[s] = (model.guess[s] + found[s]) * PRIOR_S
        sigma[s] = np.sqrt(cov[s, s]) * PRIOR_S
    return Offsets(offset, sigma, wrong)


def _carried(lines: Lines, offset_s: Array) -> Lines:
    """Return the lines as they stand beside the objects at the reported time.

    Seen was the object where it stood `offset_s` before, from where the sensor stood then.
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


def _chi2(lines: Lines, kept: Flags, spread: Array, found: Array) -> Array:
    """Return how far each line is off with the unknowns that were found; inf once left out."""
    out = np.where(kept, 0.0, np.inf)
    for rows, columns, wide, e in _groups(lines, kept, spread):
        out[rows] = np.sum((e - wide @ found[columns]).reshape(-1, 2) ** 2, axis=1)
    return out


def _groups(
    lines: Lines, kept: Flags, spread: Array
) -> Iterator[tuple[Indices, Indices, Array, Array]]:
    """Yield each position's lines: rows, columns of unknowns, derivatives and residuals.

    Without what the position can absorb: that says nothing of the sensors.
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
            own = slice(PER_SENSOR * k, PER_SENSOR * (k + 1))
            wide[2 * k : 2 * k + 2, own] = A[k]
        yield rows, columns, wide - free @ (free.T @ wide), e - free @ (free.T @ e)


def _whitened(lines: Lines, spread: Array) -> tuple[Array, Array, Array]:
    """Return derivatives by position (n, 2, 3) and by the sensor's unknowns (n, 2, 7) and the
    residuals (n, 2), in units of the noise and of the unknowns' spread."""
    basis = tangent_basis(lines.u)
    away = lines.x_km - lines.r_km
    reach = np.linalg.norm(away, axis=1)
    foretold = away / reach[:, None]
    root = np.linalg.inv(np.linalg.cholesky(lines.cov))
    by_place = root @ basis / reach[:, None, None]
    rate = np.einsum("nij,nj->ni", by_place, lines.v_km_s - lines.v_sensor_km_s)
    by_turn = root @ basis @ -skew(lines.u)
    own = np.concatenate([-rate[:, :, None], by_place, by_turn], axis=2)
    per_line = spread.reshape(-1, PER_SENSOR)[lines.sensor]
    misses = np.einsum("nij,nj->ni", root @ basis, lines.u - foretold)
    return by_place, own * per_line[:, None, :], misses
