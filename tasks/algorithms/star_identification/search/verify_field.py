"""Whether the stars of a field are among its centroids: a look-up for each star.

In a crowd, the stars that an attitude puts into the image are far fewer than the centroids. Both
are kept by cells: the centroids by those of the image, the stars by those of the sky.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    MAX_BETA,
    pair_attitude,
)
from epipole.tasks.algorithms.star_identification.star_grid import cell_at, cells_of_cone

Array = npt.NDArray[np.float64]

CELLS = 32  # along each side of the image
SHOWN = 0.4  # of the stars in an image, at least, are among the centroids
GATE = 3.0  # of a star's place, in sigmas
LOOK_UPS = 100  # work beside that of one for each star near the boresight


class CentroidCells(NamedTuple):
    """Centroids by cells of the image.

    first : (CELLS**2 + 1,) int32; the centroids of a cell are the rows first[cell]:first[cell + 1]
    xy : (n, 2) float, normalised image coordinates
    corner, per_cell : (2,) float, of the image, and cells per unit of x and y
    """

    first: npt.NDArray[np.int32]
    xy: Array
    corner: Array
    per_cell: Array


class Pair(NamedTuple):
    """A pair of centroids: its middle x, y, squared error [rad^2], chord, and how much of the image
    is near a centroid, per squared error."""

    x: float
    y: float
    noise2: float
    c: float
    density: float


@borrowing_kernel
def _cell(v, corner, per_cell):
    return int(min(max((v - corner) * per_cell, 0.0), CELLS - 1.0))


@kernel
def make_places(u, box):
    """Return centroids (n, 3) by cells of the image (compiled)."""
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
def _is_shown(x, y, radius, places):
    """Tell whether a centroid is within this of a place."""
    corner, per_cell = places.corner, places.per_cell
    left = _cell(x - radius, corner[0], per_cell[0])
    right = _cell(x + radius, corner[0], per_cell[0])
    bottom = _cell(y - radius, corner[1], per_cell[1])
    for row in range(bottom, _cell(y + radius, corner[1], per_cell[1]) + 1):
        for k in range(places.first[CELLS * row + left], places.first[CELLS * row + right + 1]):
            dx, dy = places.xy[k, 0] - x, places.xy[k, 1] - y
            if dx * dx + dy * dy < radius * radius:
                return True
    return False


@borrowing_kernel
def odds_of_field(problem, i, s, j, other, c, stars, places, room):
    """Return the log odds that the image shows the field in which centroids i and j are these
    stars, c apart, and the work done (compiled). Writes E, F and R of the scratch.

    Each star of the field beside the two is shown or not; chance shows the share of the image that
    is near a centroid. `stars` are those of `by_bands`.
    """
    u, sigma, box, R = problem.centroids.u, problem.centroids.sigma, problem.image.box, room.R
    pair_attitude(u[i], u[j], problem.stars.u[s], problem.stars.u[other], c, room)
    x = 0.5 * (u[i, 0] / u[i, 2] + u[j, 0] / u[j, 2])
    y = 0.5 * (u[i, 1] / u[i, 2] + u[j, 1] / u[j, 2])
    noise2 = 0.5 * (sigma[i] * sigma[i] + sigma[j] * sigma[j])
    pair = Pair(x, y, noise2, c, math.pi * GATE * GATE * len(u) / problem.image.area)
    least = 1.0 / math.sqrt(1.0 + max(-box[0], box[1]) ** 2 + max(-box[2], box[3]) ** 2)
    # The pair itself is shown however it is chosen.
    odds = -2.0 * math.log(SHOWN / min(pair.density * 2.0 * noise2, 0.5 * SHOWN))
    x, y, z = R[2, 0], R[2, 1], R[2, 2]
    cells, ratio, looked = cells_of_cone(x, y, z, least), 1.0, 0
    for band in range(cells.low, cells.high + 1):
        for sector in range(cells.left, cells.left + cells.n_sectors):
            cell = cell_at(band, sector)
            for k in range(stars.first[cell], stars.first[cell + 1]):
                depth = x * stars.u[k, 0] + y * stars.u[k, 1] + z * stars.u[k, 2]
                if depth > least:
                    ratio *= _ratio_of_star(stars.u[k], depth, R, box, pair, places)
                    looked += 1
    return odds + math.log(ratio), LOOK_UPS + looked


@borrowing_kernel
def _ratio_of_star(star, z, R, box, pair, places):
    """Return the likelihood ratio of one star, z along the boresight: 1 outside the image."""
    x = (R[0, 0] * star[0] + R[0, 1] * star[1] + R[0, 2] * star[2]) / z
    y = (R[1, 0] * star[0] + R[1, 1] * star[1] + R[1, 2] * star[2]) / z
    if not (box[0] < x < box[1] and box[2] < y < box[3]):
        return 1.0
    d2 = (x - pair.x) ** 2 + (y - pair.y) ** 2
    s2 = pair.noise2 * (1.5 + 2.0 * d2 / (pair.c * pair.c)) + MAX_BETA * MAX_BETA * d2
    chance = pair.density * s2
    if chance > 0.5 * SHOWN:  # it tells nothing
        return 1.0
    if _is_shown(x, y, GATE * math.sqrt(s2), places):
        return SHOWN / chance
    return (1.0 - SHOWN) / (1.0 - chance)
