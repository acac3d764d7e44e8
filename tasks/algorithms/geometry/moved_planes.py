"""Covariances on the tangent planes of directions that are moved a little.

The axes of `tangent_basis` turn by as little as the direction moves, but for a jump at one
declination: there the same numbers would mean another ellipse.
"""

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.geometry.directions import AXES_JUMP, tangent_basis


def on_moved_plane(cov: Array, before: Array, after: Array) -> Array:
    """Return covariances (n, 2, 2) on the tangent plane of directions that were moved a little.

    Parameters
    ----------
    cov : (n, 2, 2) float
        On ``tangent_basis(before)``.
    before, after : (n, 3) float
        Directions, unit vectors.
    """
    rows = np.flatnonzero((np.abs(before[:, 2]) < AXES_JUMP) != (np.abs(after[:, 2]) < AXES_JUMP))
    if not len(rows):
        return cov
    turn = tangent_basis(after[rows]) @ np.swapaxes(tangent_basis(before[rows]), 1, 2)
    out = cov.copy()
    out[rows] = turn @ cov[rows] @ np.swapaxes(turn, 1, 2)
    return out
