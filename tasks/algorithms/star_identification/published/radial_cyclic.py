"""Radial companions and cyclic features with compensation codes [published].

Star identification in celestial navigation, 16th "Huawei Cup" graduate modelling competition
(2019). Three bit vectors describe the surroundings of a star: the rings in which it has
neighbours, the separations of its neighbours from each other, and the eight sectors in
which they lie. Near a bin's edge, an image sets the bits on both sides, so that noise does not
change the pattern. A star's dissimilarity from a centroid is the sum over the three vectors of
(common bits - bits of the catalogue vector)^2. The limit on it is lowered while more than one star
remains and raised while none does, which leaves the stars of least dissimilarity. The candidates
of one image then must agree in separations.

Decided here, as the source leaves it open: the radius (a quarter of the field), the number of
rings (64), the start of the sectors (the first side, in the sense of rotation, of the smallest
angle between two neighbours), and which stars of equal dissimilarity are compared in separations
(those with most bits in common, up to 12).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.published.common import (
    Matcher,
    agreeing_candidates,
    identify_each_frame,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.algorithms.star_identification.star_grid import Sky

Bits = npt.NDArray[np.float32]

N_RINGS = 64
N_SECTORS = 8
COMPENSATED = 0.3  # a feature closer than this to a bin's edge sets the bit beyond as well
N_CENTROIDS = 48  # brightest centroids that are used
MAX_EQUAL = 12
PAIR_GATE = 3.0  # sigma; of a separation
RADIUS_OF_FIELD = 0.25


class Features(NamedTuple):
    """Bits of every catalogue star.

    radius_rad : of the surroundings
    radial, companion, cyclic : (m, bits) float32, 0 or 1
    """

    radius_rad: float
    radial: Bits
    companion: Bits
    cyclic: Bits


def build_features(star_u: Array, radius_rad: float) -> Features:
    """Return the features of all (m, 3) stars, without compensation."""
    return Features(radius_rad, *_features(star_u, radius_rad, compensated=False))


def match_radial_cyclic(u: Array, sigma_rad: Array, star_u: Array, features: Features) -> Integers:
    """Return the star of each centroid, by radial companions and cyclic features.

    Parameters and result as `four_base_stars.match_four_base_stars`; `features` are those of
    star_u.
    """
    n = min(len(u), N_CENTROIDS)
    centroid, star = least_dissimilar(u[:n], features)
    out = np.full(len(u), -1, np.int64)
    out[:n] = agreeing_candidates(u[:n], sigma_rad[:n], star_u, centroid, star, PAIR_GATE)
    return out


def identify_by_radial_cyclic(
    t_s: Array,
    centroids: RawCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames by radial companions and cyclic features.

    Parameters and result as `sensor.identify_sensor`; times and priors are not used.
    """
    return identify_each_frame(make_matcher, centroids, skies, magnitude_limit, matching)


def make_matcher(sky: Sky, optics: FieldOfView) -> Matcher:
    """Return the method as a function of centroids alone, its features made for a camera."""
    star_u = sky.catalogue.u_icrs
    side = float(np.sqrt(optics.solid_angle_sr))
    features = build_features(star_u, RADIUS_OF_FIELD * 2 * np.arctan(side / 2))
    return lambda u, sigma_rad: match_radial_cyclic(u, sigma_rad, star_u, features)


def least_dissimilar(u: Array, features: Features) -> tuple[Integers, Integers]:
    """Return (centroid, star) for the stars least dissimilar to each centroid."""
    none = np.empty(0, np.int64)
    if len(u) < 3 or len(features.radial) == 0:
        return none, none
    measured = _features(u, features.radius_rad, compensated=True)
    dissimilarity, in_common = np.zeros((2, len(u), len(features.radial)), np.float32)
    for bits, listed in zip(measured, features[1:], strict=True):
        common = bits @ listed.T
        dissimilarity += (common - listed.sum(axis=1)) ** 2
        in_common += common
    alone = measured[0].sum(axis=1) < 2  # too few neighbours to identify it
    # A star without neighbours has no dissimilarity: of equals, those with most bits in common.
    rank = dissimilarity - in_common / 1024
    centroid, star = np.nonzero(rank == rank.min(axis=1, keepdims=True))
    equal = np.bincount(centroid, minlength=len(u))
    kept = (equal[centroid] <= MAX_EQUAL) & ~alone[centroid]
    return centroid[kept].astype(np.int64), star[kept].astype(np.int64)


def _features(u: Array, radius_rad: float, compensated: bool) -> tuple[Bits, Bits, Bits]:
    m = len(u)
    radial, companion = np.zeros((2, m, N_RINGS), np.float32)
    cyclic = np.zeros((m, N_SECTORS), np.float32)
    width = radius_rad / N_RINGS
    near = cKDTree(u).query_ball_point(u, 2 * np.sin(radius_rad / 2)) if m else []
    for k, rows in enumerate(near):
        others = np.array([r for r in rows if r != k], np.int64)
        if len(others) == 0:
            continue
        _set_bits(radial[k], _angle(u[others] - u[k]) / width, compensated)
        i, j = np.triu_indices(len(others), 1)
        between = _angle(u[others[i]] - u[others[j]])
        _set_bits(companion[k], between / (2 * width), compensated)
        _set_bits(cyclic[k], _sector_positions(u[k], u[others]), compensated, around=True)
    return radial, companion, cyclic


def _angle(difference: Array) -> Array:
    return 2 * np.arcsin(np.minimum(0.5 * np.linalg.norm(difference, axis=-1), 1.0))


def _sector_positions(centre: Array, neighbours: Array) -> Array:
    """Return angles around the centre in sectors, from the first side of the smallest gap."""
    east = np.cross([0.0, 0.0, 1.0] if abs(centre[2]) < 0.9 else [1.0, 0.0, 0.0], centre)
    east /= np.linalg.norm(east)
    north = np.cross(centre, east)
    angle = np.sort(np.arctan2(neighbours @ north, neighbours @ east) % (2 * np.pi))
    gaps = np.diff(angle, append=angle[0] + 2 * np.pi)
    start = angle[np.argmin(gaps)]
    return ((angle - start) % (2 * np.pi)) * (N_SECTORS / (2 * np.pi))


def _set_bits(bits: Bits, position: Array, compensated: bool, around: bool = False) -> None:
    n = len(bits)
    whole = np.floor(position).astype(np.int64)
    part = position - whole
    wanted = [whole]
    if compensated:
        wanted += [whole[part < COMPENSATED] - 1, whole[part > 1 - COMPENSATED] + 1]
    for at in wanted:
        at = at % n if around else at[(at >= 0) & (at < n)]
        bits[at] = 1.0
