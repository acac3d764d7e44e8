"""A sensor's frames by a published method: each frame alone, lost in space.

A method says which star each centroid is. The attitude is the optimal one of all matches, without
those that are out of place. There is no verdict by likelihood, no tracking and no prior.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.attitude import optimal_attitude
from epipole.tasks.algorithms.star_identification.frames.centroids import RawCentroids, unsolved
from epipole.tasks.algorithms.star_identification.frames.frame import (
    FieldOfView,
    FrameCentroids,
    Search,
    Solution,
    aberrate_all,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sensor_limits import scale_of
from epipole.tasks.algorithms.star_identification.sensor_sample import Skies
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
# Takes (n, 3) directions, brightest first, and (n,) sigmas [rad]; returns (n,) rows of the sky's
# catalogue, -1 where a centroid is no star.
Matcher = Callable[[Array, Array], Rows]

ASSUMED_SIGMA_PX = 0.5  # of centroids without sigma; the published maps have it


def solve_matches(
    frame: FrameCentroids, sky: Sky, star: npt.NDArray[np.int64], gate_sigma: float
) -> Solution | None:
    """Return the attitude of a frame's matches; None where fewer than three are in place."""
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


def identify_each_frame(
    make_matcher: Callable[[Sky, FieldOfView], Matcher],
    spots: RawCentroids,
    skies: Skies,
    magnitude_limit: float | None,
    how: Search,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames, each frame alone.

    Without `magnitude_limit`, the faintest star is the one that gives as many stars in a field
    as the frames have centroids. Where no errors are stated, 0.5 px is assumed, and the
    reported ones follow from the residuals.

    Parameters
    ----------
    make_matcher
        Prepares a method for a camera and its sky.
    """
    counts = spots.counts
    usable = counts[counts >= 4]
    if magnitude_limit is None:
        density = float(np.median(usable)) if len(usable) else 10.0
        magnitude_limit = skies.limit_for(density / spots.optics[0].solid_angle_sr)
    sky = skies.sky(magnitude_limit)
    stated = bool(np.isfinite(spots.sigma_px).any())
    match = make_matcher(sky, spots.optics[0])
    assumed = np.where(np.isnan(spots.sigma_px), ASSUMED_SIGMA_PX, spots.sigma_px)
    frames, solutions = spots._replace(sigma_px=assumed).frames(1.0), unsolved(spots.first)
    for k in range(len(counts)):
        frame = frames.frame(k)
        solution = solve_matches(frame, sky, match(frame.u, frame.sigma_rad), how.gate_sigma)
        if solution is not None:
            solutions.enter(k, solution)
    status = [_status(n, s) for n, s in zip(counts, solutions.solved, strict=True)]
    residuals, scale = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum())), 1.0
    if residuals.dof > 0 and not stated:
        scale = residuals.scale
        solutions = solutions.rescaled(scale)
    factor = scale if stated else scale * ASSUMED_SIGMA_PX
    return IdentifiedSensor(solutions, status, sky, np.full(len(status), factor))


def _status(n: int, solved: bool) -> str | None:
    if solved:
        return None
    if n < 3:
        return "too_few_stars" if n else "no_centroids"
    return "no_match"
