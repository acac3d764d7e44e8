"""The sky as one camera needs it: stars to a limit, their grid, their pairs."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.catalogue.star_catalogue import NavigationCatalogue
from epipole.tasks.algorithms.star_identification.search.evidence import log_magnitude_density
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable, build_pair_table
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid, build_sky_grid
from epipole.tasks.algorithms.star_identification.sky.star_bands import StarBands, by_bands

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
    log_density: npt.NDArray[np.float64]
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


def pattern_pairs(u_icrs: npt.NDArray[np.float64], diagonal_rad: float) -> PairTable:
    """Return the pairs of these (n, 3) stars that fit into a field with this diagonal."""
    # Neighbours a star has within r: (n / 4 pi) pi r^2; each pair counts twice.
    reach = min(diagonal_rad, np.sqrt(8.0 * MAX_PAIRS) / max(len(u_icrs), 1), np.pi)
    return build_pair_table(u_icrs, float(reach))


def sky_grid(sky: Sky, radius_rad: float) -> SkyGrid:
    """Return the grid of the sky's stars for look-ups within the radius."""
    return build_sky_grid(sky.catalogue.u_icrs, radius_rad)
