"""Errors of results against the truth: attitudes, positions, states and identities."""

import math
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from epipole.schemas.arrays import Array, Indices


def attitude_errors(q_found: Array, q_true: Array) -> tuple[Array, Array]:
    """Return the errors of attitudes against the true ones, about the sensor's axes.

    Parameters
    ----------
    q_found, q_true : (n, 4) float
        Quaternions, sensor from ICRS, scalar last; any length above 0.

    Returns
    -------
    cross : (n,) float
        Error of the boresight [rad], never negative.
    roll : (n,) float
        Error about the boresight [rad].
    """
    if not len(q_found):
        return np.empty(0), np.empty(0)
    turned = (Rotation.from_quat(q_found) * Rotation.from_quat(q_true).inv()).as_rotvec()
    return np.hypot(turned[:, 0], turned[:, 1]), turned[:, 2]


def squared_normalised_errors(error: Array, covariance: Array) -> Array:
    """Return e' C^-1 e of errors, the normalised estimation error squared (NEES).

    If the covariances are right, it has a chi-square distribution with k degrees of freedom.

    Parameters
    ----------
    error : (n, k) float
        Estimate minus truth.
    covariance : (n, k, k) float
        Symmetric, in the squared units of the errors.

    Returns
    -------
    nees : (n,) float
        Infinite where the covariance is not finite or not positive definite.

    References
    ----------
    Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and
    Navigation, section 5.4.2.
    """
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], covariance, np.eye(error.shape[1]))
    good = finite & (np.linalg.eigvalsh(safe)[:, 0] > 0)
    safe = np.where(good[:, None, None], safe, np.eye(error.shape[1]))
    weighted = np.linalg.solve(safe, error[:, :, None])[:, :, 0]
    return np.where(good, np.einsum("ij,ij->i", error, weighted), np.inf)


class Majority(NamedTuple):
    """The most frequent value of each group (-1: none is counted), and how often it occurs."""

    value: Indices
    votes: Indices


def majority(group: Indices, value: Indices, n_groups: int) -> Majority:
    """Return the most frequent value of each group; the earliest of equally frequent values.

    Parameters
    ----------
    group : (n,) int
        Group of each member, 0 to n_groups - 1.
    value : (n,) int
        Value of each member; negative ones are not counted.
    """
    counted = np.flatnonzero(value >= 0)
    group, value = group[counted], value[counted]
    order = np.lexsort((np.arange(len(group)), value, group))
    group, value = group[order], value[order]
    new = np.ones(len(group), bool)
    new[1:] = (group[1:] != group[:-1]) | (value[1:] != value[:-1])
    start = np.flatnonzero(new)
    count = np.diff(np.append(start, len(group)))
    best = np.lexsort((order[start], -count, group[start]))
    groups, first = np.unique(group[start][best], return_index=True)
    out = Majority(np.full(n_groups, -1, np.int64), np.zeros(n_groups, np.int64))
    out.value[groups] = value[start][best][first]
    out.votes[groups] = count[best][first]
    return out


def pairs_within(group: Indices, value: Indices, n_groups: int) -> tuple[int, int]:
    """Return the number of pairs within groups, and of those with equal, non-negative values.

    Parameters
    ----------
    group : (n,) int
        0 to n_groups - 1.
    value : (n,) int
        A pair with a negative value is never right.
    """
    size = np.bincount(group, minlength=n_groups)
    alike = value >= 0
    together = np.unique(np.stack([group[alike], value[alike]]), axis=1, return_counts=True)[1]
    return int(np.sum(size * (size - 1) // 2)), int(np.sum(together * (together - 1) // 2))


def count_changes(group: Indices, value: Indices) -> int:
    """Return how often the value changes from one member of a group to the next.

    Parameters
    ----------
    group, value : (n,) int
        The members of a group are consecutive, in the order in which they are compared.
    """
    same_group = group[1:] == group[:-1]
    return int(np.sum(same_group & (value[1:] != value[:-1])))


def mean_of_group_means(group: Indices, value: Array) -> tuple[float, float]:
    """Return the mean of the means of groups, and its standard error from their scatter.

    Members of a group may share an error, so the groups, not the members, are independent. Both
    results are not finite if a value is infinite.

    Parameters
    ----------
    group : (n,) int
        Any numbers; n > 0.
    value : (n,) float
    """
    _, number, size = np.unique(group, return_inverse=True, return_counts=True)
    means = np.bincount(number, weights=value) / size
    if not np.isfinite(means).all():
        return float(np.mean(means)), math.inf
    return float(np.mean(means)), float(np.std(means) / math.sqrt(len(means)))


class SampledOrbits(NamedTuple):
    """Positions and velocities of objects, ordered by object and time.

    Each object has two rows or more, and no time twice.
    """

    object: Indices  # (n,)
    t_s: Array  # (n,) s since a common epoch
    r_km: Array  # (n, 3) any one inertial frame
    v_km_s: Array  # (n, 3) same frame


def interpolate_orbits(orbits: SampledOrbits, objects: Indices, t_s: Array) -> tuple[Array, Array]:
    """Return positions and velocities of objects by cubic Hermite interpolation.

    Parameters
    ----------
    orbits
        Must have rows of all `objects`.
    objects : (n,) int
        An object per row.
    t_s : (n,) float
        A time per row [s], since the epoch of the orbits. Before the first and after the last
        sample of an object its first and last cubic are extrapolated.

    Returns
    -------
    r_km, v_km_s : (n, 3) float
        Frame of the orbits; the velocity is the derivative of the cubic.
    """
    r_km, v_km_s = np.empty((len(objects), 3)), np.empty((len(objects), 3))
    order = np.argsort(objects, kind="stable")
    numbers, start = np.unique(objects[order], return_index=True)
    for number, rows in zip(numbers, np.split(order, start[1:]), strict=False):
        rows_of_object = slice(*np.searchsorted(orbits.object, [number, number + 1]))
        path = CubicHermiteSpline(
            orbits.t_s[rows_of_object], orbits.r_km[rows_of_object], orbits.v_km_s[rows_of_object]
        )
        r_km[rows], v_km_s[rows] = path(t_s[rows]), path(t_s[rows], nu=1)
    return r_km, v_km_s
