"""Star catalogues: the stars at a date for a camera, and Gaia joined with Hipparcos.

`navigation_catalogue` makes the catalogue for star identification. `join` and `johnson_v_of_gaia`
prepare its source: Gaia with V magnitudes, and the bright stars of Hipparcos that Gaia lacks.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from epipole.schemas.arrays import Array, Indices, Integers
from epipole.tasks.algorithms.constants import ARCSEC, AU_KM
from epipole.tasks.algorithms.geometry.directions import radec_from_unit, unit_from_radec

MAS = np.pi / 648_000_000.0  # rad
# Largest separation of one star in both: 99.9 % of Hipparcos' positions at 2016 are within 0.7" of
# Gaia's.
SAME_ARCSEC = 1.0
# A Hipparcos star is missing from Gaia if it is brighter than `SURELY_LISTED_MAG` and no Gaia star
# of similar brightness is near. (Near: in a double that only one of the catalogues resolves.)
NEAR_ARCSEC = 3.0
LIKE_MAG = 1.5
SURELY_LISTED_MAG = 9.0
# If Hipparcos is brighter by more, its magnitude is used: the relation below fails for the reddest
# variables, and of some doubles Gaia lists only the faint star.
MORE_LIGHT_MAG = 1.0
COLOURS = (-0.5, 5.0)  # range of BP-RP in which the relation holds


class NavigationCatalogue(NamedTuple):
    """Stars at a date, brightest first, close doubles merged.

    star_id : (n,) int64
    u_icrs : (n, 3) float, directions from the Earth at the date, without aberration
    magnitude : (n,) float, V; of merged doubles the total
    """

    star_id: Integers
    u_icrs: Array
    magnitude: Array


def star_directions(
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
        Barycentric positions at the epoch, ICRS [rad].
    parallax_mas, pm_ra_mas_yr, pm_dec_mas_yr : (n,) float
        Parallax (negative values count as 0); proper motions, in right ascension times cos(dec).
    years : float
        Julian years since the epoch.
    r_observer_km : (3,) float
        The observer's barycentric position [km], ICRS axes.

    References
    ----------
    ESA (1997), The Hipparcos Catalogue, vol. 1, section 1.2.8. Radial velocities are neglected:
    their effect is below 0.2" in a century for all stars.
    """
    cos_ra, sin_ra, cos_dec, sin_dec = np.cos(ra), np.sin(ra), np.cos(dec), np.sin(dec)
    u = np.stack([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec], axis=-1)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    motion = (pm_ra_mas_yr * MAS)[:, None] * east + (pm_dec_mas_yr * MAS)[:, None] * north
    parallax = np.maximum(parallax_mas, 0.0)[:, None] * MAS
    # In units of the star's distance.
    position = u + motion * years - parallax * (np.asarray(r_observer_km) / AU_KM)
    return position / np.linalg.norm(position, axis=1, keepdims=True)


def star_sigmas(sigma_mas: Array, pm_sigma_mas_yr: Array, years: float) -> Array:
    """Return 1-sigma errors, per axis [rad], of positions `years` after the catalogue's epoch."""
    return np.hypot(sigma_mas, pm_sigma_mas_yr * years) * MAS


def navigation_catalogue(
    star_id: Integers, u_icrs: Array, magnitude: Array, merge_rad: float
) -> NavigationCatalogue:
    """Return the stars, brightest first, with those closer than `merge_rad` merged.

    A star merges with the brightest star within `merge_rad` that is not merged itself. The
    result has the brightest star's id, the light-weighted position and the total light. Apply a
    magnitude limit afterwards only: faint companions add light.
    """
    order = np.lexsort((star_id, magnitude))
    star_id, u_icrs, magnitude = star_id[order], u_icrs[order], magnitude[order]
    merged_into = np.arange(len(star_id))
    for brighter, fainter in _close_pairs(u_icrs, merge_rad):
        if merged_into[brighter] == brighter and merged_into[fainter] == fainter:
            merged_into[fainter] = brighter
    light = 10.0 ** (-0.4 * magnitude)
    keep = merged_into == np.arange(len(merged_into))
    together = np.bincount(merged_into, light, len(merged_into))[keep]
    position = np.stack(
        [np.bincount(merged_into, light * u_icrs[:, i], len(merged_into))[keep] for i in range(3)],
        axis=1,
    )
    merged = np.bincount(merged_into, minlength=len(merged_into))[keep] > 1
    position = np.where(
        merged[:, None], position / np.linalg.norm(position, axis=1, keepdims=True), u_icrs[keep]
    )
    total = np.where(merged, -2.5 * np.log10(together), magnitude[keep])
    again = np.lexsort((star_id[keep], total))
    return NavigationCatalogue(star_id[keep][again], position[again], total[again])


def _close_pairs(u: Array, merge_rad: float) -> list[tuple[int, int]]:
    """Return the sorted index pairs closer than the limit, the lower index first."""
    if merge_rad <= 0 or len(u) < 2:
        return []
    pairs = cKDTree(u).query_pairs(2 * np.sin(merge_rad / 2), output_type="ndarray")
    return sorted((int(min(p)), int(max(p))) for p in pairs)


def limit_for_density(magnitude: Array, stars_per_sr: float) -> float:
    """Return the magnitude limit at which a catalogue, brightest first, has this mean density.

    0 for a catalogue without stars.
    """
    if not len(magnitude):
        return 0.0
    n = int(np.clip(round(stars_per_sr * 4 * np.pi), 1, len(magnitude)))
    return float(magnitude[n - 1])


# Gaia and Hipparcos


class Joined(NamedTuple):
    """Gaia's stars matched with those of Hipparcos.

    hipparcos_of : (n,) int, row of the Hipparcos star of each Gaia star; -1 without
    missing : (k,) int, rows of Hipparcos stars that Gaia lacks
    """

    hipparcos_of: Indices
    missing: Indices


def johnson_v_of_gaia(g: Array, bp: Array, rp: Array) -> Array:
    """Return Johnson V [mag] from the magnitudes of Gaia DR3, with errors of 0.03 mag.

    Where BP or RP is NaN, the median colour of the other stars is assumed.

    References
    ----------
    Riello et al. (2021), A&A 649, A3, table C.2.
    """
    colour = np.clip(bp - rp, *COLOURS)
    known = np.isfinite(colour)
    colour = np.where(known, colour, np.median(colour[known]) if known.any() else 1.0)
    return g - (-0.02704 + colour * (0.01424 + colour * (-0.2156 + colour * 0.01426)))


def propagate_positions(
    ra: Array, dec: Array, pm_ra_mas_yr: Array, pm_dec_mas_yr: Array, years: float
) -> tuple[Array, Array, Array, Array]:
    """Return barycentric positions [rad] and proper motions [mas/yr] after some Julian years.

    Radial velocities are neglected.
    """
    u, east, north = unit_from_radec(ra, dec), *_axes(ra, dec)
    motion = pm_ra_mas_yr[:, None] * east + pm_dec_mas_yr[:, None] * north
    position = u + motion * (MAS * years)
    distance = np.linalg.norm(position, axis=1, keepdims=True)
    u = position / distance
    motion = (motion - np.sum(motion * u, axis=1, keepdims=True) * u) / distance
    ra, dec = radec_from_unit(u)
    east, north = _axes(ra, dec)
    return ra, dec, np.sum(motion * east, axis=1), np.sum(motion * north, axis=1)


def _axes(ra: Array, dec: Array) -> tuple[Array, Array]:
    cos_ra, sin_ra, cos_dec, sin_dec = np.cos(ra), np.sin(ra), np.cos(dec), np.sin(dec)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    return east, north


def join(u_gaia: Array, v_gaia: Array, u_hipparcos: Array, v_hipparcos: Array) -> Joined:
    """Return which Gaia stars are Hipparcos stars, and the Hipparcos stars that Gaia lacks.

    Parameters
    ----------
    u_gaia, u_hipparcos : (n, 3), (m, 3) float
        Unit vectors at one epoch.
    v_gaia, v_hipparcos : (n,), (m,) float
        V magnitudes.
    """
    hipparcos_of = np.full(len(u_gaia), -1, np.int64)
    every = np.arange(len(u_hipparcos))
    if not len(u_gaia) or not len(every):
        return Joined(hipparcos_of, every[v_hipparcos < SURELY_LISTED_MAG])
    tree = cKDTree(u_gaia)
    chord, gaia = tree.query(u_hipparcos, distance_upper_bound=SAME_ARCSEC * ARCSEC)
    same = np.isfinite(chord)
    nearest_last = np.flatnonzero(same)[np.argsort(-chord[same], kind="stable")]
    hipparcos_of[gaia[nearest_last]] = nearest_last
    candidates = every[~same & (v_hipparcos < SURELY_LISTED_MAG)]
    near = tree.query_ball_point(u_hipparcos[candidates], NEAR_ARCSEC * ARCSEC)
    missing = [
        not np.any(v_gaia[rows] < v_hipparcos[row] + LIKE_MAG)
        for row, rows in zip(candidates, near, strict=True)
    ]
    return Joined(hipparcos_of, candidates[np.array(missing, bool)])


def joined_magnitude(v_gaia: Array, v_hipparcos: Array) -> Array:
    """Return the V magnitude of stars that are in both catalogues."""
    return np.where(v_hipparcos < v_gaia - MORE_LIGHT_MAG, v_hipparcos, v_gaia)
