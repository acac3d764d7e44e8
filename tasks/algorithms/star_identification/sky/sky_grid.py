"""A grid over the sky: finds the catalogue stars near a direction in constant time."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel


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


def build_sky_grid(u_icrs: npt.NDArray[np.float64], radius_rad: float) -> SkyGrid:
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
    """Count each star's cells in `slot`; or enter the stars at the slots, where `star` has room."""
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
    """Return the cell of a direction, of any length (compiled)."""
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
    """Return the star nearest to a unit vector within `radius` [rad], -1 if there is none, and the
    squared chord to it (compiled)."""
    cell = cell_of(x, y, z, n_face)
    best, best_d2 = -1, radius * radius
    for m in range(first[cell], first[cell + 1]):
        s = star[m]
        dx, dy, dz = u_icrs[s, 0] - x, u_icrs[s, 1] - y, u_icrs[s, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < best_d2:
            best, best_d2 = s, d2
    return best, best_d2
