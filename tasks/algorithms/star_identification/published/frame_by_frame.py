"""A sensor's frames by one of the published methods: each by itself, lost in space.

A method gives the star of each centroid; the attitude is the optimal one of all matches,
those out of their place left out. There is no verdict by likelihood, no tracking, no prior.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.attitude import optimal_attitude
from epipole.tasks.algorithms.star_identification.frames.frame import (
    Frame,
    Optics,
    Search,
    Solution,
    aberrate_all,
)
from epipole.tasks.algorithms.star_identification.frames.spots import Spots, unsolved
from epipole.tasks.algorithms.star_identification.published.four_base_stars import (
    match_four_base_stars,
)
from epipole.tasks.algorithms.star_identification.published.match_group import match_group
from epipole.tasks.algorithms.star_identification.published.radial_cyclic import (
    RADIUS_OF_FIELD,
    build_features,
    match_radial_cyclic,
)
from epipole.tasks.algorithms.star_identification.sensor import Identified, Skies
from epipole.tasks.algorithms.star_identification.sensor_limits import scale_of
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky, pattern_pairs

Array = npt.NDArray[np.float64]
Method = Literal["four_base_stars", "match_group", "radial_cyclic"]
Matcher = Callable[[Array, Array], npt.NDArray[np.int64]]

ASSUMED_SIGMA_PX = 0.5  # of centroids without sigma; the published maps have it


def matcher(method: Method, sky: Sky, optics: Optics) -> Matcher:
    """Return a method as a function of centroids alone, its tables made for a camera.

    The function takes (n, 3) directions, brightest first, and (n,) sigmas [rad], and
    returns rows of the sky's catalogue, -1 none.
    """
    star_u = sky.catalogue.u_icrs
    if method == "radial_cyclic":
        side = float(np.sqrt(optics.solid_angle_sr))
        features = build_features(star_u, RADIUS_OF_FIELD * 2 * np.arctan(side / 2))
        return lambda u, sigma_rad: match_radial_cyclic(u, sigma_rad, star_u, features)
    pairs = pattern_pairs(star_u, 2 * optics.half_diagonal_rad)
    match = match_four_base_stars if method == "four_base_stars" else match_group
    return lambda u, sigma_rad: match(u, sigma_rad, star_u, pairs)


def solve_matches(
    frame: Frame, sky: Sky, star: npt.NDArray[np.int64], gate_sigma: float
) -> Solution | None:
    """Return the attitude of a frame's matches, None with fewer than three in their place."""
    star = star.copy()
    for _ in range(3):  # one wrong match bends the first attitude
        at = np.flatnonzero(star >= 0)
        if len(at) < 3:
            return None
        apparent = aberrate_all(sky.catalogue.u_icrs[star[at]], frame.beta)
        R, cov_rad2 = optimal_attitude(frame.u[at], apparent, frame.sigma_rad[at])
        chi2 = np.zeros(len(star))
        miss = np.linalg.norm(frame.u[at] - apparent @ R.T, axis=1)
        chi2[at] = (miss / frame.sigma_rad[at]) ** 2
        beyond = chi2 > gate_sigma**2
        if not beyond.any() and np.isfinite(cov_rad2).all():
            return Solution(R, cov_rad2, star, chi2, np.nan)
        star[beyond] = -1
    return None


def identify_published(
    spots: Spots, skies: Skies, magnitude_limit: float | None, method: Method, how: Search
) -> Identified:
    """Identify the stars of a sensor's frames by a published method.

    Without `magnitude_limit`, the faintest star is the one that gives as many stars a field
    as the frames have centroids. Where no errors are stated, 0.5 px is assumed, and the
    reported ones follow from the residuals.
    """
    counts = spots.counts
    usable = counts[counts >= 4]
    if magnitude_limit is None:
        density = float(np.median(usable)) if len(usable) else 10.0
        magnitude_limit = skies.limit_for(density / spots.optics[0].solid_angle_sr)
    sky = skies.sky(magnitude_limit)
    stated = bool(np.isfinite(spots.sigma_px).any())
    match = matcher(method, sky, spots.optics[0])
    assumed = np.where(np.isnan(spots.sigma_px), ASSUMED_SIGMA_PX, spots.sigma_px)
    frames, solutions = spots._replace(sigma_px=assumed).frames(1.0), unsolved(spots.first)
    for k in range(len(counts)):
        frame = frames.one(k)
        solution = solve_matches(frame, sky, match(frame.u, frame.sigma_rad), how.gate_sigma)
        if solution is not None:
            solutions.enter(k, solution)
    status = [_status(n, s) for n, s in zip(counts, solutions.solved, strict=True)]
    found, scale = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum())), 1.0
    if found.dof > 0 and not stated:
        scale = found.scale
        solutions = solutions.rescaled(scale)
    return Identified(solutions, status, sky, scale if stated else scale * ASSUMED_SIGMA_PX)


def _status(n: int, solved: bool) -> str | None:
    if solved:
        return None
    if n < 3:
        return "too_few_stars" if n else "no_centroids"
    return "no_match"
