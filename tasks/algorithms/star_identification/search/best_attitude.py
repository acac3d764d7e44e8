"""The best attitude that a search has found so far, and when it is beyond doubt."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.attitude import copy_matrix
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

# Attitudes closer than this are the same one [rad, about 0.3 degrees].
SAME_ATTITUDE = 5e-3
# Log odds at which a hypothesis is dropped, and with which it is refined.
FLOOR, WORTH = -6.0, 2.0
# A search goes on where more than half of the matches are this near to each other, in sides of the
# image: in a cluster of stars, a wrong attitude may match many of them, and little else.
CLUSTER = 0.1


class Best(NamedTuple):
    """The best attitude so far.

    evidence : (2,) float, log evidence of the best, and of the best that is another attitude
    clustered : (1,) bool, most matches of the best are in one place
    R : (3, 3) float
    """

    evidence: npt.NDArray[np.float64]
    clustered: npt.NDArray[np.bool_]
    R: npt.NDArray[np.float64]


@kernel
def no_attitude(R):
    """Return the best attitude before any is found; it will be written to R (compiled)."""
    return Best(np.array([-1e9, -1e9]), np.zeros(1, np.bool_), R)


@borrowing_kernel
def keep(evidence, problem, room, best):
    """Enter the attitude judged last where it is the best, or the best other one."""
    top, R = best.evidence, room.R
    if evidence <= top[1]:
        return
    gap2 = 0.0
    for r in range(3):
        for m in range(3):
            gap2 += (R[r, m] - best.R[r, m]) ** 2
    same = gap2 < 2.0 * SAME_ATTITUDE * SAME_ATTITUDE
    if evidence > top[0]:
        if not same:
            top[1] = top[0]
        top[0] = evidence
        best.clustered[0] = _is_clustered(problem.centroids.u, room.row_of, problem.image.box)
        copy_matrix(R, best.R)
    elif not same:
        top[1] = evidence


@borrowing_kernel
def _is_clustered(u, row_of, box):
    """Tell whether more than half of the matches are near one of them."""
    near = CLUSTER * max(box[1] - box[0], box[3] - box[2])
    matches = 0
    for star in row_of:
        matches += star >= 0
    for k in range(len(row_of)):
        if row_of[k] < 0:
            continue
        around = 0
        for m in range(len(row_of)):
            dx, dy = u[m, 0] - u[k, 0], u[m, 1] - u[k, 1]
            around += (row_of[m] >= 0) & (dx * dx + dy * dy < near * near)
        if 2 * around > matches:
            return True
    return False


@borrowing_kernel
def is_clear(best, rule):
    """Tell whether the best attitude is beyond doubt."""
    top = best.evidence
    return not best.clustered[0] and top[0] > rule.enough and top[0] - top[1] > rule.enough
