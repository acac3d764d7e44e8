"""Manoeuvres: an object whose observations fit one orbit before a time, and another one after it.

Both orbits must lead to one position then: else the observations are of two objects.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.orbit_determination import (
    OUTLIER_CHI2,
    ObjectDirections,
    part_of,
)
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.algorithms.orbits.trajectories import propagate_unknowns
from epipole.tasks.publish.object_orbits import (
    FittedOrbit,
    Start,
    best_orbit,
    judge,
    turned,
)

MIN_PART = 8  # directions on each side of the change
COARSE = 8  # cuts that are tried at first, evenly among the directions
INSTANTS = 9  # at which both orbits are compared at first, in the time between the directions
MEETING_CHI2 = 21.1  # three degrees of freedom: 1 of 10,000 manoeuvres is beyond it
# Largest 1-sigma error, along any axis, of the distance of both orbits where they meet [km]. Vaguer
# orbits meet whatever objects they are of: one sensor that follows an object for 20 s leaves 800 km
# and more, two sensors leave 2 km. Neighbours in a plane are some 50 km apart.
MEETING_SIGMA_KM = 20.0


class Manoeuvre(NamedTuple):
    """A change of an orbit.

    before, after : FittedOrbit
        The orbits before and after it. That after it has `used` and `of_directions` of all
        directions of the object.
    time_s : float
        When, since the origin of the surroundings.
    n_before : int
        Number of directions before it.
    """

    before: FittedOrbit
    after: FittedOrbit
    time_s: float
    n_before: int


def find_manoeuvre(
    directions: ObjectDirections, misfit: FittedOrbit, origin_ns: int, around: Surroundings
) -> Manoeuvre | None:
    """Return the change of an orbit that explains why one orbit does not fit; None if none does.

    Parameters
    ----------
    directions
        All of an object, in order of time.
    misfit
        The orbit that does not fit them.
    origin_ns
        Time from which theirs count, since 1970.
    """
    n = len(directions.time_s)
    if n < 2 * MIN_PART:
        return None
    R = state_rotation(around.R_night_from_gcrf.T)
    start = Start(
        origin_ns + round(misfit.epoch_s * SECOND_NS), turned(R, misfit.orbit.unknowns[:6])
    )

    def of_part(rows: slice) -> FittedOrbit | None:
        inside = np.zeros(n, bool)
        inside[rows] = True
        return best_orbit(part_of(directions, inside), start, origin_ns, around)

    def chi2(cut: int) -> float:
        return sum(_misfit(of_part(rows)) for rows in (slice(None, cut), slice(cut, None)))

    # Directions of one instant stay together.
    starts = np.unique(directions.time_s, return_index=True)[1]
    starts = starts[(starts >= MIN_PART) & (starts <= n - MIN_PART)]
    if not len(starts):
        return None
    cut = int(starts[_least(lambda k: chi2(int(starts[k])), 0, len(starts) - 1)])
    before, after = of_part(slice(None, cut)), of_part(slice(cut, None))
    if before is None or after is None or judge(before) or judge(after):
        return None
    time_s = _meeting(before, after, directions.time_s[cut - 1 : cut + 1], around)
    return None if time_s is None else Manoeuvre(before, _of_all(after, cut, n), time_s, cut)


def _misfit(fitted: FittedOrbit | None) -> float:
    """Return chi-square with that of the directions that were left out; inf without an orbit."""
    if fitted is None:
        return np.inf
    return fitted.orbit.chi2 + OUTLIER_CHI2 * float((~fitted.orbit.used).sum())


def _least(value: Callable[[int], float], first: int, last: int) -> int:
    """Return the number for which a function is least: of some at first, then between them."""
    known: dict[int, float] = {}
    tried = np.unique(np.linspace(first, last, COARSE + 1).astype(int)).tolist()
    step = max(-(-(last - first) // COARSE), 1)
    while True:
        for number in tried:
            if number not in known and first <= number <= last:
                known[number] = value(number)
        best = min(known, key=lambda number: (known[number], number))
        if step == 1:
            return best
        step = -(-step // 2)
        tried = [best - step, best + step] if step > 1 else [best - 1, best + 1]


def _meeting(
    before: FittedOrbit, after: FittedOrbit, between_s: Array, around: Surroundings
) -> float | None:
    """Return the time at which two orbits lead to one position.

    None if they never do, or if they are too vague to say so (`MEETING_SIGMA_KM`).
    """

    def distance(time_s: float) -> tuple[Array, Array]:
        """Return the distance of both orbits (3,) and its covariance (3, 3) [km]."""
        r_km, cov = [], np.zeros((3, 3))
        for fitted in (before, after):
            state, step = propagate_unknowns(fitted.orbit.unknowns, fitted.epoch_s, time_s, around)
            r_km.append(state[:3])
            cov += (step @ fitted.orbit.cov @ step.T)[:3, :3]
        return r_km[1] - r_km[0], cov

    def chi2(time_s: float) -> float:
        apart, cov = distance(time_s)
        return float(apart @ np.linalg.solve(cov, apart))

    tried = np.linspace(float(between_s[0]), float(between_s[1]), INSTANTS)
    near = int(np.argmin([chi2(time_s) for time_s in tried.tolist()]))
    bounds = tried[max(near - 1, 0)], tried[min(near + 1, INSTANTS - 1)]
    best = minimize_scalar(chi2, bounds=bounds, method="bounded")
    _, cov = distance(float(best.x))
    is_vague = np.linalg.eigvalsh(cov)[-1] > MEETING_SIGMA_KM**2
    return float(best.x) if best.fun < MEETING_CHI2 and not is_vague else None


def _of_all(fitted: FittedOrbit, cut: int, n: int) -> FittedOrbit:
    """Return an orbit of the directions from `cut` on as one of all n."""
    used, of_directions = np.zeros(n, bool), np.full(n, np.nan)
    used[cut:], of_directions[cut:] = fitted.orbit.used, fitted.orbit.of_directions
    return fitted._replace(orbit=fitted.orbit._replace(used=used, of_directions=of_directions))
