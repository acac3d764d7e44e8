"""All stars in a cone: cells of the sky by z and azimuth, which all have the same area."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

BANDS, SECTORS = 32, 64


class StarBands(NamedTuple):
    """Stars cell by cell.

    first : (BANDS SECTORS + 1,) int32; the stars of a cell are first[cell]:first[cell + 1]
    row : (n,) int32, rows of the catalogue
    u : (n, 3) float, directions
    """

    first: npt.NDArray[np.int32]
    row: npt.NDArray[np.int32]
    u: npt.NDArray[np.float64]


class ConeCells(NamedTuple):
    """The cells of a cone: of the bands low .. high, so many sectors from `left` on; a sector may
    be negative or beyond the last, and is counted round."""

    low: int
    high: int
    left: int
    n_sectors: int


@borrowing_kernel
def _band(z):
    return min(max(int((z + 1.0) * 0.5 * BANDS), 0), BANDS - 1)


@borrowing_kernel
def _sector(azimuth):
    return math.floor(azimuth * (SECTORS / (2.0 * math.pi)))


@kernel
def by_bands(u):
    """Return directions (n, 3) by cells (compiled)."""
    cell = np.empty(len(u), np.int64)
    for k in range(len(u)):
        cell[k] = cell_at(_band(u[k, 2]), _sector(math.atan2(u[k, 1], u[k, 0])))
    order = np.argsort(cell)
    first = np.searchsorted(cell[order], np.arange(BANDS * SECTORS + 1)).astype(np.int32)
    return StarBands(first, order.astype(np.int32), u[order])


@borrowing_kernel
def cell_at(band, sector):
    """Return the cell of a band and a sector (compiled)."""
    return band * SECTORS + (sector & (SECTORS - 1))


@borrowing_kernel
def cells_of_cone(x, y, z, cosine):
    """Return the cells that hold all within an angle, at most 90 degrees and given by its cosine,
    of a unit vector (compiled)."""
    sine, along = math.sqrt(1.0 - cosine * cosine), math.sqrt(x * x + y * y)
    low, high = _band(z * cosine - along * sine), _band(z * cosine + along * sine)
    if along <= sine:  # a pole is inside
        return ConeCells(0 if z < 0.0 else low, BANDS - 1 if z > 0.0 else high, 0, SECTORS)
    azimuth, reach = math.atan2(y, x), math.asin(sine / along)
    left = _sector(azimuth - reach)
    return ConeCells(low, high, left, min(_sector(azimuth + reach) - left + 1, SECTORS))


@borrowing_kernel
def find_in_cone(stars, x, y, z, cosine, at):
    """Write where in `stars` those are that lie within an angle of a unit vector; return how many
    (compiled). The angle is at most 90 degrees and given by its cosine."""
    cells, n = cells_of_cone(x, y, z, cosine), 0
    for band in range(cells.low, cells.high + 1):
        for sector in range(cells.left, cells.left + cells.n_sectors):
            cell = cell_at(band, sector)
            for k in range(stars.first[cell], stars.first[cell + 1]):
                if x * stars.u[k, 0] + y * stars.u[k, 1] + z * stars.u[k, 2] > cosine:
                    at[n] = k
                    n += 1
    return n
