"""Evaluation: errors of attitudes and positions against the truth, and of the grouping."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


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
    """Return e' C^-1 e of errors (n, 3) and covariances (n, 3, 3).

    Chi-square distributed with 3 degrees of freedom if the covariances are right. Infinite where
    a covariance is not positive definite.
    """
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], covariance, np.eye(3))
    good = finite & (np.linalg.eigvalsh(safe)[:, 0] > 0)
    safe = np.where(good[:, None, None], safe, np.eye(3))
    weighted = np.linalg.solve(safe, error[:, :, None])[:, :, 0]
    return np.where(good, np.einsum("ij,ij->i", error, weighted), np.inf)


class Majority(NamedTuple):
    """The most frequent value of each group (-1 without any), and the number of its members."""

    value: Indices
    votes: Indices


def majority(group: Indices, value: Indices, n_groups: int) -> Majority:
    """Return the most frequent value of each group; of a tie, the value that comes first.

    Parameters
    ----------
    group : (n,) int
        Group of each member, 0 to n_groups - 1.
    value : (n,) int
        Value of each member; negative ones are not counted.
    """
    there = np.flatnonzero(value >= 0)
    group, value = group[there], value[there]
    order = np.lexsort((np.arange(len(group)), value, group))
    group, value = group[order], value[order]
    new = np.ones(len(group), bool)
    new[1:] = (group[1:] != group[:-1]) | (value[1:] != value[:-1])
    start = np.flatnonzero(new)
    count = np.diff(np.append(start, len(group)))
    best = np.lexsort((order[start], -count, group[start]))
    owner, first = np.unique(group[start][best], return_index=True)
    out = Majority(np.full(n_groups, -1, np.int64), np.zeros(n_groups, np.int64))
    out.value[owner] = value[start][best][first]
    out.votes[owner] = count[best][first]
    return out


def pairs_within(group: Indices, value: Indices, n_groups: int) -> tuple[int, int]:
    """Return the number of pairs within groups, and of those with equal values (0 or above)."""
    size = np.bincount(group, minlength=n_groups)
    alike = value >= 0
    together = np.unique(np.stack([group[alike], value[alike]]), axis=1, return_counts=True)[1]
    return int(np.sum(size * (size - 1) // 2)), int(np.sum(together * (together - 1) // 2))
