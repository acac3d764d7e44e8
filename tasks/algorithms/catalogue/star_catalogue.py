"""The navigation catalogue: directions and magnitudes of the stars at a date, for a camera."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.constants import AU_KM

Array = npt.NDArray[np.float64]

MAS = np.pi / 648_000_000.0  # rad


class NavigationCatalogue(NamedTuple):
    """Stars at a date, brightest first, close doubles merged.

    star_id : (n,) int64
    u_icrs : (n, 3) float, directions from the Earth at the date, without aberration
    magnitude : (n,) float, V; of merged doubles the total
    """

    star_id: npt.NDArray[np.int64]
    u_icrs: Array
    magnitude: Array


def places_at(
    ra: Array,
    dec: Array,
    parallax_mas: Array,
    pm_ra_mas_yr: Array,
    pm_dec_mas_yr: Array,
    years: float,
    r_observer_km: Array,
) -> Array:
    """Return (n, 3) unit vectors to stars `years` after the catalogue's epoch.

    Parameters
    ----------
    ra, dec : (n,) float
        Barycentric places at the epoch, ICRS [rad].
    parallax_mas, pm_ra_mas_yr, pm_dec_mas_yr : (n,) float
        Parallax (negative values count as 0); proper motions, in right ascension times cos(dec).
    years : float
        Julian years since the epoch.
    r_observer_km : (3,) float
        The observer's barycentric position [km], ICRS axes.

    References
    ----------
    ESA (1997), The Hipparcos Catalogue, vol. 1, section 1.2.8. Radial velocities are neglected:
    they move no star by 0.2" in a century.
    """
    cos_ra, sin_ra, cos_dec, sin_dec = np.cos(ra), np.sin(ra), np.cos(dec), np.sin(dec)
    u = np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=-1)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    motion = (pm_ra_mas_yr * MAS)[:, None] * east + (pm_dec_mas_yr * MAS)[:, None] * north
    parallax = np.maximum(parallax_mas, 0.0)[:, None] * MAS
    # In units of the star's distance.
    place = u + motion * years - parallax * (np.asarray(r_observer_km) / AU_KM)
    return place / np.linalg.norm(place, axis=1, keepdims=True)


def place_errors(sigma_mas: Array, pm_sigma_mas_yr: Array, years: float) -> Array:
    """Return 1-sigma errors, per axis [rad], of places `years` after the catalogue's epoch."""
    return np.hypot(sigma_mas, pm_sigma_mas_yr * years) * MAS


def navigation_catalogue(
    star_id: npt.NDArray[np.int64], u_icrs: Array, magnitude: Array, merge_rad: float
) -> NavigationCatalogue:
    """Return the stars, brightest first, with those closer than `merge_rad` merged.

    A star merges with the brightest star within `merge_rad` that is not merged itself. The
    result has the brightest star's id, the light-weighted place and the total light. Apply a
    magnitude limit afterwards only: faint companions add light.
    """
    order = np.lexsort((star_id, magnitude))
    star_id, u_icrs, magnitude = star_id[order], u_icrs[order], magnitude[order]
    owner = np.arange(len(star_id))
    for brighter, fainter in _close_pairs(u_icrs, merge_rad):
        if owner[brighter] == brighter and owner[fainter] == fainter:
            owner[fainter] = brighter
    light = 10.0 ** (-0.4 * magnitude)
    keep = owner == np.arange(len(owner))
    together = np.bincount(owner, light, len(owner))[keep]
    place = np.stack(
        [np.bincount(owner, light * u_icrs[:, i], len(owner))[keep] for i in range(3)], axis=1
    )
    merged = np.bincount(owner, minlength=len(owner))[keep] > 1
    place = np.where(
        merged[:, None], place / np.linalg.norm(place, axis=1, keepdims=True), u_icrs[keep]
    )
    total = np.where(merged, -2.5 * np.log10(together), magnitude[keep])
    again = np.lexsort((star_id[keep], total))
    return NavigationCatalogue(star_id[keep][again], place[again], total[again])


def _close_pairs(u: Array, merge_rad: float) -> list[tuple[int, int]]:
    """Return the sorted index pairs closer than the limit, the lower index first."""
    if merge_rad <= 0 or len(u) < 2:
        return []
    pairs = cKDTree(u).query_pairs(2 * np.sin(merge_rad / 2), output_type="ndarray")
    return sorted((int(min(p)), int(max(p))) for p in pairs)


def limit_for_density(magnitude: Array, stars_per_sr: float) -> float:
    """Return the magnitude limit at which a catalogue, brightest first, has this mean density."""
    n = int(np.clip(round(stars_per_sr * 4 * np.pi), 1, len(magnitude)))
    return float(magnitude[n - 1])
