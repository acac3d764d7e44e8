"""Verify a field: are the stars that an attitude puts into the image among the centroids?

In a crowd these stars are far fewer than the centroids, so each star is looked up, not each
centroid. Centroids are kept by cells of the image, stars by cells of the sky.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    MAX_BETA,
    pair_attitude,
)
from epipole.tasks.algorithms.star_identification.star_grid import cell_at, cells_of_cone

CELLS = 32  # along each side of the image
DETECTED_SHARE = 0.4  # of the stars in an image that are among the centroids, at least
GATE = 3.0  # [sigma] of a star's predicted position
LOOK_UPS = 100  # units of work per field, in addition to one per star


class CentroidCells(NamedTuple):
    """Centroids by cells of the image.

    first : (CELLS**2 + 1,) int32; the centroids of a cell are the rows first[cell]:first[cell + 1]
    xy : (n, 2) float, normalised image coordinates
    corner, per_cell : (2,) float, lowest x and y of the image, and cells per unit of x and y
    """

    first: npt.NDArray[np.int32]
    xy: Array
    corner: Array
    per_cell: Array


class Pair(NamedTuple):
    """A pair of centroids.

    x, y : its middle, normalised image coordinates
    noise2 : mean of the squared errors of both [rad^2]
    c : chord between them [rad]
    density : share of the image within the gate of a centroid, per squared error [1/rad^2]
    """

    x: float
    y: float
    noise2: float
    c: float
    density: float


@borrowing_kernel
def _cell(v, corner, per_cell):
    """Return the column or row of a coordinate v: 0 to CELLS - 1, the nearest for one outside.

    `corner` is the coordinate at which cell 0 begins, `per_cell` the number of cells per unit.
    """
    return int(min(max((v - corner) * per_cell, 0.0), CELLS - 1.0))


@kernel
def make_centroid_cells(u, box):
    """Return the centroids by cells of the image (compiled).

    u : (n, 3), directions. box : (4,), x0, x1, y0, y1 of the image in normalised coordinates.
    """
    n = len(u)
    corner = np.array([box[0], box[2]])
    per_cell = CELLS / np.array([box[1] - box[0], box[3] - box[2]])
    cell = np.empty(n, np.int64)
    for k in range(n):
        column = _cell(u[k, 0] / u[k, 2], corner[0], per_cell[0])
        cell[k] = CELLS * _cell(u[k, 1] / u[k, 2], corner[1], per_cell[1]) + column
    order = np.argsort(cell)
    first = np.searchsorted(cell[order], np.arange(CELLS * CELLS + 1)).astype(np.int32)
    return CentroidCells(first, (u[:, :2] / u[:, 2:])[order], corner, per_cell)


@borrowing_kernel
def _has_centroid(x, y, radius, cells):
    """Return whether one of the `CentroidCells` is within a radius of x, y, in normalised image
    coordinates."""
    corner, per_cell = cells.corner, cells.per_cell
    left = _cell(x - radius, corner[0], per_cell[0])
    right = _cell(x + radius, corner[0], per_cell[0])
    bottom = _cell(y - radius, corner[1], per_cell[1])
    for row in range(bottom, _cell(y + radius, corner[1], per_cell[1]) + 1):
        for k in range(cells.first[CELLS * row + left], cells.first[CELLS * row + right + 1]):
            dx, dy = cells.xy[k, 0] - x, cells.xy[k, 1] - y
            if dx * dx + dy * dy < radius * radius:
                return True
    return False


@borrowing_kernel
def field_log_odds(problem, i, s, j, other, c, stars, cells, scratch):
    """Return the log odds that centroids i and j are the stars s and `other`, and the work done
    (compiled).

    If they are, a star of the field has a centroid with the probability `DETECTED_SHARE`; if not,
    with that of the share of the image that is near a centroid. Writes E, F and R of the scratch.

    Parameters
    ----------
    c : float
        Chord between the two stars [rad].
    stars, cells : StarBands, CentroidCells
        All stars, and the frame's centroids.
    """
    u, sigma, box, R = problem.centroids.u, problem.centroids.sigma, problem.image.box, scratch.R
    pair_attitude(u[i], u[j], problem.stars.u[s], problem.stars.u[other], c, scratch)
    x = 0.5 * (u[i, 0] / u[i, 2] + u[j, 0] / u[j, 2])
    y = 0.5 * (u[i, 1] / u[i, 2] + u[j, 1] / u[j, 2])
    noise2 = 0.5 * (sigma[i] * sigma[i] + sigma[j] * sigma[j])
    pair = Pair(x, y, noise2, c, math.pi * GATE * GATE * len(u) / problem.image.area)
    # Cosine of the angle between boresight and corner.
    least = 1.0 / math.sqrt(1.0 + max(-box[0], box[1]) ** 2 + max(-box[2], box[3]) ** 2)
    # The two stars of the pair have centroids by construction. Their ratios, which the loop below
    # includes, are divided out first.
    odds = -2.0 * math.log(DETECTED_SHARE / min(pair.density * 2.0 * noise2, 0.5 * DETECTED_SHARE))
    x, y, z = R[2, 0], R[2, 1], R[2, 2]
    cone, ratio, looked = cells_of_cone(x, y, z, least), 1.0, 0
    for band in range(cone.low, cone.high + 1):
        for sector in range(cone.left, cone.left + cone.n_sectors):
            cell = cell_at(band, sector)
            for k in range(stars.first[cell], stars.first[cell + 1]):
                depth = x * stars.u[k, 0] + y * stars.u[k, 1] + z * stars.u[k, 2]
                if depth > least:
                    ratio *= _ratio_of_star(stars.u[k], depth, R, box, pair, cells)
                    looked += 1
    return odds + math.log(ratio), LOOK_UPS + looked


@borrowing_kernel
def _ratio_of_star(star, z, R, box, pair, cells):
    """Return the likelihood ratio of one star, 1 outside the image; z is along the boresight.

    `star` (3,) is its unit vector, ICRS, z its third component in the sensor frame. R (3, 3) is
    sensor from ICRS; `box` (4,) as in `Image`.
    """
    x = (R[0, 0] * star[0] + R[0, 1] * star[1] + R[0, 2] * star[2]) / z
    y = (R[1, 0] * star[0] + R[1, 1] * star[1] + R[1, 2] * star[2]) / z
    if not (box[0] < x < box[1] and box[2] < y < box[3]):
        return 1.0
    d2 = (x - pair.x) ** 2 + (y - pair.y) ** 2
    # Error of the predicted position: it grows with the distance from the pair, over its length.
    s2 = pair.noise2 * (1.5 + 2.0 * d2 / (pair.c * pair.c)) + MAX_BETA * MAX_BETA * d2
    chance = pair.density * s2
    if chance > 0.5 * DETECTED_SHARE:  # a centroid there is no evidence
        return 1.0
    if _has_centroid(x, y, GATE * math.sqrt(s2), cells):
        return DETECTED_SHARE / chance
    return (1.0 - DETECTED_SHARE) / (1.0 - chance)
