"""Catalogue stars by their direction: the star nearest to a direction, or all stars in a cone.

A `SkyGrid` has small cells and answers the first question in constant time: hypotheses of an
attitude ask it millions of times. `StarBands` have large cells of equal area and answer the second.
A `Sky` is the catalogue to a magnitude limit with what look-ups in it need.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_catalogue import NavigationCatalogue
from epipole.tasks.algorithms.star_identification.evidence import log_magnitude_density
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable, build_pair_table

# The star nearest to a direction.


class SkyGrid(NamedTuple):
    """Cells on the six faces of a cube; a star is entered in every cell that its disc touches.

    first : (6 n_face^2 + 1,) int32; the stars of cell c are star[first[c]:first[c + 1]]
    star : int32, rows of the catalogue
    n_face : cells along an edge
    radius_rad : of the discs; look-ups with a larger one miss stars
    """

    first: npt.NDArray[np.int32]
    star: npt.NDArray[np.int32]
    n_face: int
    radius_rad: float


def build_sky_grid(u_icrs: Array, radius_rad: float) -> SkyGrid:
    """Return the grid of (n, 3) star directions for look-ups within `radius_rad`."""
    # Cells of two disc radii: a star is in about four. At most 256 along an edge keep the grid of a
    # small radius in the processor's cache.
    n_face = int(np.clip(np.pi / 2 / (2 * radius_rad), 8, 256))
    count = np.zeros(6 * n_face * n_face + 1, np.int32)
    _visit_cells(u_icrs, radius_rad, n_face, count, np.empty(0, np.int32))
    first = np.zeros_like(count)
    np.cumsum(count[:-1], out=first[1:])
    star = np.empty(first[-1], np.int32)
    _visit_cells(u_icrs, radius_rad, n_face, first[:-1].copy(), star)
    return SkyGrid(first, star, n_face, float(radius_rad))


@kernel
def _visit_cells(u, radius, n, slot, star):
    """Count each star's cells in `slot`; or enter the stars at the slots, where `star` has room.

    Parameters
    ----------
    u : (m, 3) float
        Unit vectors of the stars, ICRS.
    radius, n : float, int
        Radius of the stars' discs [rad], and number of cells along an edge of the cube.
    slot : (6 n^2,) int32 or longer
        Each cell's element grows by its number of stars. Where stars are entered, it begins as the
        first element of `star` for the cell.
    star : (entries,) int32, out
        Rows of u, cell by cell; an empty array: stars are only counted.
    """
    for k in range(len(u)):
        for face in range(6):
            axis = face % 3
            major = u[k, axis] if face < 3 else -u[k, axis]
            if major < 0.3:
                continue
            a = u[k, (axis + 1) % 3] / major
            b = u[k, (axis + 2) % 3] / major
            # A gnomonic map stretches by at most the square of the secant.
            reach = 1.1 * radius * (1.0 + a * a + b * b)
            i0 = max(int(np.floor((a - reach + 1.0) * 0.5 * n)), 0)
            i1 = min(int(np.floor((a + reach + 1.0) * 0.5 * n)), n - 1)
            j0 = max(int(np.floor((b - reach + 1.0) * 0.5 * n)), 0)
            j1 = min(int(np.floor((b + reach + 1.0) * 0.5 * n)), n - 1)
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    cell = (face * n + i) * n + j
                    if len(star):
                        star[slot[cell]] = k
                    slot[cell] += 1


@kernel
def cell_of(x, y, z, n):
    """Return the cell in a `SkyGrid` of a direction, ICRS, of any length (compiled).

    n is the number of cells along an edge.
    """
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, a, b, major = 0 if x > 0 else 3, y, z, ax
    elif ay >= az:
        face, a, b, major = 1 if y > 0 else 4, z, x, ay
    else:
        face, a, b, major = 2 if z > 0 else 5, x, y, az
    i = min(int((a / major + 1.0) * 0.5 * n), n - 1)
    j = min(int((b / major + 1.0) * 0.5 * n), n - 1)
    return (face * n + i) * n + j


@borrowing_kernel
def nearest_star(x, y, z, radius, u_icrs, first, star, n_face):
    """Return the star nearest to a unit vector within `radius` [rad], -1 without one, and the
    squared chord to it (compiled).

    u_icrs (m, 3) are the stars' unit vectors, `first`, `star` and n_face those of their `SkyGrid`.
    """
    cell = cell_of(x, y, z, n_face)
    best, best_d2 = -1, radius * radius
    for m in range(first[cell], first[cell + 1]):
        s = star[m]
        dx, dy, dz = u_icrs[s, 0] - x, u_icrs[s, 1] - y, u_icrs[s, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < best_d2:
            best, best_d2 = s, d2
    return best, best_d2


# All stars in a cone.

# Cells of z and of azimuth. With 2048 cells a field of 8 degrees reaches into some six.
BANDS, SECTORS = 32, 64


class StarBands(NamedTuple):
    """Stars cell by cell.

    first : (BANDS SECTORS + 1,) int32; the stars of a cell are first[cell]:first[cell + 1]
    row : (n,) int32, rows of the catalogue
    u : (n, 3) float, directions, ICRS
    """

    first: npt.NDArray[np.int32]
    row: npt.NDArray[np.int32]
    u: Array


class ConeCells(NamedTuple):
    """The cells of a cone: in each band low .. high, `n_sectors` sectors from `left` on.

    Sectors below 0 or beyond the last one are counted round.
    """

    low: int
    high: int
    left: int
    n_sectors: int


@borrowing_kernel
def _band(z):
    """Return the band, 0 to BANDS - 1, of a unit vector's z."""
    return min(max(int((z + 1.0) * 0.5 * BANDS), 0), BANDS - 1)


@borrowing_kernel
def _sector(azimuth):
    """Return the sector of an azimuth [rad]; beyond a turn the numbers go on, see `cell_at`."""
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
    """Return the cell of a band and a sector, of any turn (compiled)."""
    return band * SECTORS + (sector & (SECTORS - 1))


@borrowing_kernel
def cells_of_cone(x, y, z, cosine):
    """Return the `ConeCells` that hold all within an angle, at most 90 degrees and given by its
    cosine, of a unit vector, ICRS (compiled)."""
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
    (compiled). The angle is at most 90 degrees and given by its cosine.

    `stars` are `StarBands`, the vector is ICRS. `at` (n,) int has room for all n stars.
    """
    cells, n = cells_of_cone(x, y, z, cosine), 0
    for band in range(cells.low, cells.high + 1):
        for sector in range(cells.left, cells.left + cells.n_sectors):
            cell = cell_at(band, sector)
            for k in range(stars.first[cell], stars.first[cell + 1]):
                if x * stars.u[k, 0] + y * stars.u[k, 1] + z * stars.u[k, 2] > cosine:
                    at[n] = k
                    n += 1
    return n


# The sky to a magnitude limit.

# Mean number of bright stars in a field whose pairs are tabled: enough that sparse fields have
# several, and few enough that not many pairs share a separation.
PATTERN_STARS = 24.0
MAX_PAIRS = 1_000_000


class Sky(NamedTuple):
    """Stars to a magnitude limit, brightest first, with what look-ups need.

    catalogue : the stars
    log_density : (72,) float, see `evidence.log_magnitude_density`
    rho : stars per steradian, mean of the sky
    bands : the stars by cells
    """

    catalogue: NavigationCatalogue
    log_density: Array
    rho: float
    bands: StarBands


def sky_to_limit(stars: NavigationCatalogue, magnitude_limit: float) -> Sky:
    """Return the sky of the stars no fainter than the limit."""
    n = int(np.searchsorted(stars.magnitude, magnitude_limit, side="right"))
    columns: list[npt.NDArray[Any]] = [np.ascontiguousarray(column[:n]) for column in stars]
    cut = NavigationCatalogue(*columns)
    rho = max(n, 1) / (4 * np.pi)
    return Sky(cut, log_magnitude_density(cut.magnitude), rho, by_bands(cut.u_icrs))


def pattern_size(sky: Sky, solid_angle_sr: float) -> int:
    """Return how many of the sky's brightest stars are paired for a field of this size."""
    return min(int(PATTERN_STARS * 4 * np.pi / solid_angle_sr), len(sky.catalogue.star_id))


def pattern_pairs(u_icrs: Array, diagonal_rad: float) -> PairTable:
    """Return the pairs of these (n, 3) stars that fit into a field with this diagonal."""
    # Neighbours a star has within r: (n / 4 pi) pi r^2; each pair counts twice.
    reach = min(diagonal_rad, np.sqrt(8.0 * MAX_PAIRS) / max(len(u_icrs), 1), np.pi)
    return build_pair_table(u_icrs, float(reach))


def sky_grid(sky: Sky, radius_rad: float) -> SkyGrid:
    """Return the grid of the sky's stars for look-ups within the radius."""
    return build_sky_grid(sky.catalogue.u_icrs, radius_rad)
