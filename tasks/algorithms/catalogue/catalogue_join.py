"""Gaia joined with Hipparcos: V magnitudes, motions, and the bright stars that Gaia lacks."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.catalogue.star_catalogue import MAS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.sky import radec_from_unit, unit_from_radec

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

# Stars within this are the same: 99.9 % of Hipparcos' places at 2016 are within 0.7" of Gaia's.
SAME_ARCSEC = 1.0
# A Hipparcos star is missing from Gaia if no Gaia star of similar brightness is this near (as
# there is for a double that one of the catalogues resolves) and it is brighter than this.
NEAR_ARCSEC = 3.0
LIKE_MAG = 1.5
SURELY_LISTED_MAG = 9.0
# Where Hipparcos is brighter by more, its magnitude is used: the relation below fails for the
# reddest variables, and of some doubles Gaia lists the faint star only.
MORE_LIGHT_MAG = 1.0
COLOURS = (-0.5, 5.0)  # BP-RP to which the relation holds


class Joined(NamedTuple):
    """Gaia's stars matched with those of Hipparcos.

    hipparcos_of : (n,) int, row of the Hipparcos star of each Gaia star, -1 for none
    missing : (k,) int, rows of Hipparcos stars that Gaia lacks
    """

    hipparcos_of: Rows
    missing: Rows


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


def moved(
    ra: Array, dec: Array, pm_ra_mas_yr: Array, pm_dec_mas_yr: Array, years: float
) -> tuple[Array, Array, Array, Array]:
    """Return places [rad] and motions [mas/yr] after some Julian years, for the barycentre.

    Radial velocities are neglected.
    """
    u, east, north = unit_from_radec(ra, dec), *_axes(ra, dec)
    motion = pm_ra_mas_yr[:, None] * east + pm_dec_mas_yr[:, None] * north
    place = u + motion * (MAS * years)
    distance = np.linalg.norm(place, axis=1, keepdims=True)
    u = place / distance
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
    alone = [
        not np.any(v_gaia[rows] < v_hipparcos[row] + LIKE_MAG)
        for row, rows in zip(candidates, near, strict=True)
    ]
    return Joined(hipparcos_of, candidates[np.array(alone, bool)])


def joined_magnitude(v_gaia: Array, v_hipparcos: Array) -> Array:
    """Return the V magnitude of stars that are in both catalogues."""
    return np.where(v_hipparcos < v_gaia - MORE_LIGHT_MAG, v_hipparcos, v_gaia)
